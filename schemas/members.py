"""What a merged map is made of: regions and objects of robots' own maps."""

from prior_sg.schemas.codec import Number, Part


class MapMember(Part, frozen=True, kw_only=True):
    """One robot's region or object that a merged one is made of."""

    robot: str
    session: Number = 0  # of the robot's map, as the merged map counts them; never another's
    id: int  # in that map


def said(member: MapMember) -> str:
    """In words: whose it is and its id there."""
    return f"{member.robot} {f'(session {member.session}) ' if member.session else ''}#{member.id}"
