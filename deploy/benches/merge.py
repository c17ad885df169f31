"""`prior-sg bench merge`: do two robots' maps of one home find together, and never those of two homes?

Each home is walked in two parts that share some of the way, each in a frame of its own (see `partial_walks`). The
matcher's answer is right when it is within RIGHT_M at the middle of the first map and RIGHT_RAD in heading. Every
part is then matched with the parts of other homes: any answer but a refusal is a false accept. Where maps have found
together, the merged scene is judged beside one walk through the whole home, with and without drift, and, where a part
has been, beside that part: scores leave out what a map does not cover, so that over the whole home half a map may seem
better than a whole one. Where the truth of a kind of world knows levels above regions, the robots' prior is one for a
task that names them, and levels of the merged map are scored beside those of the whole walks.
"""

import itertools
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from prior_sg.deploy.evaluation.level_metrics import level_scores
from prior_sg.deploy.evaluation.levels import TASKS
from prior_sg.deploy.evaluation.metrics import assign, evaluate
from prior_sg.deploy.evaluation.partial_walks import Part, PartialMap, Walks
from prior_sg.deploy.fleet.core.finding.config import MatchConfig
from prior_sg.deploy.fleet.core.finding.frames import apart
from prior_sg.deploy.fleet.core.finding.matching import Map, map_of, match, weighed
from prior_sg.deploy.fleet.core.finding.verify import Evidence
from prior_sg.deploy.fleet.core.ids import Name
from prior_sg.deploy.fleet.core.members import Relation, member_of_scene
from prior_sg.deploy.fleet.core.merging import Memory, Source, levelled, merged
from prior_sg.deploy.fleet.core.update import merged_of
from prior_sg.schemas.levels import LEVELS
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.scene import Scene
from prior_sg.services.geometry import inverse, transform

SCORED = range(60, 100)
FULL, DRIFTING = Part(0.0, 1.0, 0), Part(0.0, 1.0, 3)  # the whole walk, from true poses and from such as parts have
WORTH = "f1_s", "miou_s_penalised", "accuracy"
RIGHT_M, RIGHT_RAD = 0.5, np.radians(5)
SHARED = (0.05, 0.7)  # share of the walk that both parts hold, drawn anew for each home
DIFFERENT = 1000  # pairs of different homes
LEAST_PLACES = 8  # of a region whose number is looked for the next day
SAME_OBJECT_M = 0.5
OVERLAPS_M2 = (0.0, 10.0, 20.0, 40.0, np.inf)
FOLDER = Path("out/bench/merge")
CFG = MatchConfig()


class Two(NamedTuple):
    """Both parts of one home."""

    seed: int
    maps: tuple[Map, Map]
    parts: tuple[PartialMap, PartialMap]

    @property
    def second_from_first(self) -> np.ndarray:
        """The truth (4, 4)."""
        return np.asarray(self.parts[1].own_from_world @ inverse(self.parts[0].own_from_world))


class Outcome(NamedTuple):
    """Of one home."""

    two: Two
    true: Evidence  # of the true transform
    found: np.ndarray | None  # second_from_first (4, 4), None = refused
    why: str
    gap_m: float
    gap_rad: float

    @property
    def right(self) -> bool:
        """Whether an answer was given, and a right one."""
        return self.found is not None and bool(self.gap_m < RIGHT_M and self.gap_rad < RIGHT_RAD)


def merge_bench(
    seeds: Sequence[int] = SCORED,
    folder: Path = FOLDER,
    *,
    kind: str = "home",
    report: Callable[[str], None] = lambda text: None,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Success, errors, false accepts, and what merged scenes are worth. `report` hears what is being done."""
    walks = Walks(folder, kind=kind, task=TASKS.get(kind, ""))
    outcomes, scores = [], []
    for number, seed in enumerate(seeds, 1):
        report(f"{kind} {seed}, {number} of {len(seeds)}")
        outcomes.append(outcome_of(two_of(walks, seed)))
        if outcomes[-1].right:
            scores.append(worth(walks, outcomes[-1]))
    metrics = figures(outcomes) | means(scores) | resumed(outcomes)
    tried, accepted = false_accepts([one.two for one in outcomes], DIFFERENT, report=report)
    metrics |= {"different_pairs": tried, "false_accepts": len(accepted)}
    return metrics, {"worlds": kind, "homes": len(seeds), "seeds": f"{min(seeds)}-{max(seeds)}", "right_m": RIGHT_M}


def parts_of(seed: int) -> tuple[Part, Part]:
    """Which parts of a home's walk the two robots make."""
    shared = np.random.default_rng([seed, 77]).uniform(*SHARED)
    return Part(0.0, 0.5 + shared / 2, 1), Part(0.5 - shared / 2, 1.0, 2)


def two_of(walks: Walks, seed: int) -> Two:
    """Both parts of a home."""
    first, second = (walks.part(seed, part) for part in parts_of(seed))
    return Two(seed, (map_of(first.scene), map_of(second.scene)), (first, second))


def outcome_of(two: Two, cfg: MatchConfig = CFG) -> Outcome:
    """What the matcher says of two parts of one home."""
    first, second = two.maps
    truth = two.second_from_first
    answer = match(first, second, cfg)
    gap_m, gap_rad = np.inf, np.inf
    if answer.b_from_a is not None:
        gap_m, gap_rad = apart(answer.b_from_a, truth, first.shape.centers_m.mean(axis=0))
    return Outcome(two, weighed(truth, first, second).evidence, answer.b_from_a, answer.why, gap_m, gap_rad)


def figures(outcomes: list[Outcome]) -> dict[str, float]:
    """Of all homes, and by how much floor the parts share."""
    right = [one for one in outcomes if one.right]
    wrong = [one for one in outcomes if one.found is not None and not one.right]
    found: dict[str, float] = {"success": len(right) / len(outcomes), "wrong_transforms": len(wrong)}
    if right:
        found |= {
            "error_m_p50": statistics.median(one.gap_m for one in right),
            "error_m_max": max(one.gap_m for one in right),
            "error_deg_p50": float(np.degrees(statistics.median(one.gap_rad for one in right))),
        }
    for low, high in itertools.pairwise(OVERLAPS_M2):
        some = [one for one in outcomes if low <= one.true.overlap_m2 < high]
        found[f"homes_overlap_{low:g}_{high:g}_m2"] = len(some)
        found[f"success_overlap_{low:g}_{high:g}_m2"] = sum(one.right for one in some) / max(len(some), 1)
    return found


def false_accepts(
    homes: Sequence[Two],
    most: int,
    cfg: MatchConfig = CFG,
    report: Callable[[str], None] = lambda text: None,
) -> tuple[int, list[tuple[int, int]]]:
    """How many pairs of maps of different homes were tried, and the homes of those that were taken for one."""
    both = itertools.product((0, 1), repeat=2)
    pairs = [(*homes_, *parts) for homes_, parts in itertools.product(itertools.combinations(homes, 2), both)]
    order = np.random.default_rng(0).permutation(len(pairs))[:most]
    accepted = []
    for number, (one, other, here, there) in enumerate((pairs[at] for at in order.tolist()), 1):
        report(f"different homes, pair {number} of {len(order)}")
        if match(one.maps[here], other.maps[there], cfg).b_from_a is not None:
            accepted.append((one.seed, other.seed))
    return len(order), accepted


def worth(walks: Walks, outcome: Outcome) -> dict[str, float]:
    """Scores of one home's merged scene, by what was scored and where. Raises ValueError where none was found."""
    if outcome.found is None:
        raise ValueError("the parts have not found together")
    whole, truth = walks.part(outcome.two.seed, FULL), walks.truth(outcome.two.seed)
    drifting = walks.part(outcome.two.seed, DRIFTING)
    first, second = outcome.two.parts
    world_from_first = inverse(first.own_from_world)
    poses = world_from_first, world_from_first @ inverse(outcome.found)
    sources = [
        Source(Name(f"robot{k}", 0), part.scene, pose)
        for k, (part, pose) in enumerate(zip((first, second), poses, strict=True))
    ]
    prior = walks.prior(outcome.two.seed)
    alone = [merged("home", [source], Memory()).scene for source in sources]
    one_robot = Source(Name("robot", 0), drifting.scene, inverse(drifting.own_from_world))
    scenes = {
        "merged": _with_levels(sources, prior),
        "full": whole.scene,
        "full_drifting": _with_levels([one_robot], prior),
    }
    found = {
        f"{score}_{name}": value
        for name, scene in scenes.items()
        for score, value in evaluate(scene, whole.voxels, truth).items()
        if score in WORTH
    }
    for name, scene in scenes.items():
        for above, of_level in level_scores(scene, whole.voxels, truth).items():
            found |= {f"{score}_{above}_{name}": value for score, value in of_level.items()}
    found["f1_s_better_part"] = max(evaluate(scene, whole.voxels, truth)["f1_s"] for scene in alone)
    there: dict[str, list[float]] = {}
    for part in alone:
        own = msgspec.structs.replace(whole.voxels, free=assign(part, whole.voxels, truth).voxels)
        for name, scene in (scenes | {"part": part}).items():
            for score, value in evaluate(scene, own, truth).items():
                if score in WORTH:
                    there.setdefault(f"{score}_where_a_part_was_{name}", []).append(value)
    return found | {name: statistics.mean(values) for name, values in there.items()}


def _with_levels(sources: list[Source], prior: Prior) -> Scene:
    """The merged scene, its levels by the prior as far as that names some."""
    memory = Memory()
    return levelled(merged("home", sources, memory), memory, prior).scene


def means(scores: list[dict[str, float]]) -> dict[str, float]:
    """Means over homes, and what F1_S of merged scenes has on that of others, with its standard error."""
    if not scores:
        return {}
    found = {name: statistics.mean(one[name] for one in scores) for name in scores[0]}
    whole = [("", rival, f"gain_on_{rival}") for rival in ("full", "full_drifting")]
    above = [(f"{one}_", rival, f"gain_{one}_on_{rival}") for one in LEVELS for _, rival, _ in whole]
    for where, rival, name in (*whole, ("where_a_part_was_", "part", "gain_on_part"), *above):
        if f"f1_s_{where}merged" not in scores[0]:
            continue
        gaps = [one[f"f1_s_{where}merged"] - one[f"f1_s_{where}{rival}"] for one in scores]
        found[name] = statistics.mean(gaps)
        if len(gaps) > 1:
            found[f"{name}_sem"] = statistics.stdev(gaps) / len(gaps) ** 0.5
    return found


def resumed(outcomes: list[Outcome]) -> dict[str, float]:
    """The second part as the next day's session of the robot that walked the first, in the same home: shares of regions
    and of objects seen on both days that keep their numbers, and objects that were wrongly said to have gone or moved.
    """
    regions, objects, changes = [], [], []
    for one in outcomes:
        if one.found is None or not one.right:
            continue
        former, present = (member_of_scene(part.scene, day) for day, part in enumerate(one.two.parts))
        former.relation, present.former = Relation(np.eye(4), given=True), False
        present.relation = Relation(inverse(one.found), given=False)
        memory = Memory()
        before, _ = merged_of("home", [former], memory)
        after, said = merged_of("home", [present, former], memory)
        regions += _regions_kept(before.scene, after.scene)
        together = [{(Name(m.robot, m.session), m.id) for m in item.members} for item in after.scene.objects]
        pairs = _both_days(one.two)
        objects += [{(former.name, a), (present.name, b)} in together for a, b in pairs]
        changes.append(len(said))
    return {
        "resumed_regions_kept": float(np.mean(regions)) if regions else float("nan"),
        "resumed_objects_kept": float(np.mean(objects)) if objects else float("nan"),
        "resumed_wrong_changes_per_home": float(np.mean(changes)) if changes else float("nan"),
    }


def _regions_kept(before: Scene, after: Scene) -> list[bool]:
    """Of each region that had some places and still has: whether most of these are in the region of its number."""
    now = dict(zip(after.place_ids.tolist(), after.place_regions.tolist(), strict=True))
    kept = []
    for region in before.regions:
        places = [now[p] for p in before.place_ids[before.place_regions == region.id].tolist() if p in now]
        if region.place_count >= LEAST_PLACES and len(places) >= LEAST_PLACES / 2:
            kept.append(places.count(region.id) > len(places) / 2)
    return kept


def _both_days(two: Two) -> list[tuple[int, int]]:
    """Numbers of objects of both parts that are truly one: of one name, within SAME_OBJECT_M under the true motion."""
    first, second = (part.scene.objects for part in two.parts)
    spots_m = transform(two.second_from_first, np.array([item.position_m for item in first]).reshape(-1, 3))
    return [
        (a.id, b.id)
        for a, spot_m in zip(first, spots_m, strict=True)
        for b in second
        if a.label == b.label and np.linalg.norm(spot_m - np.array(b.position_m)) < SAME_OBJECT_M
    ]
