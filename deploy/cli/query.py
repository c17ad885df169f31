"""`prior-sg query`: ask the map, in a sentence or by position, label and route."""

import argparse
import contextlib
import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from prior_sg.deploy.cli import query_tables as tables
from prior_sg.deploy.cli.shared import Commands, add_bus, console
from prior_sg.deploy.errors import UsageError, UserError
from prior_sg.schemas.levels import LEVELS

if TYPE_CHECKING:
    from prior_sg.deploy.api.asking import Asking
    from prior_sg.deploy.api.client import Client
    from prior_sg.schemas.answers import (
        Difference,
        MarkerInRegion,
        NodeWithRegions,
        Outlook,
        Route,
        Thing,
    )
    from prior_sg.schemas.foresight import MissingLabel

FORMS = """\
what to ask:
  "somewhere to sit and eat"       regions, places and objects that answer a sentence, with scores
  near X Y Z                       the nearest objects; --object LABEL, --what place, --limit N
  within X Y Z RADIUS              all that is no farther
  in-box X Y Z X Y Z               all between two corners
  label LABEL                      all that carries it
  objects [LABEL] [in REGION]      objects of a label in regions of a label
  level LEVEL [LABEL]              zones, floors, buildings, districts, with their regions
  region ID, place ID, object ID   one of them in full: beliefs, neighbours, what it holds
  marker [NUMBER]                  where printed markers are, and what is doubtful about them
  route FROM TO                    the shortest way; each a label, here (where the camera was last), place:ID,
                                   region:ID, object:ID, marker:NUMBER or X,Y,Z
  unseen LABEL                     where a region that was not seen may be, and the way there from here (--start SPOT)
  missing                          what is probably still to be found behind the map's openings
  changed REVISION                 what is different since a revision (running store only)

examples:
  prior-sg query "somewhere to sit and eat" --scene out/demo
  prior-sg query near 1.0 2.0 0.5 --what region
  prior-sg query route here "dining room" --clearance 0.3"""
WHATS = ("place", "region", "object")
T = TypeVar("T")
Ask = Callable[["Asking"], T]  # a question that is put as it is understood


def add_commands(commands: Commands) -> None:
    """`query`."""
    parser = commands.add(
        "query",
        cmd_query,
        "ask the map: in a sentence, by position, label or route",
        'prior-sg query "somewhere to sit and eat" --scene out/demo',
    )
    parser.epilog = FORMS
    parser.add_argument("words", nargs="+", metavar="QUESTION", help="a sentence in quotes, or a form listed below")
    parser.add_argument("--scene", type=Path, help="ask a saved scene: a run's folder or a file of docs/exports.md")
    parser.add_argument("--what", choices=WHATS, help="only these (default: what suits the question)")
    parser.add_argument("--label", default="", help="only what carries this label")
    parser.add_argument("--object", default="", metavar="LABEL", help="only objects of this label")
    parser.add_argument(
        "--limit", type=int, default=10, metavar="N", help="list at most so many (default: %(default)s)"
    )
    parser.add_argument(
        "--clearance", type=float, default=0.0, metavar="METRES", help="of routes: nothing is closer to them"
    )
    parser.add_argument(
        "--start", default="here", metavar="SPOT", help="of unseen: where the way begins, as a route's ends"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    add_bus(parser)


def cmd_query(arguments: argparse.Namespace) -> int:
    """Ask, then print tables or JSON."""
    import msgspec

    from prior_sg.deploy.api.errors import NotInSceneError
    from prior_sg.deploy.api.listed import CutWarning
    from prior_sg.schemas.queries import MOST_ASKED

    if not 1 <= arguments.limit <= MOST_ASKED:
        raise UsageError(f"--limit must be at least 1, and at most {MOST_ASKED}")
    if not 0 <= arguments.clearance < math.inf:
        raise UsageError(
            "--clearance is in metres, from 0 on, such as `prior-sg query route here hall --clearance 0.3`"
        )
    if arguments.object:
        arguments.what, arguments.label = "object", arguments.object
    word, *rest = arguments.words
    question, show = ASKED.get(word, FOUND) if rest else (ASKED | ALONE).get(word, FOUND)
    ask = question(arguments, rest if question is not _find else arguments.words)
    try:
        with warnings.catch_warnings(record=True) as said, _opened(arguments) as scene:
            warnings.simplefilter("always", UserWarning)
            warnings.simplefilter("ignore", CutWarning)  # said in words of the command
            if arguments.scene is None:
                _require_some(scene)
            found = ask(scene)
    except NotInSceneError as error:
        raise UserError(str(error)) from error
    except ValueError as error:  # of what no question may hold
        raise UsageError(str(error)) from error
    notes, left_out = [str(warning.message) for warning in said], _left_out(found)
    if arguments.json:
        print(msgspec.json.encode({"answer": found, "notes": notes + left_out}).decode())
        return 0
    for note in notes:
        console.print(f"note: {note}")
    show(found)
    for note in left_out:
        console.print(note)
    return 0


def _left_out(found: Any) -> list[str]:
    """How much is not listed, and how to get it; nothing where all is."""
    from prior_sg.deploy.api.listed import Listed
    from prior_sg.schemas.answers import Outlook, listed_of
    from prior_sg.schemas.queries import MOST_ASKED

    rows: Sequence[Any]
    match found:
        case Listed():
            rows, total, more = found, found.total, "more"
        case {"beliefs": beliefs}:
            rows, total, more = *listed_of(beliefs), "more labels"
        case Outlook():
            rows, total, more = *listed_of(found), "more openings"
        case _:
            return []
    how = f"--limit {total} lists all" if total <= MOST_ASKED else f"--limit {MOST_ASKED} lists most"
    return [f"and {total - len(rows)} {more}: {how}"] if total > len(rows) else []


def _opened(arguments: argparse.Namespace) -> Any:
    """The running system, or a saved scene. Raises PriorSgError."""
    if arguments.scene is None:
        from prior_sg.deploy.api.client import Client

        return Client(arguments.connect, arguments.robot)
    from prior_sg.deploy.api.scene import Scene

    return contextlib.nullcontext(Scene.read(arguments.scene, arguments.robot))


def _require_some(client: "Client") -> None:
    """Raise UserError where nothing is stored of the robot that is asked about."""
    from prior_sg.schemas.queries import WordsInUse

    if client.answers(WordsInUse()).revision < 0:
        raise UserError(
            f"nothing is stored of a robot {client.robot!r}: its services have told nothing yet, or it has another "
            "name (--robot)"
        )


def _find(arguments: argparse.Namespace, words: Sequence[str]) -> "Ask[list[Thing]]":
    text = _name(words, '"SENTENCE"', '"somewhere to sit"')
    return lambda scene: scene.find(text, arguments.what, arguments.limit)


def _near(arguments: argparse.Namespace, words: Sequence[str]) -> "Ask[list[Thing]]":
    point = _numbers(words, 3, "near X Y Z", "near 1.0 2.0 0.5")
    return lambda scene: scene.near(point, arguments.limit, arguments.what or "object", arguments.label)


def _within(arguments: argparse.Namespace, words: Sequence[str]) -> "Ask[list[Thing]]":
    *point, radius_m = _numbers(words, 4, "within X Y Z RADIUS", "within 1.0 2.0 0.5 3.0")
    return lambda scene: scene.within(point, radius_m, arguments.what, arguments.label, arguments.limit)


def _in_box(arguments: argparse.Namespace, words: Sequence[str]) -> "Ask[list[Thing]]":
    corners = _numbers(words, 6, "in-box X Y Z X Y Z", "in-box 0 0 0 4.0 3.0 2.5")
    return lambda scene: scene.in_box(corners[:3], corners[3:], arguments.what, arguments.label, arguments.limit)


def _label(arguments: argparse.Namespace, words: Sequence[str]) -> "Ask[list[Thing]]":
    label = _name(words, "label LABEL", "label kitchen")
    return lambda scene: scene.labelled(label, arguments.what, arguments.limit)


def _objects(arguments: argparse.Namespace, words: Sequence[str]) -> "Ask[list[Thing]]":
    at = words.index("in") if "in" in words else len(words)
    region = _name(words[at + 1 :], "objects LABEL in REGION", "objects chair in kitchen") if at < len(words) else ""
    return lambda scene: scene.objects_in(region, " ".join(words[:at]) or arguments.label, arguments.limit)


def _one(arguments: argparse.Namespace, words: Sequence[str]) -> "Ask[dict[str, Any]]":
    what: Any = arguments.words[0]
    number = _id(words, f"{what} 7")

    def ask(scene: "Asking") -> "dict[str, Any]":
        found: dict[str, Any] = {"details": scene.describe(what, number), "neighbours": scene.neighbours(what, number)}
        return found | ({"beliefs": scene.candidates(number, arguments.limit)} if what == "region" else {})

    return ask


def _levels(arguments: argparse.Namespace, words: Sequence[str]) -> "Ask[list[NodeWithRegions]]":
    level, *label = words or ("",)
    if level not in LEVELS:
        raise _misput(f"level {'|'.join(LEVELS)}", "level zone ward")
    return lambda scene: scene.levels(level, " ".join(label) or arguments.label, limit=arguments.limit)


def _markers(arguments: argparse.Namespace, words: Sequence[str]) -> "Ask[list[MarkerInRegion]]":
    number = _id(words, "marker 7") if words else None
    return lambda scene: scene.markers(number, limit=arguments.limit)


def _route(arguments: argparse.Namespace, words: Sequence[str]) -> "Ask[Route]":
    if len(words) != 2:
        raise _misput("route FROM TO", "route kitchen 'dining room'")
    return lambda scene: scene.route(words[0], words[1], arguments.clearance)


def _unseen(arguments: argparse.Namespace, words: Sequence[str]) -> "Ask[Outlook]":
    label = _name(words, "unseen LABEL", "unseen bathroom")
    return lambda scene: scene.where_to_look(label, arguments.start, arguments.clearance, arguments.limit)


def _missing(arguments: argparse.Namespace, words: Sequence[str]) -> "Ask[list[MissingLabel]]":
    return lambda scene: scene.missing(arguments.limit)


def _changed(arguments: argparse.Namespace, words: Sequence[str]) -> "Ask[Difference]":
    revision = _id(words, "changed 120")
    if arguments.scene is not None:
        raise UsageError("a saved scene is of one revision; ask the running store, without --scene")
    return lambda scene: cast("Client", scene).changed_since(revision)


def _misput(form: str, example: str) -> UsageError:
    """That a question is not put as it is understood."""
    return UsageError(f"say `{form}`, such as `prior-sg query {example}`; a sentence goes in quotes")


def _name(words: Sequence[str], form: str, example: str) -> str:
    if not (name := " ".join(words).strip()):
        raise _misput(form, example)
    return name


def _numbers(words: Sequence[str], count: int, form: str, example: str) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise _misput(form, example)
    return numbers


def _id(words: Sequence[str], example: str) -> int:
    if len(words) != 1 or not words[0].removeprefix("-").isdecimal():
        raise _misput(f"{example.split(maxsplit=1)[0]} NUMBER", example)
    return int(words[0])


Asked = tuple[Callable[[argparse.Namespace, Sequence[str]], "Ask[Any]"], Callable[[Any], None]]
ASKED: dict[str, Asked] = {  # by first word; whatever else is a sentence
    "near": (_near, tables.show_things),
    "within": (_within, tables.show_things),
    "in-box": (_in_box, tables.show_things),
    "label": (_label, tables.show_things),
    "objects": (_objects, tables.show_things),
    "level": (_levels, tables.show_levels),
    "region": (_one, tables.show_one),
    "place": (_one, tables.show_one),
    "object": (_one, tables.show_one),
    "marker": (_markers, tables.show_markers),
    "route": (_route, tables.show_route),
    "unseen": (_unseen, tables.show_outlook),
    "changed": (_changed, tables.show_difference),
}
FOUND: Asked = (_find, tables.show_things)
ALONE: dict[str, Asked] = {"missing": (_missing, tables.show_missing)}  # with more words it begins a sentence
