"""What can be changed over HTTP: the task, and the poses of keyframes."""

from typing import Annotated

import msgspec
import numpy as np
from litestar import Response, post, put
from litestar.datastructures import State
from litestar.params import JSONBody

from prior_sg.deploy.serving.errors import FaultyRequestError
from prior_sg.deploy.serving.parameters import FAULTS, Robot, system_of
from prior_sg.deploy.serving.system import MOST_POSES
from prior_sg.schemas.names import LONGEST_TEXT

Seconds = Annotated[float, msgspec.Meta(ge=0.1, le=300.0)]
Text = Annotated[str, msgspec.Meta(max_length=LONGEST_TEXT)]
Row = tuple[float, float, float, float]


class NewTask(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A task in plain words; without an environment, the one in force stays; `regions` fixes their names."""

    task: Annotated[str, msgspec.Meta(min_length=1, max_length=LONGEST_TEXT)]
    environment: Text = ""
    regions: Annotated[list[str], msgspec.Meta(max_length=100)] = []
    wait_s: Seconds = 60.0


class TaskTaken(msgspec.Struct, frozen=True):
    """What came of a task. With status 202 the regions do not follow it yet, and `note` says so; with 200 it says where
    the map still grows. `may_be` is what regions can be called: the names that were asked for, else the prior's."""

    robot: str
    prior_digest: str
    prior_note: str
    seconds: float
    may_be: list[str]
    labels: list[str] = []  # that regions have now
    note: str = ""


class CorrectedPose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where the camera of a keyframe was: a rigid transform, rows of a matrix."""

    frame: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
    world_from_camera: tuple[Row, Row, Row, Row]


class Poses(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Corrected poses, as after a loop closure."""

    poses: Annotated[list[CorrectedPose], msgspec.Meta(min_length=1, max_length=MOST_POSES)]
    wait_s: Seconds = 60.0


class PosesTaken(msgspec.Struct, frozen=True):
    """How long the map took to take them."""

    robot: str
    poses: int
    seconds: float


@put("/v1/{robot:str}/task", responses=FAULTS)
async def switch_task(state: State, robot: Robot, data: JSONBody[NewTask]) -> Response[TaskTaken]:
    """Give the robot another task and wait, `wait_s` at most, for regions that follow it: 200 when they are there, 202
    when only the prior is."""
    given = await system_of(state).give_task(robot, data.task, data.environment, data.regions, data.wait_s)
    prior, note = given.prior, given.prior.provenance.note
    regions = given.scene.message.regions if given.scene is not None else []
    labels, may_be = sorted({region.label for region in regions}), [region.name for region in prior.regions]
    taken = TaskTaken(robot, prior.digest(), note, given.seconds, may_be, labels, given.note)
    return Response(taken, status_code=202 if given.scene is None else 200)


@post("/v1/{robot:str}/poses", status_code=200, responses=FAULTS)
async def correct_poses(state: State, robot: Robot, data: JSONBody[Poses]) -> PosesTaken:
    """Give keyframes other poses and wait until the map has taken them."""
    poses = {one.frame: np.array(one.world_from_camera) for one in data.poses}
    if len(poses) < len(data.poses):
        raise FaultyRequestError("a keyframe is given two poses: give one")
    return PosesTaken(robot, len(poses), await system_of(state).correct_poses(robot, poses, data.wait_s))


CHANGING = [switch_task, correct_poses]
