"""Which fault hits whom, when and for how long: drawn from a seed, before anything runs (pure)."""

import random
from collections.abc import Collection
from typing import NamedTuple

SERVICES = ("prior_gateway", "feature_pyramid", "place_graph", "segmenter", "scene_store", "ingest")
ROUTER, RECORDER, ALL = "router", "recorder", "all"
EVERYONE = (*SERVICES, ROUTER, RECORDER)
LINKED = (*SERVICES, RECORDER)  # reach the router through a link of ours
LATEST_S = 1.2  # after a phase has begun


class Kind(NamedTuple):
    """A kind of fault: whom it may hit, how long it lasts, and what it needs of the machine."""

    name: str
    targets: tuple[str, ...]
    shortest_s: float = 0.0  # 0 to 0 = a moment
    longest_s: float = 0.0
    needs: str = ""


KINDS = (
    Kind("kill", EVERYONE),
    Kind("stop", EVERYONE, 0.2, 1.5),
    Kind("long stop", EVERYONE, 3.0, 9.0),  # beyond the lease of two seconds, and beyond the supervisor's patience
    Kind("restart", EVERYONE),
    Kind("router away", (ROUTER,), 0.2, 5.0),  # ended in order, started again later with another id
    Kind("cable out", LINKED, 0.5, 6.0),
    Kind("refused", LINKED, 0.5, 5.0),
    Kind("resets", LINKED, 1.0, 3.0),
    Kind("delay", LINKED, 1.0, 4.0),
    Kind("thin link", LINKED, 1.0, 4.0),
    Kind("lost", ("segmenter", "scene_store"), 1.0, 4.0),
    Kind("repeated", LINKED[:-1], 1.0, 4.0),
    Kind("reordered", LINKED[:-1], 1.0, 4.0),
    Kind("sent again", (ALL,), 0.5, 2.0),
    Kind("garbage", (ALL,), 0.2, 1.0),
    Kind("second", ("ingest", "place_graph", "segmenter", "prior_gateway", "feature_pyramid"), 4.0, 8.0),
    Kind("takeover", ("ingest", "place_graph", "segmenter", "prior_gateway", "feature_pyramid"), 4.0, 8.0),
    Kind("older", SERVICES),
    Kind("newer", SERVICES),
    Kind("clock ahead", SERVICES, 1.0, 3.0, needs="faketime"),
    Kind("clock behind", SERVICES, 1.0, 3.0, needs="faketime"),
    Kind("full disk", (ALL,), 0.5, 4.0, needs="mount"),
    Kind("slow disk", (ALL,), 1.0, 4.0),
    Kind("memory", SERVICES, 1.0, 4.0),
    Kind("starved", (ALL,), 1.0, 5.0),
    Kind("netem", (ALL,), 1.0, 4.0, needs="netem"),
)
BY_NAME = {kind.name: kind for kind in KINDS}


class Planned(NamedTuple):
    """One fault to come."""

    fault: str
    target: str
    delay_s: float  # after its phase has begun
    lasts_s: float


Phase = tuple[Planned, ...]  # what happens between two comparisons


def planned(seed: int, voyage: int, phases: int, names: Collection[str], together: int = 2) -> list[Phase]:
    """The phases of one voyage: up to `together` faults in each, of the named kinds, which take turns; nobody is hit
    twice in a phase, nor in two that follow each other, so that a supervisor need not give up."""
    rng = random.Random(f"{seed} {voyage}")
    waiting: list[Kind] = []
    found: list[Phase] = []
    before: set[str] = set()
    for _ in range(phases):
        phase: list[Planned] = []
        hit: set[str] = set()
        for _ in range(rng.randint(1, together)):
            if not waiting:
                waiting = [kind for kind in KINDS if kind.name in names]
                rng.shuffle(waiting)
            kind = waiting.pop()
            free = [target for target in kind.targets if target not in hit and (target == ALL or target not in before)]
            target = rng.choice(free or kind.targets)
            lasts_s = rng.uniform(kind.shortest_s, kind.longest_s)
            phase.append(Planned(kind.name, target, round(rng.uniform(0.0, LATEST_S), 2), round(lasts_s, 2)))
            hit.add(target)
        before = hit
        found.append(tuple(phase))
    return found
