"""Do two maps show the same place, and how do they lie to each other? Refused when unsure (pure)."""

from dataclasses import dataclass, replace

import msgspec
import numpy as np

from prior_sg.deploy.fleet.core.finding.config import MatchConfig
from prior_sg.deploy.fleet.core.finding.consistency import Hypothesis, hypotheses
from prior_sg.deploy.fleet.core.finding.frames import apart
from prior_sg.deploy.fleet.core.finding.landmarks import landmarks_of, names_in
from prior_sg.deploy.fleet.core.finding.marking import Marked, by_markers, doubts_of
from prior_sg.deploy.fleet.core.finding.refine import refined
from prior_sg.deploy.fleet.core.finding.shape import Shape, shape_of
from prior_sg.deploy.fleet.core.finding.verify import THROUGH_WORTH, WALL_WORTH, Evidence, evidence_of, walls_of
from prior_sg.schemas.scene import Scene
from prior_sg.services.geometry import transform

DOUBT = 0.8  # of what is asked for when maps are first related: a relation that has less is given up
PROMISE_STEP = 4  # one of so many points of a wall is looked at before a motion is fitted


@dataclass(frozen=True)
class Found:
    """One way in which two maps might lie together, after fitting."""

    b_from_a: np.ndarray  # (4, 4)
    evidence: Evidence


@dataclass(frozen=True)
class Match:
    """The answer. Without `b_from_a` the maps are not known to show the same place, for the reason `why`."""

    b_from_a: np.ndarray | None
    why: str
    found: list[Found]  # all that was looked at, the best first
    by_markers: bool = False  # whether markers have had a say


@dataclass(frozen=True)
class Map:
    """A scene, with what is computed of it once."""

    scene: Scene
    shape: Shape


def map_of(scene: Scene) -> Map:
    """A scene as it is matched."""
    return Map(scene, shape_of(scene))


def match(a: Map, b: Map, cfg: MatchConfig) -> Match:
    """How b lies to a."""
    for scene in (a.scene, b.scene):
        if len(scene.place_ids) < cfg.least_places:
            return Match(None, f"{scene.robot} has only {len(scene.place_ids)} places yet", [])
    said = marked(a, b, cfg)
    if said is not None:
        return said
    doubts = doubts_of(a.scene, b.scene) if cfg.markers else ""
    found = _by_landmarks(a, b, cfg)
    return replace(found, why=f"{doubts}; {found.why}", by_markers=True) if doubts and found.why else found


def _by_landmarks(a: Map, b: Map, cfg: MatchConfig) -> Match:
    """How b lies to a by objects, hubs and doors."""
    names = names_in(a.scene, b.scene)
    tried = hypotheses(landmarks_of(a.scene, names), landmarks_of(b.scene, names), cfg)
    tried.sort(key=lambda one: -_promise(one, a.shape, b.shape))
    found = [weighed(refined(one.b_from_a, a.shape, b.shape), a, b) for one in tried[: cfg.refined]]
    found.sort(key=lambda one: -one.evidence.total)
    if not found:
        return Match(None, "no landmarks of both agree", [])
    best = found[0]
    why = fault_of(best.evidence, cfg) or _rivalled(best, found[1:], a, cfg)
    return Match(None if why else best.b_from_a, why, found)


def marked(a: Map, b: Map, cfg: MatchConfig) -> Match | None:
    """How b lies to a by markers that both are sure of, unless walls contradict them; None where there are none.

    A marker's heading is good to a few degrees: walls mend it, as long as the markers stay together.
    """
    said = by_markers(a.scene, b.scene, cfg) if cfg.markers else None
    if said is None or said.b_from_a is None:
        return None if said is None else Match(None, said.why, [], by_markers=True)
    tried = [said.b_from_a]
    mended = refined(said.b_from_a, a.shape, b.shape)
    if _off_m(mended, said) <= max(cfg.markers_m, _off_m(said.b_from_a, said)):
        tried.append(mended)
    best = max((weighed(pose, a, b) for pose in tried), key=lambda one: one.evidence.total)
    told = best.evidence.walls_same + best.evidence.walls_through
    why = ""
    if told >= cfg.markers_walls_least and best.evidence.fitting < cfg.fitting_least:
        why = f"by the markers that {a.scene.robot} and {b.scene.robot} share, {_through(best.evidence)}"
    return Match(None if why else best.b_from_a, why, [best], by_markers=True)


def _off_m(b_from_a: np.ndarray, said: Marked) -> float:
    """How far a motion leaves the farthest of the shared markers apart."""
    return float(np.linalg.norm(transform(b_from_a, said.spots_a_m) - said.spots_b_m, axis=1).max())


def again(b_from_a: np.ndarray, a: Map, b: Map, cfg: MatchConfig) -> Match:
    """A known motion, fitted to maps that have changed; refused where they contradict it by now."""
    lenient = msgspec.structs.replace(
        cfg, fitting_least=DOUBT * cfg.fitting_least, landmarks_least=0, evidence_least=0.0
    )
    said = marked(a, b, lenient)
    if said is not None:
        return said
    found = weighed(refined(b_from_a, a.shape, b.shape), a, b)
    why = fault_of(found.evidence, lenient)
    return Match(None if why else found.b_from_a, why, [found])


def _promise(one: Hypothesis, a: Shape, b: Shape) -> float:
    """What a motion may be worth, by its landmarks and a part of the walls."""
    same, through = walls_of(one.b_from_a, a, b, PROMISE_STEP)
    return one.weight + PROMISE_STEP * (WALL_WORTH * same - THROUGH_WORTH * through)


def weighed(b_from_a: np.ndarray, a: Map, b: Map) -> Found:
    """A motion with what speaks for it."""
    return Found(b_from_a, evidence_of(b_from_a, (a.scene, a.shape), (b.scene, b.shape)))


def fault_of(evidence: Evidence, cfg: MatchConfig) -> str:
    """Why this evidence does not suffice, as a sentence; empty when it does."""
    if evidence.overlap_m2 < cfg.overlap_least_m2:
        return f"they share only {evidence.overlap_m2:.0f} m2 of floor, {cfg.overlap_least_m2:g} are needed"
    if evidence.fitting < cfg.fitting_least:
        return _through(evidence)
    if evidence.walls_same < cfg.walls_least:
        return f"only {evidence.walls_same} points of walls are the same, {cfg.walls_least} are needed"
    if evidence.objects_same < cfg.landmarks_least:
        return f"only {evidence.objects_same} objects agree, {cfg.landmarks_least} are needed"
    if evidence.total < cfg.evidence_least:
        return f"the evidence, {evidence.total:.1f}, is below {cfg.evidence_least:g}"
    return ""


def _through(evidence: Evidence) -> str:
    return f"{1 - evidence.fitting:.0%} of the walls would stand in what the other map knows as free"


def _rivalled(best: Found, others: list[Found], a: Map, cfg: MatchConfig) -> str:
    """Another way to lie together that is nearly as good."""
    middle_m = a.shape.centers_m.mean(axis=0)
    for other in others:
        gap_m, gap_rad = apart(best.b_from_a, other.b_from_a, middle_m)
        differs = gap_m > cfg.distinct_m or gap_rad > cfg.distinct_rad
        if differs and other.evidence.total > cfg.rival_most * best.evidence.total:
            return f"another way to lie together, {gap_m:.0f} m away, is nearly as likely"
    return ""
