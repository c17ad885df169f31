"""`python -m prior_sg.deploy.benches.mono SOURCE OUT`: depth from one picture against the depth that a source has.

The "network" is the source's own depth, given as networks give it: inverse depth with a scale and a shift of each
picture's own, and an error that is smooth over the picture. Metres come from the pictures and poses alone, as of any
source without depth. Writes `OUT/full.mcap` and `OUT/mono.mcap`, the frames that got metres with either depth, for
`prior-sg eval OUT/full.mcap OUT/mono.mcap`, and prints how wrong the depth is as one JSON object.
"""

import argparse
import json
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from prior_sg.deploy.sample.packed import keyframe_of, write_log
from prior_sg.schemas.frames import Keyframe
from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.core.mono.scale import INVERSE
from prior_sg.services.ingest.core.pixels import encoded, millimetres, stored
from prior_sg.services.ingest.sources import open_source
from prior_sg.services.ingest.sources.base import Camera, Entry, FrameError, Images
from prior_sg.services.ingest.sources.mono.film import Film

ROBOT = "robot1"
SCALE, SHIFT = (0.5, 2.0), (0.0, 0.1)  # of inverse depth (1/m), drawn for each picture
BLOBS = (4, 3)  # values of which the smooth error is interpolated, across and down
WRONG = 0.2  # share of the true depth off which a pixel is wrong


class Distorted:
    """What a network would say of the frame that is looked at: it is shown the picture, and has the truth."""

    kind = INVERSE

    def __init__(self, error: float, seed: int) -> None:
        self.true_m = np.zeros((1, 1))
        self._error, self._rng = error, np.random.default_rng(seed)

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        height, width = self.true_m.shape
        blobs = self._rng.normal(0.0, self._error, BLOBS[::-1]).astype(np.float32)
        smooth = cv2.resize(blobs, (width, height), interpolation=cv2.INTER_CUBIC)
        scale, shift = self._rng.uniform(*SCALE), self._rng.uniform(*SHIFT)
        farthest_m = self.true_m.max(initial=1.0)  # where the truth has a hole a network says something, too
        inverse_depth = (1 + smooth) / np.where(self.true_m > 0, self.true_m, farthest_m)
        return scale * inverse_depth + shift


def mono_bench(source: Path, out: Path, every: int, error: float, seed: int) -> dict[str, Any]:
    """Pack both logs; every n-th frame is looked at, with all others around it."""
    frames = [frame for frame in open_source(source) if isinstance(frame, RawFrame)]
    truth = open_source(source).ground_truth
    network = Distorted(error, seed)
    film = Film([_entry(frame) for frame in frames], Camera(frames[0].intrinsics), network)
    seen: list[tuple[RawFrame, np.ndarray]] = []
    refused: Counter[str] = Counter()
    for index, frame in list(enumerate(frames))[::every]:
        network.true_m = stored(frame.depth) * np.float64(frame.depth_scale_m)
        try:
            depth = film.images(index).depth
        except FrameError as fault:
            refused[" ".join(word for word in str(fault).split() if not word[0].isdigit())] += 1
            continue
        assert isinstance(depth, np.ndarray)
        seen.append((frame, depth))
    out.mkdir(parents=True, exist_ok=True)

    def keyframes(mono: bool) -> Iterator[Keyframe]:
        for frame, depth_m in seen:
            if not mono:
                yield keyframe_of(frame, ROBOT, frame.color, frame.depth)
                continue
            millimetred = msgspec.structs.replace(frame, depth_scale_m=0.001)
            yield keyframe_of(millimetred, ROBOT, frame.color, encoded(millimetres(depth_m), ".png"))

    for name in ("full", "mono"):
        write_log(out / f"{name}.mcap", keyframes(name == "mono"), ROBOT, f"{name} depth of {source.name}", truth)
    off = [_off(stored(frame.depth) * np.float64(frame.depth_scale_m), depth_m) for frame, depth_m in seen]
    medians = np.array([np.median(one) for one in off if len(one)])
    pixels = np.concatenate([one[::97] for one in off])
    return {
        "frames": -(-len(frames) // every),
        "scaled": len(seen),
        "refused": dict(refused),
        "error_of_frames_p50_p90_max": np.percentile(medians, [50, 90, 100]).round(4).tolist(),
        "error_of_pixels_p50_p90": np.percentile(pixels, [50, 90]).round(4).tolist(),
        "wrong_pixels": float((pixels > WRONG).mean()),
        "network_error": error,
    }


def _entry(frame: RawFrame) -> Entry:
    images = Images(frame.color, frame.depth, frame.mask)
    return Entry(frame.frame_id, frame.stamp_ns, partial(np.array, frame.world_from_camera), lambda: images)


def _off(true_m: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Share of the true depth by which each pixel that has both is off."""
    both = (true_m > 0) & (depth_m > 0)
    off: np.ndarray = np.abs(depth_m - true_m)[both] / true_m[both]
    return off


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=4, help="frames from one that is packed to the next (default: 4)")
    parser.add_argument("--error", type=float, default=0.05, help="of the network (default: %(default)g)")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    print(json.dumps(mono_bench(given.source, given.out, given.every, given.error, given.seed), indent=1))


if __name__ == "__main__":
    main()
