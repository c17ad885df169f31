"""What a search lights up (pure)."""

import re
from dataclasses import dataclass, replace
from typing import NamedTuple

from prior_sg.deploy.viewing.drawing import Lit
from prior_sg.deploy.viewing.sources import Likeness
from prior_sg.schemas.answers import Ranking, SpotKind
from prior_sg.schemas.queries import AnswersTo, Spot
from prior_sg.schemas.scene import Scene
from prior_sg.services.scene_store.core.queries.answering import answer
from prior_sg.services.scene_store.core.queries.index import Index
from prior_sg.services.scene_store.core.queries.markers import nothing_numbered, numbered

MOST_ANSWERS, MOST_LIT = 5, 1000  # shown with a number; lit, places that are not among them
MARKER_NAME = re.compile(r"marker\s*#?\s*(\d{1,9})", re.IGNORECASE)
NOTHING_KNOWN = Likeness({}, {})
LIKELY = 0.5  # a score from which an answer is rather right than wrong
AS_GOOD = 0.6  # of the best answer's score: what answers so well is lit, too


class Hit(NamedTuple):
    """One answer; without a score while its name is being typed."""

    what: SpotKind
    id: int
    label: str
    score: float | None
    dictionary: str = ""  # of a printed marker

    @property
    def spot(self) -> Spot:
        """As an end of a way."""
        return Spot(what=self.what, id=self.id, dictionary=self.dictionary)


@dataclass(frozen=True)
class Found:
    """Answers, best first; and what of the map stands out."""

    hits: list[Hit]
    lit: Lit
    said: str  # a sentence; empty when there is nothing to say


def ranked(index: Index, text: str, likeness: Likeness) -> Ranking:
    """What answers a text by what its labels mean; where nothing is known of that, by their words."""
    asked = AnswersTo(text=text, regions=likeness.regions, objects=likeness.objects, limit=MOST_LIT)
    found = answer(index, asked)
    if not isinstance(found, Ranking):
        raise TypeError(f"AnswersTo is answered by {type(found).__name__}")
    return found


def found_in(ranking: Ranking, scene: Scene, text: str) -> Found:
    """Answers as the page shows them; where there are none, names that begin like the text, while it is being typed."""
    things = [thing for thing in ranking.things if thing.what != "place" and thing.score]
    if not things:
        return begun(scene, text)
    best = things[0].score or 0.0
    bright = [thing for thing in things if (thing.score or 0.0) >= AS_GOOD * best]
    lit = Lit(
        regions=frozenset(thing.id for thing in bright if thing.what == "region"),
        objects=frozenset(thing.id for thing in bright if thing.what == "object"),
    )
    said = ranking.note or ("" if best >= LIKELY else "nothing answers this for sure; these come nearest")
    listed = things[: max(MOST_ANSWERS, len(bright))]
    return _first([Hit(thing.what, thing.id, thing.label, thing.score) for thing in listed], lit, said)


def begun(scene: Scene, text: str) -> Found:
    """Regions and objects with a word that begins so, the most probable first."""
    start = text.strip().casefold()
    named = [
        *((one.probability, Hit("region", one.id, one.label, None)) for one in scene.regions),
        *((one.probability * one.known, Hit("object", one.id, one.label, None)) for one in scene.objects),
    ]
    fitting = [(sure, hit) for sure, hit in named if _begins(hit.label, start)]
    best = [hit for _, hit in sorted(fitting, key=lambda one: -one[0])]
    lit = Lit(
        regions=frozenset(hit.id for hit in best[:MOST_ANSWERS] if hit.what == "region"),
        objects=frozenset(hit.id for hit in best[:MOST_ANSWERS] if hit.what == "object"),
    )
    return _first(best, lit, "" if best else f"nothing here answers {text.strip()!r}")


def markers_called(scene: Scene, text: str) -> Found | None:
    """The printed markers of a number, where a text is one's name and nothing else; None where it is not."""
    number = MARKER_NAME.fullmatch(text.strip())
    if number is None:
        return None
    there = numbered(scene, int(number[1]))
    doubts = "; ".join(f"{one.key} is in doubt: {one.doubt}" for one in there if one.doubt)
    hits = [
        Hit("marker", one.id, f"marker {one.id}" if len(there) == 1 else str(one.key), None, one.dictionary)
        for one in there
    ]
    return _first(hits, Lit(), doubts if there else nothing_numbered(scene, int(number[1])))


def _first(hits: list[Hit], lit: Lit, said: str) -> Found:
    """The first of all that answer as well as the best, and how many others there are."""
    more = len(hits) - MOST_ANSWERS
    left_out = f"{more} more: write more of what you look for, or ask `prior-sg query`" if more > 0 else ""
    return Found(hits[:MOST_ANSWERS], lit, "; ".join(filter(None, (said, left_out))))


def find(index: Index, text: str, likeness: Likeness = NOTHING_KNOWN) -> Found:
    """What of a scene answers a text; nothing where it is empty. It says what was missing to know better."""
    if not text.strip():
        return Found([], Lit(), "")
    if (marker := markers_called(index.scene, text)) is not None:
        return marker
    found = found_in(ranked(index, text, likeness), index.scene, text)
    return replace(found, said=": ".join(part for part in (found.said, likeness.missing) if part))


def _begins(name: str, start: str) -> bool:
    return bool(start) and any(word.startswith(start) for word in [name.casefold(), *name.casefold().split()])
