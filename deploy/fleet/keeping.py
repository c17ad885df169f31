"""What a fleet's bridge keeps on disk: its numbers; and what it reads there: scenes of former sessions."""

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.fleet.core.doubting import fault_of_scene
from prior_sg.deploy.fleet.core.ids import KINDS, Ids, Kind, Name, Session, Sessions
from prior_sg.deploy.fleet.core.levels import Levels
from prior_sg.deploy.fleet.core.members import Member, member_of_scene
from prior_sg.deploy.fleet.core.merging import Memory
from prior_sg.deploy.fleet.core.update import Numbers
from prior_sg.schemas.names import fault_of_robot
from prior_sg.services.runtime.service import ServiceError
from prior_sg.services.segmenter.core.layers.layer_map import LayerMap


def kept_memory(path: str) -> Memory:
    """The numbers in a file; none where there is no file yet. Raises ServiceError."""
    file = Path(path)
    if not path or not file.exists():
        return Memory()
    try:
        numbers = msgspec.msgpack.decode(file.read_bytes(), type=Numbers)
    except (OSError, msgspec.DecodeError) as error:
        raise ServiceError(f"{path} holds no numbers of a fleet: name another file, or move it away") from error
    ids = Ids()
    for kind, robot, session, number, given in numbers.given:
        ids.adopt(_kind(kind, path), Name(robot, session), number, given)
    frames = {(Name(robot, session), epoch): _pose(rows, path) for robot, session, epoch, rows in numbers.frames}
    levels = Levels(LayerMap(dict(numbers.next_nodes)))
    for level, region, node in numbers.node_of:
        levels.node_of.setdefault(level, {})[region] = node
    return Memory(ids, dict(numbers.region_of), numbers.next_region, frames, _sessions(numbers), levels)


def _sessions(numbers: Numbers) -> Sessions:
    """As kept; of a file from before they were, what it says of whose numbers it holds."""
    found = Sessions()
    for robot, session, epochs, spots in numbers.sessions:
        found.known[Name(robot, session)] = Session({*epochs}, {place: (x, y, z) for place, x, y, z in spots})
    for _, robot, session, _, _ in numbers.given:
        found.note(Name(robot, session))
    for robot, session, epoch, _ in numbers.frames:
        found.note(Name(robot, session), epoch)
    return found


def _pose(rows: Sequence[float], path: str) -> np.ndarray:
    if len(rows) != 16 or not np.isfinite(rows).all():
        raise ServiceError(f"{path} holds no numbers of a fleet: name another file, or move it away")
    return np.array(rows, float).reshape(4, 4)


def _kind(text: str, path: str) -> Kind:
    for kind in KINDS:
        if kind == text:
            return kind
    raise ServiceError(f"{path} numbers {text!r}, which this version does not know")


def keep(path: str, content: bytes) -> None:
    """Write the numbers; a half-written file never counts. Raises OSError."""
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(".partial")
    partial.write_bytes(content)
    partial.replace(file)


def stored_members(named: Sequence[str], sessions: Sessions) -> list[Member]:
    """The maps of former sessions, each given as ROBOT=PATH, the oldest first. Raises ServiceError."""
    from prior_sg.deploy.showing.reading import read_material

    found = []
    for text in named:
        robot, _, path = text.partition("=")
        if not path:
            raise ServiceError(f"{text!r} names no stored scene: write ROBOT=PATH")
        try:
            scene = read_material(path, robot).scene
        except UserError as error:
            raise ServiceError(str(error)) from error
        if fault := fault_of_robot(robot) or fault_of_scene(msgspec.structs.replace(scene, robot=robot)):
            raise ServiceError(f"{path} cannot be merged: {fault}")
        spots_m = dict(zip(scene.place_ids.tolist(), scene.positions_m.tolist(), strict=True))
        name = sessions.name_of(robot, spots_m)
        found.append(member_of_scene(msgspec.structs.replace(scene, robot=robot), name.session))
    return found
