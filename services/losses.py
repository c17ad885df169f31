"""What could not be used, counted by reason (pure)."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

import msgspec

from prior_sg.schemas.status import Loss

MOST_REASONS = 32  # of one counter; what comes after is counted together
OTHER_REASONS = "other reasons"
_PLURAL = re.compile(r"\b(jump|frame|keyframe|pyramid|detection|service|message)s\b")
_NUMBER = re.compile(r"[-+]?\d+(?:[.,:]\d+)*(?:e[-+]?\d+)?%?")


def kind_of(text: str) -> str:
    """What texts have in common that differ in their numbers."""
    return _NUMBER.sub("…", text)


@dataclass
class Losses:
    """Counts by what was lost and why, each with its first example in full."""

    _found: dict[tuple[str, str], Loss] = field(default_factory=dict)

    @staticmethod
    def of(told: Iterable[Loss]) -> "Losses":
        """Counts to go on with."""
        return Losses({(loss.what, loss.reason): loss for loss in told})

    def add(self, what: str, text: str, *, reason: str = "", of: str = "", count: int = 1) -> None:
        """Count losses; their reason defaults to the kind of the text. `of` names the one that was lost."""
        reason = reason or kind_of(text)
        if (what, reason) not in self._found and len(self._found) >= MOST_REASONS:
            reason = OTHER_REASONS
        key, example = (what, reason), f"{of}: {text}" if of else text
        known = self._found.get(key) or Loss(what=what, reason=reason, count=0, example=example)
        self._found[key] = msgspec.structs.replace(known, count=known.count + count)

    def copy(self) -> "Losses":
        """The same counts, to be counted on elsewhere."""
        return Losses(dict(self._found))

    def count(self, what: str) -> int:
        """How many of these were lost, for whatever reason."""
        return sum(loss.count for loss in self.told if loss.what == what)

    @property
    def told(self) -> list[Loss]:
        """All of them, most frequent first."""
        return sorted(list(self._found.values()), key=lambda loss: -loss.count)


def merged(losses: Iterable[Loss]) -> list[Loss]:
    """Losses of several services or workers, those of the same reason together, most frequent first."""
    found: dict[tuple[str, str], Loss] = {}
    for loss in losses:
        known = found.get((loss.what, loss.reason))
        found[loss.what, loss.reason] = (
            loss if known is None else msgspec.structs.replace(known, count=known.count + loss.count)
        )
    return sorted(found.values(), key=lambda loss: -loss.count)


def line(loss: Loss, total: int = 0) -> str:
    """One sentence about a loss; `total` = of how many, 0 = unknown."""
    told = loss.example.removesuffix(f": {loss.reason}")
    example = f" ({told})" if told and told != loss.reason else ""
    what = loss.what if loss.count != 1 or total > 1 else _PLURAL.sub(r"\1", loss.what)
    return f"{loss.count}{f' of {total}' if total else ''} {what}: {loss.reason}{example}"
