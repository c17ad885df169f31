"""Who of several gateways asks the model (pure).

A gateway that wants to ask says so and waits until it has surely been heard; of those who want, the one whose name
comes first goes to work and keeps saying so; the others wait for its prior. Whoever has the prior already publishes it
when it hears that another wants to ask. A claim that is not renewed lapses with its holder: the next one goes on.
"""

from dataclasses import dataclass, field

from prior_sg.schemas.priors import PriorClaim

SETTLE_TICKS = 2  # a claim has been heard by everybody after so many ticks; at least one whole period


@dataclass
class Claims:
    """What others have said of each question, and how many ticks ago."""

    heard: dict[str, dict[str, tuple[str, int]]] = field(default_factory=dict)  # question -> holder -> (state, age)

    def hear(self, claim: PriorClaim) -> None:
        """Note what another gateway says."""
        holders = self.heard.setdefault(claim.question, {})
        if claim.state == "gave up":
            holders.pop(claim.holder, None)
        else:
            holders[claim.holder] = (claim.state, 0)

    def tick(self, lease_ticks: int) -> None:
        """Time passes; claims that nobody renews lapse."""
        for question, holders in list(self.heard.items()):
            kept = {name: (state, age + 1) for name, (state, age) in holders.items() if age < lease_ticks}
            self.heard[question] = kept
            if not kept:
                del self.heard[question]

    def worker(self, question: str) -> str:
        """Who is asking now; empty = nobody."""
        return min((name for name, (state, _) in self.heard.get(question, {}).items() if state == "works"), default="")

    def may_work(self, question: str, own: str, waited_ticks: int) -> bool:
        """Whether it is this gateway's turn to ask."""
        others = self.heard.get(question, {})
        first = all(own < name for name, (state, _) in others.items() if state == "wants")
        return waited_ticks >= SETTLE_TICKS and not self.worker(question) and first
