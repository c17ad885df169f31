"""The colours of labels, the same in every picture and on the live page.

No colour is the only carrier of what it says: pictures also write the names of regions.
"""

import colorsys
import hashlib
from collections.abc import Iterable

from prior_sg.schemas.scene import Scene

Color = tuple[int, int, int]  # red, green, blue

UNLABELLED: Color = (208, 213, 219)
SALT = b"12994"  # with it, the commonest rooms of homes and offices ask for different colours
PALETTE: tuple[Color, ...] = (
    (78, 121, 167),
    (242, 142, 43),
    (89, 161, 79),
    (225, 87, 89),
    (176, 122, 161),
    (63, 184, 175),
    (237, 201, 72),
    (255, 157, 167),
    (156, 117, 95),
    (124, 196, 240),
    (168, 208, 91),
    (208, 84, 155),
    (106, 90, 205),
    (38, 112, 108),
)


class LabelColors:
    """Gives labels colours that they keep as long as they are asked for, and afterwards as long as nobody needs them.

    A label asks for the same colour wherever it appears; where another has that one, it gets the next that is free.
    """

    def __init__(self) -> None:
        self._slots: dict[str, int] = {}

    def of(self, labels: Iterable[str]) -> dict[str, Color]:
        """A colour per label, all different."""
        asked = sorted(set(labels))
        known = {slot: label for label, slot in self._slots.items()}
        taken = {self._slots[label] for label in asked if label in self._slots}
        slots = max(len(PALETTE), len(asked))
        for label in asked:
            if label in self._slots:
                continue
            order = [(_wish(label) + step) % slots for step in range(slots)]
            free = [slot for slot in order if slot not in taken]
            slot = next((slot for slot in free if slot not in known), free[0])
            self._slots.pop(known.get(slot, ""), None)
            self._slots[label], known[slot] = slot, label
            taken.add(slot)
        return {label: _palette(self._slots[label]) for label in asked}


def _wish(label: str) -> int:
    """The place in the palette that a label asks for."""
    return int.from_bytes(hashlib.blake2b(label.encode(), digest_size=4, salt=SALT).digest(), "little") % len(PALETTE)


def labels_of(scene: Scene) -> set[str]:
    """All labels that may need a colour: those of the prior, and those that regions carry."""
    return {*scene.labels, *(region.label for region in scene.regions)}


def label_colors(scene: Scene) -> dict[str, Color]:
    """A colour per label of one scene, distinct within it."""
    return LabelColors().of(labels_of(scene))


def _palette(slot: int) -> Color:
    if slot < len(PALETTE):
        return PALETTE[slot]
    red, green, blue = colorsys.hls_to_rgb(slot * 0.618 % 1, 0.6, 0.5)
    return round(255 * red), round(255 * green), round(255 * blue)
