"""`prior-sg bench markers`: do two robots' maps find together by one printed marker, and not by a wrong one?

The homes, parts and drifting poses are those of `bench merge`, without any objects. Papers are printed into the views
where both parts see wall, found there as the worker finds them, and held as the segmenter holds them; where both parts
have one view, each has noise of its own in it. Then the same number is put where it must mislead: on two papers of one
home of which each robot has seen one, and in two homes.
"""

import itertools
import statistics
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np

from prior_sg.deploy.benches.merge import CFG, FOLDER, RIGHT_M, RIGHT_RAD, parts_of
from prior_sg.deploy.evaluation.datasets import WorldName, of_world
from prior_sg.deploy.evaluation.partial_walks import Part, PartialMap, Walks, keyframes, told_poses
from prior_sg.deploy.evaluation.printed import painted, wall_spots
from prior_sg.deploy.fleet.core.finding.config import MatchConfig
from prior_sg.deploy.fleet.core.finding.frames import apart
from prior_sg.deploy.fleet.core.finding.matching import Map, Match, map_of, match
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.schemas.markers import MarkerKey, SceneMarker
from prior_sg.services import images
from prior_sg.services.feature_pyramid.core.markers import MarkersConfig, seen_markers
from prior_sg.services.geometry import inverse, transform
from prior_sg.services.segmenter.core.objects.markers import MarkerConfig, Sighting, located

SCORED = range(60, 80)
LOOK = MarkersConfig(dictionary="apriltag_36h11", size_m=0.16)  # fits on A4
HELD = MarkerConfig()
MOST_SPOTS, SPACED_M = 6, 1.5
GRAY, NOISE_M = 140, 0.003  # of walls; of each pixel of the depth image at a metre, growing with its square
FINER = 8  # pixels of the colour image along one of the depth image, which is small in generated worlds
DIFFERENT = 1000  # pairs of different homes


class Hung(NamedTuple):
    """One home: its parts as maps without objects, and where each has which paper."""

    seed: int
    parts: tuple[PartialMap, PartialMap]
    maps: tuple[Map, Map]
    markers: tuple[dict[int, SceneMarker], dict[int, SceneMarker]]

    @property
    def shared(self) -> list[int]:
        """Numbers of the papers that both have."""
        return sorted(self.markers[0].keys() & self.markers[1].keys())

    def showing(self, part: int, *numbers: int, called: int | None = None) -> Map:
        """A part's map with some of its papers, under another number where one is given."""
        held = [self.markers[part][number] for number in numbers]
        if called is not None:
            held = [msgspec.structs.replace(marker, id=called) for marker in held]
        bare = self.maps[part]
        return Map(msgspec.structs.replace(bare.scene, markers=held), bare.shape)

    def right(self, answer: Match) -> tuple[float, float]:
        """Metres at the middle of the first map, and radians, by which an answer is off; infinite of a refusal."""
        if answer.b_from_a is None:
            return np.inf, np.inf
        truth = self.parts[1].own_from_world @ inverse(self.parts[0].own_from_world)
        return apart(answer.b_from_a, truth, self.maps[0].shape.centers_m.mean(axis=0))


def markers_bench(
    seeds: Sequence[int] = SCORED,
    folder: Path = FOLDER,
    *,
    kind: str = "home",
    report: Callable[[str], None] = lambda text: None,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Answers by one paper and by all, and wrong answers by wrong papers. `report` hears what is being done."""
    walks, homes = Walks(folder, kind=kind), []
    for number, seed in enumerate(seeds, 1):
        report(f"{kind} {seed}, {number} of {len(seeds)}")
        homes.append(hung(walks, seed))
    metrics = figures(homes)
    report("papers that mislead")
    metrics |= misled(homes, DIFFERENT)
    settings = {"worlds": kind, "homes": len(seeds), "seeds": f"{min(seeds)}-{max(seeds)}", "size_m": LOOK.size_m}
    return metrics, settings


def hung(walks: Walks, seed: int) -> Hung:
    """A home with papers on walls that both parts have seen."""
    frames = keyframes(of_world(WorldName(walks.kind, seed), ""))
    both = parts_of(seed)
    parts = walks.part(seed, both[0]), walks.part(seed, both[1])
    spots = _spots(frames, _rows(len(frames), both))
    markers = tuple(_seen(frames, seed, number, spots) for number in (0, 1))
    maps = tuple(map_of(msgspec.structs.replace(part.scene, objects=[])) for part in parts)
    return Hung(seed, parts, (maps[0], maps[1]), (markers[0], markers[1]))


def figures(homes: Sequence[Hung], cfg: MatchConfig = CFG) -> dict[str, float]:
    """How often, and how well, one paper and all papers tell how maps lie."""
    found: dict[str, float] = {"papers_of_both": sum(len(home.shared) for home in homes)}
    for name, tries in (
        ("one", [(home, (number,)) for home in homes for number in home.shared]),
        ("all", [(home, tuple(home.shared)) for home in homes if home.shared]),
    ):
        off = [home.right(match(home.showing(0, *some), home.showing(1, *some), cfg)) for home, some in tries]
        answers = [(gap_m, gap_rad) for gap_m, gap_rad in off if np.isfinite(gap_m)]
        right = [one for one in answers if one[0] < RIGHT_M and one[1] < RIGHT_RAD]
        found |= {f"{name}_tried": len(tries), f"{name}_right": len(right), f"{name}_wrong": len(answers) - len(right)}
        if answers:
            found[f"{name}_error_m_p50"] = statistics.median(gap_m for gap_m, _ in answers)
            found[f"{name}_error_m_max"] = max(gap_m for gap_m, _ in answers)
            found[f"{name}_error_deg_p50"] = float(np.degrees(statistics.median(gap_rad for _, gap_rad in answers)))
            found[f"{name}_error_deg_max"] = float(np.degrees(max(gap_rad for _, gap_rad in answers)))
    return found


def misled(homes: Sequence[Hung], most: int, cfg: MatchConfig = CFG) -> dict[str, float]:
    """How many pairs of maps were taken for one by papers of one number that hang at different spots."""
    twins = [(home, home, (0, 1), pair) for home in homes for pair in itertools.permutations(home.shared, 2)]
    strangers = list(_strangers(homes))
    order = np.random.default_rng(0).permutation(len(strangers))[:most].tolist()
    found: dict[str, float] = {}
    for name, tries in (("twin", twins), ("different", [strangers[at] for at in order])):
        taken = 0
        for one, other, parts, papers in tries:
            a, b = (
                home.showing(part, paper, called=0)
                for home, part, paper in zip((one, other), parts, papers, strict=True)
            )
            taken += match(a, b, cfg).b_from_a is not None
        found |= {f"{name}_pairs": float(len(tries)), f"{name}_accepted": float(taken)}
    return found


def _strangers(homes: Sequence[Hung]) -> Iterator[tuple[Hung, Hung, tuple[int, int], tuple[int, int]]]:
    for one, other in itertools.combinations(homes, 2):
        for here, there in itertools.product((0, 1), repeat=2):
            for papers in itertools.product(sorted(one.markers[here]), sorted(other.markers[there])):
                yield one, other, (here, there), papers


def _rows(count: int, both: tuple[Part, Part]) -> tuple[list[int], list[int]]:
    """The views of each part."""
    first, second = (list(range(round(part.start * count), round(part.stop * count))) for part in both)
    return first, second


def _spots(frames: list[Keyframe], rows: tuple[list[int], list[int]]) -> list[np.ndarray]:
    """Where papers hang (4, 4 each): on walls, spaced, those first of which the part that has fewer views has most."""
    views = [(_depth_m(frame), frame.intrinsics, np.array(frame.world_from_camera)) for frame in frames]
    tried = [spot for view in views for spot in wall_spots(*view)]
    shown = np.array([[_shows(*view, spot) for view in views] for spot in tried]).reshape(len(tried), len(views))
    counts = np.minimum(shown[:, rows[0]].sum(axis=1), shown[:, rows[1]].sum(axis=1))
    chosen: list[np.ndarray] = []
    for at in np.argsort(-counts, kind="stable").tolist():
        if all(np.linalg.norm(tried[at][:3, 3] - other[:3, 3]) > SPACED_M for other in chosen):
            chosen.append(tried[at])
    return chosen[:MOST_SPOTS]


def _shows(depth_m: np.ndarray, camera: Intrinsics, world_from_camera: np.ndarray, spot: np.ndarray) -> bool:
    """Whether a view has a paper's middle in it, large enough and not from too far aside."""
    x, y, z = transform(inverse(world_from_camera), spot[None, :3, 3])[0].tolist()
    if z <= 0 or FINER * camera.fx_px * LOOK.size_m / z < 1.5 * LOOK.least_px:
        return False
    column, row = round(camera.fx_px * x / z + camera.cx_px), round(camera.fy_px * y / z + camera.cy_px)
    if not (0 <= column < camera.width_px and 0 <= row < camera.height_px):
        return False
    way = world_from_camera[:3, 3] - spot[:3, 3]
    return abs(float(depth_m[row, column]) - z) < 0.1 and bool(way @ spot[:3, 2] > 0.4 * np.linalg.norm(way))


def _seen(frames: list[Keyframe], seed: int, number: int, spots: list[np.ndarray]) -> dict[int, SceneMarker]:
    """The papers as one part's robot has them."""
    part: Part = parts_of(seed)[number]
    chosen, poses, _ = told_poses(part, frames, np.random.default_rng([seed, part.seed]))
    rng = np.random.default_rng([seed, 79, number])
    sightings: dict[int, dict[tuple[int, int], Sighting]] = {}
    for row, (frame, told) in enumerate(zip(chosen, poses, strict=True)):
        depth_m = _depth_m(frame)
        depth_m += NOISE_M * depth_m**2 * rng.normal(size=depth_m.shape).astype(np.float32)
        camera, depth_m = _finer(frame.intrinsics, depth_m)
        camera_from_world = inverse(np.array(frame.world_from_camera))
        papers = [(paper, camera_from_world @ spot) for paper, spot in enumerate(spots)]
        gray, shown = painted(np.full(depth_m.shape, GRAY, np.uint8), depth_m, camera, papers, LOOK.size_m)
        if not shown.any():
            continue
        seen = seen_markers(np.repeat(gray[:, :, None], 3, axis=2), depth_m, camera, LOOK)
        for paper, side_px, pose in zip(seen.ids.tolist(), seen.sides_px, seen.camera_from_marker, strict=True):
            sightings.setdefault(paper, {})[row, 0] = Sighting(told, pose, float(side_px), LOOK.size_m)
    found = {paper: located(MarkerKey(LOOK.dictionary, paper), kept, HELD) for paper, kept in sightings.items()}
    return {paper: marker for paper, marker in found.items() if marker is not None and not marker.doubt}


def _finer(camera: Intrinsics, depth_m: np.ndarray) -> tuple[Intrinsics, np.ndarray]:
    """A camera of more pixels, and its depth image as one that is registered to a finer colour image."""
    width_px, height_px = FINER * camera.width_px, FINER * camera.height_px
    middle_px = (FINER * (middle + 0.5) - 0.5 for middle in (camera.cx_px, camera.cy_px))
    finer = Intrinsics(width_px, height_px, FINER * camera.fx_px, FINER * camera.fy_px, *middle_px)
    measured = cv2.resize((depth_m > 0).astype(np.float32), (width_px, height_px)) > 1 - 1e-3
    return finer, np.where(measured, cv2.resize(depth_m, (width_px, height_px)), np.float32(0))


def _depth_m(frame: Keyframe) -> np.ndarray:
    return images.depth_of(frame, images.MAX_PRINCIPAL_OFFSET)
