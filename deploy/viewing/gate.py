"""What a viewer may say to the page. All else that reaches its socket is passed over, or ends the connection.

viser takes every message that it knows of from whoever is connected: it sets any attribute of a control, keeps what is
uploaded, and sends on what others should not be told. Here only what the page's own controls can say gets that far.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import msgspec
import viser

from prior_sg.schemas.names import LONGEST_TEXT

MOST_VIEWERS = 32
MOST_MESSAGE_BYTES = 1 << 15  # a text of the greatest length, and room
MOST_PIECES = 16  # that a message comes in
MESSAGES_HZ, MOST_MESSAGES = 120.0, 500.0  # of one viewer on average, and at once; a browser says at most 120 a second
BYTES_HZ, MOST_BYTES = 65536.0, 131072.0  # likewise with all that carries nothing, such as pings
FARTHEST_M, MOST_PX = 1e6, 32768
SHORTEST = 1e-6  # length of a direction

Number = Annotated[float, msgspec.Meta(ge=-FARTHEST_M, le=FARTHEST_M)]
Triple = tuple[Number, Number, Number]
Pixels = Annotated[float, msgspec.Meta(ge=0, le=MOST_PX)]
Id = Annotated[str, msgspec.Meta(max_length=64)]
Value = bool | float | Annotated[str, msgspec.Meta(max_length=LONGEST_TEXT)]


class Eye(msgspec.Struct, tag_field="type", tag="ViewerCameraMessage", forbid_unknown_fields=True):
    """Where a viewer looks from, and how large its window is."""

    wxyz: tuple[Number, Number, Number, Number]
    position: Triple
    fov: Number
    near: Number
    far: Number
    image_height: Pixels
    image_width: Pixels
    look_at: Triple
    up_direction: Triple


class Click(msgspec.Struct, tag_field="type", tag="ScenePointerMessage", forbid_unknown_fields=True):
    """A click into the scene, as a ray."""

    event_type: Literal["click"]
    ray_origin: Triple
    ray_direction: Triple
    screen_pos: tuple[tuple[Number, Number]]
    modifier: Annotated[str, msgspec.Meta(max_length=32)] | None


class Set(msgspec.Struct, forbid_unknown_fields=True):
    """What a control is set to."""

    value: Value


class Update(msgspec.Struct, tag_field="type", tag="GuiUpdateMessage", forbid_unknown_fields=True):
    """A control was used."""

    uuid: Id
    updates: Set


class Submit(msgspec.Struct, tag_field="type", tag="GuiFormSubmitMessage", forbid_unknown_fields=True):
    """A form was sent off from the keyboard."""

    uuid: Id


class Dirty(msgspec.Struct, tag_field="type", tag="GuiFormDirtyMessage", forbid_unknown_fields=True):
    """A form was begun to be filled in."""

    uuid: Id


Said = Eye | Click | Update | Submit | Dirty
DECODER = msgspec.msgpack.Decoder(Said)


def said(raw: bytes) -> Said | None:
    """What a viewer says; None where no viewer says such a thing."""
    try:
        message = DECODER.decode(raw)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
        return None
    return message if all(map(math.isfinite, _numbers(message))) else None


def _numbers(message: Said) -> tuple[float, ...]:
    """All that have bounds, which what is no number passes; an endless one for a ray that leads nowhere."""
    match message:
        case Eye():
            turns = *message.wxyz, *message.position, *message.look_at, *message.up_direction
            return *turns, message.fov, message.near, message.far, message.image_height, message.image_width
        case Click():
            ray = *message.ray_origin, *message.ray_direction
            return *ray, *message.screen_pos[0], 0.0 if math.hypot(*message.ray_direction) > SHORTEST else math.inf
    return ()


def fits(message: Said, gui: viser.GuiApi) -> bool:
    """Whether there is such a control, it can be used now, and it can be set so."""
    match message:
        case Update():
            control = gui._gui_input_handle_from_uuid.get(message.uuid)
            return control is not None and not getattr(control, "disabled", False) and _takes(control, message)
        case Submit() | Dirty():
            return isinstance(gui._container_handle_from_uuid.get(message.uuid), viser.GuiFormHandle)
    return True


def _takes(control: Any, message: Update) -> bool:
    value = message.updates.value
    match control:
        case viser.GuiButtonHandle() | viser.GuiCheckboxHandle():
            return isinstance(value, bool)
        case viser.GuiTextHandle():
            return isinstance(value, str)
        case viser.GuiSliderHandle():
            return isinstance(value, float) and control.min <= value <= control.max
        case viser.GuiButtonGroupHandle() | viser.GuiDropdownHandle():
            return value in control.options
    return False


@dataclass
class Allowance:
    """So much at once, and so much a second after that."""

    rate_hz: float
    most: float
    now_s: Callable[[], float] = time.monotonic
    left: float = field(init=False)
    _since_s: float = field(init=False)

    def __post_init__(self) -> None:
        self.left, self._since_s = self.most, self.now_s()

    def take(self, amount: float) -> bool:
        """Whether so much is left, and then it is taken."""
        now_s = self.now_s()
        self.left = min(self.left + self.rate_hz * (now_s - self._since_s), self.most)
        self._since_s = now_s
        enough = amount <= self.left
        self.left -= amount if enough else 0.0
        return enough


def watch(connection: Any, gui: Callable[[], viser.GuiApi]) -> None:
    """Let through of one connection only what a viewer can say. Who says more of it than a browser can, or sends more
    bytes than that takes, is cut off."""
    messages, octets = Allowance(MESSAGES_HZ, MOST_MESSAGES), Allowance(BYTES_HZ, MOST_BYTES)
    feed = connection.data_received

    def data_received(data: bytes) -> None:
        if octets.take(len(data)):
            feed(data)
        else:
            connection.transport.abort()

    async def recv() -> bytes:
        while True:
            pieces: list[bytes] = []
            async for piece in connection.recv_streaming(decode=False):
                pieces.append(piece)
                if len(pieces) > MOST_PIECES:
                    connection.transport.abort()
            if not messages.take(1):
                connection.transport.abort()
                continue  # until what has come by now is used up
            message = said(b"".join(pieces))
            if message is not None and fits(message, gui()):
                return msgspec.msgpack.encode(message)  # not what came: it might be read in another way

    for name in ("max_message_size", "max_size"):  # the latter before websockets 16
        if hasattr(connection.protocol, name):
            setattr(connection.protocol, name, MOST_MESSAGE_BYTES)
    connection.data_received, connection.recv = data_received, recv
