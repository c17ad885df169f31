"""Packs a dataset folder into a sample: one MCAP log of keyframes with its ground truth and where it comes from.

python -m prior_sg.deploy.sample.make DATASET OUT --provenance SENTENCE
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np

from prior_sg.deploy.sample.packed import PackError, keyframe_of, write_log
from prior_sg.schemas.frames import Keyframe
from prior_sg.services.headers import jpeg_segments
from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.sources import Source, SourceError, open_source
from prior_sg.services.runtime.record import LogError

ROBOT = "sample"
QUALITIES = (None, 92, 85, 75)  # of the JPEG; None = as it is
PNG_EFFORT = (cv2.IMWRITE_PNG_COMPRESSION, 9)
JPEG_KEPT = frozenset({0xE0, 0xEE}) | frozenset(range(0xC0, 0xE0))  # JFIF and Adobe headers, and what decoding needs


@dataclass(frozen=True)
class Coarser:
    """Images of the same size in fewer bytes, for a sample that travels with the program."""

    quality: int  # of the JPEG
    depth_step_m: float = 0.02
    depth_block_px: int = 2  # pixels across that share one depth

    def of(self, frame: RawFrame) -> RawFrame:
        """The same view. The depth of a block is that of one pixel: a mean across an edge would lie in free space."""
        color = _decoded(frame.color, cv2.IMREAD_COLOR)
        options = (cv2.IMWRITE_JPEG_QUALITY, self.quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1)
        depth, block = _decoded(frame.depth, cv2.IMREAD_UNCHANGED), self.depth_block_px
        steps = np.rint(depth * (frame.depth_scale_m / self.depth_step_m)).astype(np.uint16)
        coarse = steps[block // 2 :: block, block // 2 :: block].repeat(block, axis=0).repeat(block, axis=1)
        return msgspec.structs.replace(
            frame,
            color=cv2.imencode(".jpg", color, options)[1].tobytes(),
            depth=cv2.imencode(".png", coarse[: len(depth), : depth.shape[1]])[1].tobytes(),
            depth_scale_m=self.depth_step_m,
        )


def pack(
    dataset: str | Path, path: str | Path, max_mb: float = 12, provenance: str = "", coarser: Coarser | None = None
) -> int:
    """Write all frames of a dataset folder to an MCAP log of at most `max_mb` and return how many there are.

    Depth stays exact unless `coarser` is given. Colour is compressed again only when the log is too large otherwise.
    Equal folders give equal logs. `provenance` is a sentence that travels in the log. Raises PackError, SourceError or
    LogError.
    """
    source, path = open_source(dataset), Path(path)
    partial = path.with_name(f"{path.name}.partial")
    try:
        for quality in QUALITIES:
            _write(source, partial, quality, provenance, coarser)
            if partial.stat().st_size <= max_mb * 1e6:
                partial.replace(path)
                return source.total
    finally:
        partial.unlink(missing_ok=True)
    raise PackError(f"{dataset} does not fit into {max_mb:g} MB: pack fewer frames or allow more")


def _write(source: Source, path: Path, quality: int | None, provenance: str, coarser: Coarser | None) -> None:
    write_log(path, _keyframes(source, quality, coarser), ROBOT, provenance, source.ground_truth)


def _keyframes(source: Source, quality: int | None, coarser: Coarser | None) -> Iterator[Keyframe]:
    for frame in source:
        if not isinstance(frame, RawFrame):
            raise PackError(f"frame {frame.frame_id} of {source.path} cannot be packed: {frame.reason}")
        seen = frame if coarser is None else coarser.of(frame)
        color = bare_jpeg(seen.color) if quality is None else _recompressed(seen.color, quality)
        yield keyframe_of(seen, ROBOT, color, smallest_png(seen.depth))


def bare_jpeg(jpeg: bytes) -> bytes:
    """The same picture without comments, camera data and thumbnails; other formats pass unchanged."""
    if not jpeg.startswith(b"\xff\xd8"):
        return jpeg
    return jpeg[:2] + b"".join(jpeg[start:end] for marker, start, end in jpeg_segments(jpeg) if marker in JPEG_KEPT)


def smallest_png(png: bytes) -> bytes:
    """The same 16-bit image, compressed as far as it goes and without comments."""
    image = _decoded(png, cv2.IMREAD_UNCHANGED)
    return cv2.imencode(".png", image, PNG_EFFORT)[1].tobytes()


def _recompressed(color: bytes, quality: int) -> bytes:
    image = _decoded(color, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].tobytes()


def _decoded(data: bytes, mode: int) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    if image is None:
        raise PackError("an image of the folder cannot be decoded")
    return image


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m prior_sg.deploy.sample.make",
        description="Pack a dataset folder into a sample log.",
        epilog="example: python -m prior_sg.deploy.sample.make recordings/home deploy/sample/home.mcap",
    )
    parser.add_argument("dataset", metavar="DATASET", help="folder with camera.json and trajectory.csv")
    parser.add_argument("out", metavar="OUT", help="MCAP file to write")
    parser.add_argument("--max-mb", type=float, default=12, help="largest size of the log (default 12)")
    parser.add_argument("--coarse", type=int, metavar="QUALITY", help="JPEG of this quality, depth in steps of 2 cm")
    parser.add_argument("--provenance", default="", help="sentence that says where the data comes from")
    arguments = parser.parse_args()
    try:
        coarser = Coarser(arguments.coarse) if arguments.coarse else None
        frames = pack(arguments.dataset, arguments.out, arguments.max_mb, arguments.provenance, coarser)
    except (PackError, SourceError, LogError) as error:
        sys.exit(str(error))
    print(f"{frames} frames, {Path(arguments.out).stat().st_size / 1e6:.1f} MB in {arguments.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
