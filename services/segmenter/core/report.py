"""What the segmenter tells: deltas of regions and beliefs, and why a place carries its label (pure)."""

from collections.abc import Set
from typing import Any

import msgspec
import numpy as np

from prior_sg.schemas.foresight import Foresight
from prior_sg.schemas.regions import (
    ExpertVote,
    NeighbourPull,
    PosteriorReply,
    PosteriorRequest,
    Region,
    RegionDelta,
    RegionEvent,
)
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.energy import posteriors
from prior_sg.services.segmenter.core.foresight.openings import openings_of
from prior_sg.services.segmenter.core.foresight.telling import differs, foresight
from prior_sg.services.segmenter.core.inference import field_of, temperature, votes, weights
from prior_sg.services.segmenter.core.map.table import UNLABELLED
from prior_sg.services.segmenter.core.regions import components, ledger
from prior_sg.services.segmenter.core.state import State


def publish(
    state: State, events: list[RegionEvent], everything: bool, cfg: Config, idle: bool = False
) -> RegionDelta | None:
    """What followers do not know yet; with `everything`, all. What lies beyond is told if `idle`."""
    places, regions = state.map.places, state.regions
    changed = everything or bool(regions.disturbed)
    others = frozenset(regions.disturbed | regions.reformed)
    regions.describe(_described(state, everything, cfg))
    if changed:
        _renew_layers(state, None if everything else others, cfg)
    else:
        state.layers.forget(others)
    fresh = np.arange(len(places.labels)) if everything else np.flatnonzero(places.unbelieved)
    places.unbelieved[:] = False
    foreseen = _foreseen(state, cfg) if (idle or everything) and cfg.foresight.enabled else None
    return regions.ledger.tell(
        _head(state, fresh),
        places.slots[fresh],
        _beliefs(state, fresh, cfg),
        regions.known,
        events,
        nodes=state.layers.known,
        foresight=foreseen,
        everything=everything,
        tolerance=cfg.posterior_change,
    )


def _renew_layers(state: State, changed: Set[int] | None, cfg: Config) -> None:
    """Find the levels above the regions again, of which only `changed` are others, None = all; and name each region's
    zone."""
    regions = state.regions
    assert regions.storeys is not None
    graph, places = state.map.graph, state.map.places
    levels = state.aim.aligned.levels
    state.layers.renew(regions.known, graph, places, regions.storeys, levels=levels, cfg=cfg.layers, changed=changed)
    zones = state.layers.zones
    moved = [number for number, region in regions.known.items() if region.parent != zones.get(number, "")]
    for number in moved:
        regions.known[number] = msgspec.structs.replace(regions.known[number], parent=zones.get(number, ""))


def _foreseen(state: State, cfg: Config) -> Foresight | None:
    """What is expected beyond the map's openings, when it is news."""
    place_map, held = state.map, state.regions
    found = openings_of(place_map.graph, place_map.places, place_map.frontiers, cfg.foresight)
    now = foresight(found, held.known, state.aim.aligned.prior, cfg.foresight)
    return now if differs(held.ledger.foresight, now, cfg.foresight) else None


def _head(state: State, fresh: np.ndarray) -> RegionDelta:
    """From what the map is made: a delta that tells nothing else. `fresh` (n,): places whose beliefs may be others."""
    aligned = state.aim.aligned
    return msgspec.structs.replace(
        ledger.nothing(state.robot, state.epoch, aligned.labels),
        stamp_ns=state.stamp_ns,
        prior_digest=aligned.digest,
        environment=aligned.prior.environment,
        task=aligned.prior.task,
        space=state.seen.spaces.force if len(state.seen.archive) else "",
        energy=state.terms.energy(field_of(state), state.map.places.labels, state.map.ties, fresh),
    )


def _beliefs(state: State, rows: np.ndarray, cfg: Config) -> ledger.Beliefs:
    """What is believed of some places, as it travels."""
    places = state.map.places
    return ledger.Beliefs(
        place_ids=state.map.graph.ids[rows],
        regions=places.regions[rows],
        posteriors=places.posteriors[rows].astype(np.float16),
        unknown=(1.0 - known_mass(state, rows, cfg)).astype(np.float16),
        predicted=state.seen.evidence.trust[places.slots[rows]] < cfg.predicted_trust,
    )


def known_mass(state: State, rows: np.ndarray, cfg: Config) -> np.ndarray:
    """Share (row,) of a place's belief that rests on something seen and known: c_vis T / (T + T_half)."""
    trust = state.seen.evidence.trust[state.map.places.slots[rows]]
    return state.map.places.sight[rows] * trust / (trust + cfg.trust_half)


def _described(state: State, everything: bool, cfg: Config) -> dict[int, Region]:
    """All regions; figures of those that were disturbed are computed again, and rounded, so that a region is sent again
    only when they visibly change.
    """
    graph, places = state.map.graph, state.map.places
    wanted = state.regions.wanted(everything)
    rows = np.flatnonzero(wanted[places.regions])
    order = rows[np.argsort(places.regions[rows], kind="stable")]
    ids, starts = np.unique(places.regions[order], return_index=True)
    border = components.border(graph, places.regions, set(ids.tolist()), cfg.door_clearance_m)
    objects = components.members(state.objects.view, graph.positions_m, places.regions, rows)
    known, reformed = state.regions.known, state.regions.reformed
    found = {} if everything else dict(known)
    for number in np.flatnonzero(wanted).tolist():
        found.pop(number, None)
    for number, members in zip(ids.tolist(), np.split(order, starts[1:]), strict=False):
        formed = everything or number in reformed or number not in known
        found[number] = msgspec.structs.replace(
            _formed(state, members, cfg) if formed else known[number],
            **_believed(state, members, cfg),
            neighbour_ids=border.neighbours.get(number, []),
            transitions=border.transitions.get(number, []),
            object_ids=objects.get(number, []),
        )
    return found


def _formed(state: State, rows: np.ndarray, cfg: Config) -> Region:
    """What the places `rows` of one region say of its shape."""
    positions_m, radii_m = state.map.graph.positions_m[rows], state.map.graph.radii_m[rows]
    x, y, z = positions_m.mean(axis=0).tolist()
    return Region(
        id=int(state.map.places.regions[rows[0]]),
        label="",
        place_count=len(rows),
        probability=0.0,
        position_m=(round(x, 2), round(y, 2), round(z, 2)),
        area_m2=round(components.footprint_m2(positions_m, radii_m, cfg.footprint_cell_m), 2),
        hull_m=components.hull_m(positions_m, radii_m),
    )


def _believed(state: State, rows: np.ndarray, cfg: Config) -> dict[str, Any]:
    """What the places `rows` of one region say of its label, by the fields of Region."""
    places, label = state.map.places, int(state.map.places.labels[rows[0]])
    predicted = state.seen.evidence.trust[places.slots[rows]] < cfg.predicted_trust
    return {
        "label": state.aim.aligned.labels[label],
        "probability": round(float(places.posteriors[rows, label].mean()), 2),
        "unknown": round(1.0 - float(known_mass(state, rows, cfg).mean()), 2),
        "predicted": bool(predicted.mean() > 0.5),
    }


def snapshot(state: State) -> RegionDelta:
    """Everything published so far, as one delta."""
    return state.regions.ledger.snapshot(state.robot, state.epoch)


def explain(state: State, request: PosteriorRequest, cfg: Config) -> PosteriorReply:
    """Each expert's vote on one place, its neighbours' pull, and what follows, as of the last update."""
    row = int(state.map.graph.rows(np.array([request.place_id]))[0])
    if row < 0 or state.aim.in_force is None or state.map.places.labels[row] == UNLABELLED:
        return PosteriorReply(robot=state.robot, place_id=request.place_id, found=False)
    places, names, near = state.map.places, state.aim.in_force.labels, state.map.ties
    rows, slot = np.array([row]), int(places.slots[row])
    answers = votes(state, rows, cfg)
    heard = {name: float(weight[0]) for name, weight in weights(state, answers, cfg).items()}
    unary = sum(-heard[name] * log[0] for name, (log, _) in answers.items())
    costs = posteriors.conditional_costs(field_of(state), near, places.labels, rows)
    arcs = range(near.starts[row], near.starts[row + 1])
    return PosteriorReply(
        robot=state.robot,
        place_id=request.place_id,
        found=True,
        label=names[places.labels[row]],
        labels=names,
        posterior=posteriors.posteriors(costs, temperature(state, cfg))[0].tolist(),
        unary=unary.tolist(),
        votes=[
            ExpertVote(
                expert=name,
                confidence=float(sure[0]),
                weight=heard[name],
                log_probabilities=log[0].tolist(),
            )
            for name, (log, sure) in answers.items()
        ],
        frames=int(state.seen.evidence.frames[slot]),
        trust=float(state.seen.evidence.trust[slot]),
        position_m=tuple(state.map.graph.positions_m[row].tolist()),
        region=int(places.regions[row]),
        pull=(costs[0] - places.unary[row]).tolist(),
        neighbours=[
            NeighbourPull(
                place_id=int(state.map.graph.ids[near.neighbours[at]]),
                label=names[places.labels[near.neighbours[at]]],
                weight=float(near.weights[at]),
            )
            for at in arcs
        ],
        unknown=1.0 - float(known_mass(state, rows, cfg)[0]),
        predicted=bool(state.seen.evidence.trust[slot] < cfg.predicted_trust),
        temperature=temperature(state, cfg),
        inclination_rad=float(places.inclination_rad[row]),
    )
