"""What a merged map is made of: regions and objects of robots' own maps."""

from collections.abc import Sequence

from prior_sg.schemas.codec import Number, Part
from prior_sg.schemas.names import fault_of_robot

MOST_MERGED = 256  # robots of one merged map: a task is given to all of them at once


class MapMember(Part, frozen=True, kw_only=True):
    """One robot's region or object that a merged one is made of."""

    robot: str
    session: Number = 0  # of the robot's map, as the merged map counts them; never another's
    id: int  # in that map


def fault_of_merging(name: str, robots: Sequence[str]) -> str:
    """Why a map cannot be merged of these robots', as a sentence; empty when nothing speaks against it."""
    if name in robots:
        return f"{name} is merged of itself"
    if len(robots) > MOST_MERGED:
        return f"{name} is merged of {len(robots)} robots' maps: at most {MOST_MERGED} are taken"
    return next(filter(None, map(fault_of_robot, robots)), "")


def merged_map(robots: Sequence[str]) -> str:
    """In words: a map merged of these robots'; empty of none."""
    return f"merged map of {', '.join(robots)}" if robots else ""


def headline(task: str, robots: Sequence[str], plain: str = "") -> str:
    """The task of a map, merged of these robots' or of none. Without one, what regions are: those of an environment
    as it is (`plain`); without these, what is to be done."""
    if task or plain:
        return task or f"no task: {plain} as it is"
    return f"{merged_map(robots)}: give it a task" if robots else "no task yet"


def follows_robots(name: str, robots: Sequence[str], what: str) -> str:
    """Why a merged map takes no poses and the like, as a sentence."""
    return f"{name} is the {merged_map(robots)} and follows what they do: give {what} to a robot (--robot {robots[0]})"


def only_of_robots(name: str, robots: Sequence[str], what: str) -> str:
    """Why a merged map does not know something, as a sentence."""
    return f"{name} is the {merged_map(robots)}: {what} is known of a robot's own map (--robot {robots[0]})"


def said(member: MapMember) -> str:
    """In words: whose it is and its id there."""
    return f"{member.robot} {f'(session {member.session}) ' if member.session else ''}#{member.id}"
