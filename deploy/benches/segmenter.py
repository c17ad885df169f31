"""Measurements of the segmenter alone, on made-up halls of rooms: one update on maps of many sizes; a task switch."""

import statistics
import time
from typing import Any

import numpy as np

from prior_sg.schemas.codec import Message
from prior_sg.schemas.features import Pyramid, TextEmbeddings, TextRequest
from prior_sg.schemas.frames import Intrinsics
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import ObjectPrior, Prior, Provenance, RegionPrior, Task
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import TEXT
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity

ROBOT, LABELS, DIM = "bench", 12, 384
STEP_M, ROOM_STEPS = 0.7, 8  # places stand this far apart; a room is a square of so many
CAMERA = Intrinsics(width_px=640, height_px=480, fx_px=525.0, fy_px=525.0, cx_px=319.5, cy_px=239.5)
_NONE = np.zeros(0, dtype=np.int64)


class Hall:
    """Rooms side by side, each of one label, as places on a grid with doorways; cameras look around in them."""

    def __init__(self, places: int, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.rooms = max(round(places / ROOM_STEPS**2), 1)
        self.width = int(np.ceil(np.sqrt(self.rooms)))
        self.labels = self.rng.integers(0, LABELS, self.rooms)
        self.concepts = _unit(self.rng.standard_normal((2 * LABELS, DIM)))
        self.ids = np.full((self.width * ROOM_STEPS,) * 2, -1)
        positions: list[tuple[float, float, float]] = []
        for room in range(self.rooms):
            row, column = divmod(room, self.width)
            for i in range(ROOM_STEPS):
                for j in range(ROOM_STEPS):
                    x, y = column * ROOM_STEPS + i, row * ROOM_STEPS + j
                    self.ids[x, y] = len(positions)
                    positions.append((x * STEP_M, y * STEP_M, 1.0))
        self.positions_m = np.array(positions, np.float32)
        self.edges = np.concatenate([self._pairs(0), self._pairs(1)])

    def _pairs(self, axis: int) -> np.ndarray:
        """Edges between grid neighbours along an axis; between rooms only at every fourth, the doorways."""
        grid = self.ids if axis == 0 else self.ids.T
        first, second = grid[:-1], grid[1:]
        wall = (np.arange(len(first)) + 1) % ROOM_STEPS == 0
        door = np.arange(grid.shape[1]) % ROOM_STEPS == ROOM_STEPS // 2
        open_ = (first >= 0) & (second >= 0) & (~wall[:, None] | door)
        return np.sort(np.stack((first[open_], second[open_]), axis=1), axis=1)

    def delta(self, revision: int, ids: np.ndarray) -> PlaceDelta:
        """These places, each moved a little, and their edges among themselves and to all others."""
        wanted = np.zeros(len(self.positions_m), dtype=bool)
        wanted[ids] = True
        edges = self.edges[wanted[self.edges].any(axis=1)]
        jitter_m = self.rng.normal(0, 0.01, (len(ids), 3)) if revision else 0.0
        return PlaceDelta(
            robot=ROBOT,
            epoch=1,
            revision=revision,
            stamp_ns=revision,
            frame_id=revision,
            place_ids=ids,
            positions_m=(self.positions_m[ids] + jitter_m).astype(np.float32),
            radii_m=np.full(len(ids), 0.6, np.float32),
            basis_points=np.full(len(ids), 2, np.int16),
            removed_ids=_NONE,
            merged_ids=_NONE.reshape(0, 2),
            edges=edges,
            clearances_m=np.full(len(edges), 0.5, np.float32),
            removed_edges=_NONE.reshape(0, 2),
        )

    def pyramid(self, frame_id: int, room: int, space: str, crops: int = 12) -> Pyramid:
        """What a level camera in the middle of a room sees of it, up to 4 m away."""
        row, column = divmod(room, self.width)
        middle_m = (np.array((column, row)) * ROOM_STEPS + ROOM_STEPS / 2) * STEP_M
        pose, angle = np.eye(4), self.rng.uniform(0, 2 * np.pi)
        forward, down = np.array((np.cos(angle), np.sin(angle), 0.0)), np.array((0.0, 0.0, -1.0))
        pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = np.cross(down, forward), down, forward, (*middle_m, 1.0)
        seen = self.concepts[self.labels[room]] + 0.15 * self.rng.standard_normal((crops, DIM))
        layers = np.repeat(np.arange(2), crops // 2).astype(np.uint8)
        return Pyramid(
            robot=ROBOT,
            frame_id=frame_id,
            stamp_ns=frame_id,
            space=space,
            worker="bench",
            intrinsics=CAMERA,
            world_from_camera=pose,
            centers_px=self.rng.uniform((100, 100), (540, 380), (crops, 2)).astype(np.float32),
            sigmas_px=np.where(layers == 0, 112.0, 224.0).astype(np.float32),
            layers=layers,
            depths_m=np.full(crops, 3.0, np.float32),
            embeddings=_unit(seen).astype(np.float16),
            surface_m=np.full((30, 40), 4.0, np.float32),
            crops_total=crops,
        )


class Bench:
    """One segmenter that follows a hall; its questions are answered on the spot."""

    def __init__(self, hall: Hall) -> None:
        self.hall = hall
        self.runner = Runner(BY_NAME["segmenter"], identity=Identity(ROBOT, "bench", 1), answers={TEXT: self._text})
        self.cfg: Any = self.runner.cfg

    def step(self, message: Message) -> int:
        """Feed one message; how many deltas came out."""
        return len(self.runner.feed(message))

    def _text(self, request: TextRequest) -> TextEmbeddings:
        count = len(request.concepts)
        return TextEmbeddings(
            space=self.cfg.space,
            embeddings=self.hall.concepts[:count].astype(np.float32),
            background_mean=np.full(count, 0.1, np.float32),
            background_std=np.full(count, 0.1, np.float32),
            temperature=0.5,
            null_score=3.0,
        )

    def give(self, name: str, labels: int, query_radius_m: float) -> list[Any]:
        """A task and its prior."""
        rng = np.random.default_rng(labels)
        costs = rng.uniform(0.02, 1.0, (labels, labels))
        adjacency = (np.triu(costs) + np.triu(costs, 1).T).astype(np.float32)
        regions = [
            RegionPrior(
                name=f"{name} {i}", phrases=[f"{name} {i}"], existence=1 / labels, query_radius_m=query_radius_m
            )
            for i in range(labels)
        ]
        prior = Prior(
            environment="hall",
            task=name,
            regions=regions,
            objects=[ObjectPrior(name="thing", phrases=["thing"])],
            containment=np.full((labels, 1), 0.5, np.float32),
            adjacency=adjacency,
            provenance=Provenance(source="bench"),
        )
        task: Task | None = self.runner.state.task
        stamp_ns = 1 + (task.stamp_ns if task else 0)
        return [Task(robot=ROBOT, stamp_ns=stamp_ns, environment="hall", task=name), prior]

    def fill(self, keyframes: int) -> None:
        """All places, a prior, and keyframes spread over the rooms."""
        for message in (self.hall.delta(0, np.arange(len(self.hall.positions_m))), *self.give("zone", LABELS, 0.75)):
            self.step(message)
        rooms = np.linspace(0, self.hall.rooms - 1, keyframes).astype(int)
        for frame_id, room in enumerate(rooms.tolist()):
            self.step(self.hall.pyramid(frame_id, room, self.cfg.space))
        self.step(Tick(stamp_ns=1))


def updates(sizes: tuple[int, ...] = (1_000, 10_000, 50_000), number: int = 60) -> tuple[dict, dict]:
    """One keyframe's places and pyramid, on maps of several sizes: 40 places change, a few dozen are seen anew."""
    metrics: dict[str, float] = {}
    for places in sizes:
        bench = Bench(Hall(places))
        bench.fill(keyframes=min(4 * bench.hall.rooms, 400))
        spent, processor = [], []
        for turn in range(number):
            room = int(bench.hall.rng.integers(0, bench.hall.rooms))
            ids = np.sort(bench.hall.rng.choice(ROOM_STEPS**2, 40, replace=False) + room * ROOM_STEPS**2)
            messages = (bench.hall.delta(turn + 1, ids), bench.hall.pyramid(10_000 + turn, room, bench.cfg.space))
            started_s, processor_s = time.perf_counter(), time.process_time()
            for message in messages:
                bench.step(message)
            spent.append(1e3 * (time.perf_counter() - started_s))
            processor.append(1e3 * (time.process_time() - processor_s))
            if turn % 4 == 3:
                bench.step(Tick(stamp_ns=turn))
        ordered = sorted(spent[3:])
        metrics[f"ms_p50_{places}"] = statistics.median(ordered)
        metrics[f"ms_p99_{places}"] = ordered[int(0.99 * len(ordered))]
        metrics[f"processor_ms_p50_{places}"] = statistics.median(processor[3:])
    metrics["ms_p50"], metrics["ms_p99"] = metrics[f"ms_p50_{sizes[1]}"], metrics[f"ms_p99_{sizes[1]}"]
    metrics["growth"] = metrics[f"processor_ms_p50_{sizes[-1]}"] / metrics[f"processor_ms_p50_{sizes[0]}"]
    return metrics, {"places": list(sizes), "labels": LABELS, "updates": number, "changed_places": 40}


def switch(places: int = 2_000, keyframes: int = 500) -> tuple[dict, dict]:
    """Prior in hand → complete new regions, for new labels and, the worst case, a new query radius."""
    bench = Bench(Hall(places))
    bench.fill(keyframes)
    metrics: dict[str, float] = {}
    for name, labels, radius_m in (("same_radius", 10, 0.75), ("seconds", 8, 1.5)):
        spent = []
        for turn in range(3):
            task, prior = bench.give(f"{name} {turn}", labels, radius_m * (1 + 0.1 * turn if name == "seconds" else 1))
            bench.step(task)
            started_s = time.perf_counter()
            deltas = bench.step(prior)
            spent.append(time.perf_counter() - started_s)
            if deltas != 1:
                raise RuntimeError(f"{deltas} deltas followed the prior, not one")
        metrics[name if name == "seconds" else "seconds_same_radius"] = statistics.median(spent)
    return metrics, {"places": len(bench.hall.positions_m), "keyframes": keyframes, "radius": "changed for `seconds`"}


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
