"""Understanding plain words: which environment, which curated task, which base region (pure, deterministic)."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from prior_sg.services.prior_gateway.core.knowledge import Chosen, Environment, RegionEntry, TaskEntry

Words = tuple[str, ...]
Rule = Callable[[Words, str], bool]

# Words that only say "a part of space": "dining area" and "dining room" are the same place.
PLACE_WORDS = frozenset({"area", "room", "zone", "space", "section", "region", "corner"})
ARTICLES = frozenset({"a", "an", "the", "my", "our", "this", "that"})


@dataclass(frozen=True)
class TaskMatch:
    """The task chosen, what spoke for it, and a sentence for the provenance."""

    task: TaskEntry
    score: int
    note: str


def words(text: str) -> Words:
    """Words of `text` in lower case and singular, without articles and numbers."""
    kept = "".join(c if c.isalnum() else "" if c in "'’" else " " for c in text.casefold())
    found = [_singular(word) for word in kept.split() if word not in ARTICLES]
    return tuple(word for word in found if not word.isdigit()) or tuple(found)


def stems(text: str) -> Words:
    """Words of `text` without the endings that differ between "serve", "serving" and "served"."""
    return tuple(_stem(word) for word in words(text))


def contains(sentence: Words, phrase: Words) -> bool:
    """Whether `phrase` stands in `sentence` as neighbouring words."""
    return bool(phrase) and any(sentence[i : i + len(phrase)] == phrase for i in range(len(sentence)))


def match_environment(text: str, environments: Sequence[Environment]) -> Environment | None:
    """The environment whose name or synonym is `text`, else the longest one mentioned in it, the last one of equals
    (English puts the head last: a "home office" is an office)."""
    sentence = words(text)
    found: tuple[int, int] = (0, 0)
    best = None
    for environment in environments:
        for name in (environment.name, *environment.synonyms):
            phrase = words(name)
            if contains(sentence, phrase):
                end = max(i for i in range(len(sentence)) if sentence[i : i + len(phrase)] == phrase) + len(phrase)
                if (len(phrase), end) > found:
                    found, best = (len(phrase), end), environment
    return best


def match_task(text: str, environment: Environment) -> TaskMatch:
    """The curated task that `text` asks for: its own name, else the highest score (one point per word of every keyword
    found), of equals a special one before the generic, then the first; without any keyword the generic task. The note
    says which case it was."""
    for task in environment.tasks:
        if words(task.name) == words(text):
            return TaskMatch(task, len(words(text)), f"task {task.name!r}")
    hits = {task.name: _keywords_in(text, task) for task in environment.tasks}
    scores = {name: sum(len(stems(keyword)) for keyword in found) for name, found in hits.items()}
    best = max(environment.tasks, key=lambda task: (scores[task.name], not task.generic))
    score = scores[best.name]
    if score == 0:
        generic = environment.generic_task
        known = ", ".join(task.name for task in environment.tasks)
        asked = f"no curated task of {environment.name!r} matches {text!r}" if text.strip() else "no task was given"
        return TaskMatch(generic, 0, f"{asked}: fell back to the generic task {generic.name!r} (known: {known})")
    others = [
        f"{task.name} {scores[task.name]}" for task in environment.tasks if task is not best and scores[task.name]
    ]
    runners = f"; others: {', '.join(others)}" if others else ""
    return TaskMatch(best, score, f"task {best.name!r} by {', '.join(hits[best.name])} (score {score}{runners})")


def choose_regions(
    names: Sequence[str], environment: Environment | None, environments: Sequence[Environment]
) -> list[Chosen]:
    """One entry per given name, in the given order: looked up in `environment`, then in all others, else by name alone.

    An entry serves one name where it can: with "living room" and "lounge" asked for, the second looks further although
    it is a synonym of the first. What is left shares an entry, and says so.
    """
    chosen: dict[str, Chosen] = {}
    taken: dict[str, str] = {}
    for rule, where in _lookups(environment, environments):
        for name in names:
            if name in chosen or any(words(name) == words(other) for other in chosen):
                continue
            if found := _first(name, rule, where, taken):
                chosen[name] = found
                taken.update({_key(found.environment, member): name for member in found.members})
    return [chosen.get(name) or _shared(name, environment, environments, taken) for name in names]


def same_region(one: str, other: str, environments: Sequence[Environment]) -> bool:
    """Whether two names mean one region: alike but for words such as "room", or synonyms of one entry of the first
    environment that knows both."""
    if _bare(words(one)) == _bare(words(other)):
        return True
    for environment in environments:
        owners = [{entry.name for entry in environment.regions if _named(name, entry)} for name in (one, other)]
        if all(owners):
            return bool(owners[0] & owners[1])
    return False


def _named(name: str, entry: RegionEntry) -> bool:
    return any(_bare(words(name)) == _bare(words(known)) for known in (entry.name, *entry.synonyms))


def _shared(
    name: str, environment: Environment | None, environments: Sequence[Environment], taken: dict[str, str]
) -> Chosen:
    for rule, where in _lookups(environment, environments):
        if found := _first(name, rule, where, {}):
            owner = taken[_key(found.environment, found.members[0])]
            return Chosen(name, found.environment, found.members, f"{found.how}, shared with {owner!r}")
    return Chosen(name, None, (), f"{name!r} from its name alone, with uniform matrices")


def _lookups(
    environment: Environment | None, environments: Sequence[Environment]
) -> Iterator[tuple[Rule, list[Environment]]]:
    """Rules from strict to lenient, at home before elsewhere; the lenient last one only when all else fails."""
    own = [environment] if environment else []
    others = [other for other in environments if other is not environment]
    for where in (own, others):
        yield from ((rule, where) for rule in (_is_name, _is_same_place))
    yield _is_head, own
    yield _is_head, others


def _is_name(asked: Words, known: str) -> bool:
    return asked == words(known)


def _is_same_place(asked: Words, known: str) -> bool:
    return _bare(asked) == _bare(words(known))


def _is_head(asked: Words, known: str) -> bool:
    """A "master bedroom" is a bedroom: the known name ends the asked one."""
    phrase = words(known)
    return len(asked) > len(phrase) and asked[-len(phrase) :] == phrase and not set(phrase) <= PLACE_WORDS


def _first(name: str, rule: Rule, where: Sequence[Environment], taken: dict[str, str]) -> Chosen | None:
    asked = words(name)
    for environment, known, members in _names_of(where):
        if rule(asked, known) and not any(_key(environment, member) in taken for member in members):
            return Chosen(name, environment, members, f"{name!r} as {known!r} of {environment.name!r}")
    return None


def _names_of(where: Sequence[Environment]) -> Iterator[tuple[Environment, str, tuple[RegionEntry, ...]]]:
    """Names of base regions, then their synonyms, then task regions, with the base regions behind each."""
    for environment in where:
        yield from ((environment, entry.name, (entry,)) for entry in environment.regions)
    for environment in where:
        for entry in environment.regions:
            yield from ((environment, synonym, (entry,)) for synonym in entry.synonyms)
    for environment in where:
        for task in environment.tasks:
            for name, members in task.regions.items():
                yield environment, name, tuple(environment.region(member) for member in members)


def _key(environment: Environment | None, entry: RegionEntry) -> str:
    return f"{environment.name if environment else ''}/{entry.name}"


def _keywords_in(text: str, task: TaskEntry) -> list[str]:
    sentence = stems(text)
    unique = {stems(keyword): keyword for keyword in (*task.keywords, task.name)}
    return [keyword for phrase, keyword in unique.items() if contains(sentence, phrase)]


def _bare(asked: Words) -> Words:
    """`asked` without trailing words that only mean a place; unchanged where nothing would be left."""
    end = len(asked)
    while end > 1 and asked[end - 1] in PLACE_WORDS:
        end -= 1
    return asked[:end]


def _singular(word: str) -> str:
    if len(word) > 4 and word.endswith("ies"):
        return f"{word[:-3]}y"
    if len(word) > 4 and word.endswith(("shes", "ches", "sses", "xes")):
        return word[:-2]
    return word[:-1] if len(word) > 3 and word.endswith("s") and not word.endswith(("ss", "us", "is")) else word


def _stem(word: str) -> str:
    for ending in ("ing", "ed"):
        if len(word) > len(ending) + 3 and word.endswith(ending):
            word = word.removesuffix(ending)
            break
    return word[:-1] if len(word) > 4 and word.endswith("e") else word
