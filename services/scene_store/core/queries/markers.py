"""Printed markers: where they are, and from where they can be seen (pure)."""

import numpy as np

from prior_sg.schemas.answers import MarkerInRegion, Markers
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.names import same
from prior_sg.schemas.queries import MarkersOf
from prior_sg.schemas.scene import Scene
from prior_sg.services import geometry
from prior_sg.services.scene_store.core.queries.index import Index
from prior_sg.services.scene_store.core.queries.labels import MOST_IDS
from prior_sg.services.scene_store.core.queries.things import thing

NO_MARKERS = (
    "the scene has no printed marker: they are looked for where feature_pyramid.markers.dictionary is set, and one is "
    "known once several keyframes agree"
)


def markers(index: Index, question: MarkersOf) -> Markers:
    """Each with the region of the nearest place."""
    found = numbered(index.scene, question.id, question.dictionary)
    if not found:
        return Markers(reason=nothing_numbered(index.scene, question.id, question.dictionary))
    return Markers(markers=[_held(index, one) for one in found[: question.limit]], total=len(found))


def numbered(scene: Scene, number: int | None, dictionary: str = "") -> list[SceneMarker]:
    """The markers of a number, of a dictionary; of any where none is said."""
    return [one for one in scene.markers if number in (None, one.id) and same(dictionary) in ("", same(one.dictionary))]


def rows_before(index: Index, marker: SceneMarker) -> np.ndarray:
    """Rows (n,) of the places from where a marker can be seen."""
    pose = geometry.pose_from_quaternion(np.array(marker.position_m), np.array(marker.quaternion_xyzw))
    return geometry.rows_before(pose, index.points_m)


def gaps_of(index: Index, marker: SceneMarker, rows: np.ndarray) -> np.ndarray:
    """Metres (n,) from a marker to the centres of some places (n,)."""
    return np.linalg.norm(index.points_m[rows] - np.array(marker.position_m), axis=1)


def nothing_numbered(scene: Scene, number: int | None, dictionary: str = "") -> str:
    """That there is no such marker, and which there are, in one sentence."""
    there = scene.markers
    if not there:
        return NO_MARKERS
    wanted = " ".join(["marker", *([str(number)] if number is not None else [])])
    of = f" of the dictionary {dictionary!r}" if dictionary else ""
    held = ", ".join(str(one.key) for one in there[:MOST_IDS])
    more = f" and {len(there) - MOST_IDS} others" if len(there) > MOST_IDS else ""
    return f"there is no {wanted}{of}; the scene has {held}{more}"


def _held(index: Index, marker: SceneMarker) -> MarkerInRegion:
    rows = rows_before(index, marker)
    if not len(rows):
        return MarkerInRegion(marker=marker)
    holder = int(index.region_rows[rows[gaps_of(index, marker, rows).argmin()]])
    return MarkerInRegion(marker=marker, region=thing(index, "region", holder) if holder >= 0 else None)
