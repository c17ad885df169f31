"""What passes between a process that serves and the one that takes over from it."""

from typing import ClassVar

from prior_sg.schemas.codec import Message, Number, NumberOrNone
from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.objects import Detections, ObjectDelta
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.regions import RegionDelta


class YieldRequest(Message, frozen=True, kw_only=True):
    """Ask a process to finish what it has taken in, to let go of what it is in charge of, and to end."""

    successor: str  # its instance


class Bequest(Message, frozen=True, kw_only=True):
    """The last word of a process that yields: what its readers know, so that names in it live on."""

    OF_A_ROBOT: ClassVar[bool] = False

    robot: str
    service: str
    instance: str
    places: PlaceDelta | None = None  # snapshots
    regions: RegionDelta | None = None
    objects: ObjectDelta | None = None
    next_ids: dict[str, Number] = {}  # numbers never given before, by what is numbered: places, regions, objects


class Succession(Message, frozen=True, kw_only=True):
    """First input of a process that others have gone before: readers follow what was told already."""

    predecessor: str = ""  # the instance that still serves, and yields when it is asked; empty = it is gone


class TakesOver(Message, frozen=True, kw_only=True):
    """Input of a process that has stood by: from now on it tells. Without a bequest its predecessor died."""

    bequest: Bequest | None = None


class EvidenceRequest(Message, frozen=True, kw_only=True):
    """Ask a segmenter for what it has seen, in the order of frame numbers."""

    robot: str
    after_frame_id: NumberOrNone = -1


class Evidence(Message, frozen=True, kw_only=True):
    """Some of what a segmenter has seen, of all embedding spaces, at corrected poses; nothing = that was all.

    What integration does not need of a pyramid is left out: its stamp, its worker and the depths of its crops are 0.
    """

    robot: str
    space: str = ""  # in force
    last_frame_id: NumberOrNone = -1  # the next page begins after it
    pyramids: list[Pyramid] = []
    detections: list[Detections] = []


class SwapRequest(Message, frozen=True, kw_only=True):
    """Ask who started a process to start a successor of it, and to let that one take over."""

    settings: list[str] = []  # as after --set; they come after those of the predecessor
    config: str = ""  # the text of a TOML file, in place of the predecessor's; empty = the same


class Swapped(Message, frozen=True, kw_only=True):
    """What became of it."""

    successor: str = ""  # its instance
    error: str = ""  # why there is none: the predecessor serves on
