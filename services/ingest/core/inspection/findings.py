"""What an inspection says: one finding for each thing looked at (pure)."""

from collections.abc import Iterable
from typing import Literal

import msgspec

Verdict = Literal["ok", "note", "problem"]


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    """One thing looked at."""

    topic: str  # what was looked at, one or two words
    verdict: Verdict
    text: str  # one sentence
    mend: str = ""  # the option, or what else to do
    hopeless: bool = False  # no map can come of it

    def line(self) -> str:
        """The finding and its mend in one line."""
        return f"{self.text}: {self.mend}" if self.mend else self.text


def ok(topic: str, text: str) -> Finding:
    """Nothing to say but the figures."""
    return Finding(topic=topic, verdict="ok", text=text)


def note(topic: str, text: str, mend: str = "") -> Finding:
    """Worth knowing, and right as it is in many recordings."""
    return Finding(topic=topic, verdict="note", text=text, mend=mend)


def problem(topic: str, text: str, mend: str = "", *, hopeless: bool = False) -> Finding:
    """The map will be wrong or empty."""
    return Finding(topic=topic, verdict="problem", text=text, mend=mend, hopeless=hopeless)


def problems(findings: Iterable[Finding]) -> list[Finding]:
    """Those that are problems, hopeless ones first."""
    return sorted((f for f in findings if f.verdict == "problem"), key=lambda finding: not finding.hopeless)
