"""What keyframes of a far-seeing camera cost, at once and in slices.

`python -m prior_sg.deploy.benches.far world:campus:20`: the camera sees `--range` metres, exactly, along the world's
walk, or from every `--every`-th view of it; with `--side 3` the world stands nine times side by side and the walk is in
the middle one. Each keyframe is given to a place graph that works it off at once and to one that does so in slices, in
turn; times are of one thread's processor.
"""

import argparse
import dataclasses
import itertools
import json
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from prior_sg.deploy.benches.ground import seen_as_far
from prior_sg.deploy.evaluation.datasets import named_worlds
from prior_sg.deploy.evaluation.worlds import World, world_of
from prior_sg.schemas.frames import Keyframe
from prior_sg.services.place_graph.core.config import AT_ONCE, Config, preset
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.service import Identity, Pause


class Mapping:
    """A place graph, and what its keyframes took."""

    def __init__(self, cfg: Config) -> None:
        self.cfg, self.service = cfg, BY_NAME["place_graph"]
        self.state: Any = self.service.init(cfg, Identity("bench", "b", 1))
        self.steps_ms: list[list[float]] = []  # by keyframe: from its start, or a pause, to the next or its end

    def take(self, keyframe: Keyframe) -> None:
        """Work one off."""
        steps_ms, began_s = [], time.process_time()
        for output in itertools.chain(self.service.step(self.state, keyframe, self.cfg), [Pause()]):
            if isinstance(output, Pause):
                now_s = time.process_time()
                steps_ms.append(1e3 * (now_s - began_s))
                began_s = now_s
        self.steps_ms.append(steps_ms)

    def figures(self) -> dict[str, float]:
        """Milliseconds of a keyframe, and of the longest step of each; places at the end."""
        whole, longest = ([kind(steps) for steps in self.steps_ms] for kind in (sum, max))
        named = {"keyframe_ms": whole, "longest_ms": longest}
        found = {
            f"{name}_p{share}": round(float(np.percentile(values, share)), 1)
            for name, values in named.items()
            for share in (50, 99)
        }
        steps = sum(map(len, self.steps_ms)) / len(self.steps_ms)
        return found | {"steps": round(steps, 1), "places": float(len(self.state.graph.places))}


def beside_itself(world: World, side: int, every: int) -> World:
    """The world `side` x `side` times, the views of every `every`-th step in the middle one."""
    poses = world.world_from_camera[::every].copy()
    poses[:, :2, 3] += side // 2 * np.array(world.grid.shape[:2]) * world.voxel_m
    grid = np.tile(world.grid, (side, side, 1))
    return dataclasses.replace(world, grid=grid, world_from_camera=poses, stamps_ns=world.stamps_ns[::every])


def keyframes(name: str, range_m: float, side: int, every: int) -> Iterator[Keyframe]:
    """What a camera of such a range sees of a world such as `world:campus:20`."""
    (named,) = named_worlds(name)
    world = dataclasses.replace(world_of(named.kind, named.seed), range_m=range_m)
    return seen_as_far(beside_itself(world, side, every))


def main() -> None:
    """Print one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("world")
    parser.add_argument("--range", type=float, default=100.0, metavar="METRES")
    parser.add_argument("--side", type=int, default=1)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--preset", default="outdoor")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="of the place graph")
    args = parser.parse_args()
    settings = {name: json.loads(value) for name, value in (text.split("=", 1) for text in args.set)}
    sliced = preset(args.preset, **{"max_range_m": args.range} | settings)
    whole = preset(args.preset, **{"max_range_m": args.range} | settings | {"slice_blocks": AT_ONCE})
    mappings = [Mapping(whole), Mapping(sliced)]
    frames = keyframes(args.world, args.range, args.side, args.every)
    first = next(frames)
    Mapping(whole).take(first)  # loads the compiled loops
    for number, keyframe in enumerate(itertools.chain([first], frames)):
        for mapping in mappings if number % 2 else mappings[::-1]:
            mapping.take(keyframe)
    spent_ms = np.array([[sum(steps) for steps in mapping.steps_ms] for mapping in mappings])
    large = np.array([len(steps) > 1 for steps in mappings[1].steps_ms])
    cost = float(spent_ms[1, large].sum() / spent_ms[0, large].sum()) if large.any() else 1.0
    told = {"at_once": mappings[0].figures(), "slices": mappings[1].figures()}
    print(json.dumps({"world": args.world, "keyframes": len(large), "large": int(large.sum()), "cost": cost} | told))


if __name__ == "__main__":
    main()
