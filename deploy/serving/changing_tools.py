"""Tools that change something, each only after the user has allowed this very change."""

from typing import Annotated

import numpy as np
from mcp.server.mcpserver import Context, Elicit, ElicitationResult, Resolve
from mcp.server.mcpserver.exceptions import ToolError
from mcp.server.mcpserver.resolve import AcceptedElicitation
from pydantic import BaseModel, Field

from prior_sg.deploy.serving.asking_tools import Tool, told
from prior_sg.deploy.serving.planner_text import one_line
from prior_sg.deploy.serving.system import System
from prior_sg.schemas.priors import fault_of_task

MOST_POSES = 1000  # of one call
LONGEST_ASKED = 300  # characters: the user sees all of what is asked for
Finite = Annotated[float, Field(allow_inf_nan=False)]
Text = Annotated[str, Field(max_length=LONGEST_ASKED)]
Wait = Annotated[float, Field(ge=1, le=120, allow_inf_nan=False, description="seconds")]


class Permission(BaseModel):
    """What the user is asked."""

    allow: bool = Field(description="Whether this may be done")


class CorrectedPose(BaseModel):
    """Where the camera of a keyframe was."""

    frame: Annotated[int, Field(ge=0, le=2**63 - 1)]
    world_from_camera: Annotated[list[Finite], Field(min_length=16, max_length=16, description="4 x 4, row by row")]


def switch_task(system: System) -> Tool:
    """Another task."""

    def ask(ctx: Context, task: str, environment: str) -> Elicit[Permission]:
        if fault := fault_of_task(environment, task, []):
            raise ToolError(fault)
        where = f" in the environment {_quoted(environment)}" if environment else ""
        return _question(ctx, f"Give {system.robot} the task {_quoted(task)}{where}? Its map is then divided anew.")

    @told
    async def switch_task(
        task: Annotated[str, Field(min_length=1, max_length=LONGEST_ASKED)],
        permission: Annotated[ElicitationResult[Permission], Resolve(ask)],
        environment: Text = "",
        wait_s: Wait = 60.0,
    ) -> str:
        """Give the robot another task in plain words; its regions then follow it. The user is asked for permission.
        Without an environment, the one in force stays."""
        _require(permission, "the task stays as it is")
        given = await system.give_task(system.robot, task, environment, (), wait_s)
        if given.scene is None:
            return f"the prior is there, the regions do not follow it yet: {one_line(given.note)}"
        regions = ", ".join(sorted({one_line(region.label) for region in given.scene.message.regions}))
        growing = f"; {one_line(given.note)}" if given.note else ""
        return f"the task is in force after {given.seconds:.1f} s; regions now: {regions or 'none'}{growing}"

    return switch_task


def correct_poses(system: System) -> Tool:
    """Other poses of keyframes."""

    def ask(ctx: Context, poses: list[CorrectedPose]) -> Elicit[Permission]:
        if len({pose.frame for pose in poses}) < len(poses):
            raise ToolError("a keyframe is given two poses: give one")
        return _question(ctx, f"Move {len(poses)} keyframes of {system.robot} to other poses? Its map moves with them.")

    @told
    async def correct_poses(
        poses: Annotated[list[CorrectedPose], Field(min_length=1, max_length=MOST_POSES)],
        permission: Annotated[ElicitationResult[Permission], Resolve(ask)],
        wait_s: Wait = 60.0,
    ) -> str:
        """Give keyframes corrected poses, as after a loop closure. The user is asked for permission."""
        _require(permission, "the poses stay as they are")
        matrices = {pose.frame: np.array(pose.world_from_camera).reshape(4, 4) for pose in poses}
        seconds = await system.correct_poses(system.robot, matrices, wait_s)
        return f"{len(matrices)} poses taken by the map in {seconds:.1f} s"

    return correct_poses


CHANGING = [switch_task, correct_poses]


def _question(ctx: Context, text: str) -> Elicit[Permission]:
    """What to ask the user. Raises ToolError where nobody can be asked."""
    capabilities = ctx.client_capabilities
    elicitation = capabilities.elicitation if capabilities is not None else None
    if elicitation is None or (elicitation.form is None and elicitation.url is not None):
        raise ToolError(
            "refused: this needs the user's permission, and this client cannot ask for it (no form elicitation); "
            "the user can run `prior-sg task` or `prior-sg pose-update` instead"
        )
    return Elicit(text, Permission)


def _require(permission: ElicitationResult[Permission], otherwise: str) -> None:
    """Raise ToolError unless the user has agreed."""
    if not isinstance(permission, AcceptedElicitation) or not permission.data.allow:
        raise ToolError(f"refused: the user did not allow it; {otherwise}")


def _quoted(text: str) -> str:
    plain = one_line(text).replace('"', "'")
    return f'"{plain}"'
