"""When to report what the map shows of its prior (pure)."""

from dataclasses import dataclass

from prior_sg.schemas.codec import encode
from prior_sg.schemas.priors import PriorEvidence


@dataclass
class PriorReport:
    """The last report, and how long ago that was looked at."""

    last: PriorEvidence | None = None
    waited_ticks: int = 0

    def due(self, settled: bool, every_ticks: int) -> bool:
        """Half a second has passed: whether it is time to look at a map that has settled; 0 ticks = never."""
        self.waited_ticks += 1
        if not settled or not every_ticks or self.waited_ticks < every_ticks:
            return False
        self.waited_ticks = 0
        return True

    def news(self, seen: PriorEvidence | None) -> PriorEvidence | None:
        """What is seen, if that is something else than the last report."""
        if seen is None or (self.last is not None and encode(seen) == encode(self.last)):
            return None
        self.last = seen
        return seen
