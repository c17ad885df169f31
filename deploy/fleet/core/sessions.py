"""What a former map still tells where a present one sees, and what has changed since (pure)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from prior_sg.deploy.fleet.core.finding.shape import Shape
from prior_sg.deploy.fleet.core.finding.verify import CLEAR_M, SEEN_M
from prior_sg.deploy.fleet.core.fusing import ALIKE_M, ONE_M
from prior_sg.deploy.fleet.core.things import SAME_M
from prior_sg.deploy.parts import part_of, spots_of
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.scene import Scene
from prior_sg.services.geometry import transform


class Present(NamedTuple):
    """A present map in the fleet's frame."""

    scene: Scene
    fleet_from_own: np.ndarray  # (4, 4)

    def shape(self) -> Shape:
        """Its free space there."""
        return Shape(transform(self.fleet_from_own, self.scene.positions_m.astype(float)), self.scene.radii_m)

    def spots_m(self) -> np.ndarray:
        """Where its objects are (object, 3)."""
        return transform(self.fleet_from_own, spots_of(self.scene.objects))


class Change(NamedTuple):
    """An object that is no longer where it was; `to_m` is where one of its name stands now, None = nowhere seen."""

    label: str
    number: int  # the former map's
    from_m: np.ndarray  # (3,) fleet
    to_m: np.ndarray | None


def remembered(former: Scene, fleet_from_own: np.ndarray, present: Sequence[Present]) -> tuple[Scene, list[Change]]:
    """The former scene less what the present ones see otherwise, and which of its objects have gone or moved.

    Where a present map knows free space its places count; a former place there stays only as the same place.
    """
    spots_m = transform(fleet_from_own, former.positions_m.astype(float))
    kept = np.ones(len(spots_m), bool)
    for one in present:
        shape = one.shape()
        if not (len(shape.radii_m) and len(spots_m)):
            continue
        distances_m, rows = shape.tree.query(spots_m)
        same = (distances_m < ONE_M) & (np.abs(shape.radii_m[rows] - former.radii_m) < ALIKE_M)
        kept &= same | (shape.depth_m(spots_m) < SEEN_M)
    lost = [item for item in former.objects if _is_gone(item, fleet_from_own, present)]
    numbers = {item.id for item in lost}
    stays = [item for item in former.objects if item.id not in numbers]
    return part_of(former, kept, stays), _changes(lost, stays, fleet_from_own, present)


def _is_gone(item: SceneObject, fleet_from_own: np.ndarray, present: Sequence[Present]) -> bool:
    """Whether a present map knows free space where it stood, and no object of its name."""
    spot_m = transform(fleet_from_own, spots_of([item]))
    for one in present:
        shape = one.shape()
        if not len(shape.radii_m) or float(shape.depth_m(spot_m)[0]) < CLEAR_M:
            continue
        here = [
            near.label == item.label and gap_m < SAME_M
            for near, gap_m in zip(
                one.scene.objects, np.linalg.norm(one.spots_m() - spot_m, axis=1).tolist(), strict=True
            )
        ]
        if not any(here):
            return True
    return False


def _changes(
    lost: list[SceneObject], stays: list[SceneObject], fleet_from_own: np.ndarray, present: Sequence[Present]
) -> list[Change]:
    """Each lost object, with the nearest present one of its name that no former object accounts for."""
    former_m = transform(fleet_from_own, spots_of(stays))
    labels = np.array([item.label for item in stays])
    free: list[tuple[str, np.ndarray]] = []
    for one in present:
        for item, spot_m in zip(one.scene.objects, one.spots_m(), strict=True):
            known = (labels == item.label) & (np.linalg.norm(former_m - spot_m, axis=1) < SAME_M) if len(stays) else []
            if not np.any(known):
                free.append((item.label, spot_m))
    found = []
    for item in lost:
        from_m = transform(fleet_from_own, spots_of([item]))[0]
        options = [at for at, (label, _) in enumerate(free) if label == item.label]
        nearest = min(options, key=lambda at: float(np.linalg.norm(free[at][1] - from_m)), default=None)
        found.append(Change(item.label, item.id, from_m, None if nearest is None else free.pop(nearest)[1]))
    return found


def said(change: Change, merged: Scene) -> str:
    """A change as a sentence, by the regions of the merged scene."""
    before = _region_at(change.from_m, merged)
    if change.to_m is None:
        return f"{change.label} is gone from {before}"
    after = _region_at(change.to_m, merged)
    if before == after:
        return f"{change.label} moved by {np.linalg.norm(change.to_m - change.from_m):.1f} m within {before}"
    return f"{change.label} moved from {before} to {after}"


def _region_at(spot_m: np.ndarray, scene: Scene) -> str:
    labels = {region.id: region.label for region in scene.regions}
    if not len(scene.place_ids):
        return "nowhere known"
    nearest = int(np.argmin(np.linalg.norm(scene.positions_m - spot_m, axis=1)))
    return labels.get(int(scene.place_regions[nearest]), "") or "an unnamed region"
