"""What a search lights up: regions and objects whose names hold the words (pure)."""

from dataclasses import dataclass

from prior_sg.deploy.viewing.drawing import Lit
from prior_sg.schemas.scene import Scene

MOST_ANSWERS = 8


@dataclass(frozen=True)
class Found:
    """Answers, best first: kind, name and score; and what of the map stands out."""

    rows: list[tuple[str, str, float | None]]
    lit: Lit
    said: str  # a sentence; empty when there is nothing to say


def by_name(scene: Scene, text: str) -> Found:
    """Regions and objects named so, the most probable first."""
    words = [_stem(word) for word in text.casefold().split()]
    if not words:
        return Found([], Lit(), "")
    regions = [region for region in scene.regions if _holds(region.label, words)]
    objects = [item for item in scene.objects if item.label and _holds(item.label, words)]
    named = [
        *((one.probability, "region", one.label, one.id) for one in regions),
        *((one.probability * one.known, "object", one.label, one.id) for one in objects),
    ]
    best = sorted(named, key=lambda one: -one[0])[:MOST_ANSWERS]
    lit = Lit(
        regions=frozenset(number for _, kind, _, number in best if kind == "region"),
        objects=frozenset(number for _, kind, _, number in best if kind == "object"),
    )
    said = "" if best else f"nothing here is called {text.strip()!r}"
    return Found([(kind, name, score) for score, kind, name, _ in best], lit, said)


def _holds(name: str, words: list[str]) -> bool:
    own = [_stem(word) for word in name.casefold().split()]
    return any(word and any(part.startswith(word) for part in own) for word in words)


def _stem(word: str) -> str:
    """Without the plural's s."""
    return word[:-1] if len(word) > 3 and word.endswith("s") and not word.endswith("ss") else word
