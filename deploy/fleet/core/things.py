"""Objects of several maps in one frame: which are one (pure)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from prior_sg.deploy.fleet.core.fusing import Placed
from prior_sg.schemas.objects import SceneObject
from prior_sg.services.geometry import transform

SAME_M, OTHER_M = 0.8, 0.35  # objects are one within that distance, when their names agree, when they do not
MOST_SURE = 0.99


class Thing(NamedTuple):
    """One object of one map, in the fleet's frame."""

    map: int
    number: int  # the map's own id
    id: int  # the fleet's
    item: SceneObject  # in the fleet's frame, under the fleet's id


def things_of(maps: Sequence[Placed], ids: Sequence[np.ndarray]) -> list[list[Thing]]:
    """Objects that are one, together; every object is in one of the lists. `ids` (object,) by map are the fleet's."""
    every = [
        Thing(k, item.id, number, moved(item, one.fleet_from_own, number))
        for k, one in enumerate(maps)
        for item, number in zip(one.scene.objects, ids[k].tolist(), strict=True)
    ]
    if not every:
        return []
    spots_m = np.array([thing.item.position_m for thing in every])
    gaps_m = np.linalg.norm(spots_m[:, None] - spots_m, axis=2)
    owners = np.array([thing.map for thing in every])
    alike = np.array([thing.item.label for thing in every])[:, None] == np.array([t.item.label for t in every])
    near = (owners[:, None] < owners) & (gaps_m < np.where(alike, SAME_M, OTHER_M))
    first, second = np.nonzero(near)
    group = list(range(len(every)))
    held: list[set[int]] = [{int(owner)} for owner in owners]
    for at in np.argsort(gaps_m[first, second], kind="stable").tolist():
        one, other = sorted((_root(group, int(first[at])), _root(group, int(second[at]))))
        if not held[one] & held[other]:  # of one map no two objects become one
            group[other] = one
            held[one] |= held[other]
    together: dict[int, list[Thing]] = {}
    for at, thing in enumerate(every):
        together.setdefault(_root(group, at), []).append(thing)
    return list(together.values())


def joined(things: list[Thing]) -> SceneObject:
    """What several maps tell of one object: its place and box by how often each saw it, its name by belief."""
    if len(things) == 1:
        return things[0].item
    items = [thing.item for thing in things]
    weights = np.array([max(item.frames, 1) for item in items], float)
    weights /= weights.sum()
    position, low, high = (
        tuple((weights @ np.array([getattr(item, name) for item in items])).tolist())
        for name in ("position_m", "min_m", "max_m")
    )
    odds: dict[str, float] = {}
    for item in items:
        sure = min(max(item.probability, 1 - MOST_SURE), MOST_SURE)
        odds[item.label] = odds.get(item.label, 0.0) + float(np.log(sure / (1 - sure)))
    label = max(sorted(odds), key=lambda name: odds[name])
    rivals = sum(np.exp(value) for name, value in odds.items() if name != label)
    probability = float(np.exp(odds[label]) / (1 + np.exp(odds[label]) + rivals))
    return SceneObject(
        id=min(item.id for item in items),
        label=label,
        probability=min(probability, MOST_SURE),
        known=max(item.known for item in items),
        position_m=position,
        min_m=low,
        max_m=high,
        frames=sum(item.frames for item in items),
    )


def moved(item: SceneObject, fleet_from_own: np.ndarray, number: int) -> SceneObject:
    """An object in the fleet's frame, under another id; its box keeps its middle and about its extent."""
    low, high = np.array(item.min_m), np.array(item.max_m)
    turned = np.abs(fleet_from_own[:3, :3])
    turned = turned / turned.sum(axis=1, keepdims=True)  # a box turned by 45 degrees is no larger than what is in it
    middle_m = transform(fleet_from_own, ((low + high) / 2)[None])[0]
    half_m = turned @ (high - low) / 2
    position_m = transform(fleet_from_own, np.array(item.position_m)[None])[0]
    return SceneObject(
        id=number,
        label=item.label,
        probability=item.probability,
        known=item.known,
        position_m=tuple(position_m.tolist()),
        min_m=tuple((middle_m - half_m).tolist()),
        max_m=tuple((middle_m + half_m).tolist()),
        frames=item.frames,
    )


def _root(group: list[int], at: int) -> int:
    while group[at] != at:
        at = group[at]
    return at
