"""`prior-sg query`: ask the map, in a sentence or by position, label and route."""

import argparse
import contextlib
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from prior_sg.deploy.cli.shared import Commands, add_bus, console
from prior_sg.deploy.errors import UserError
from prior_sg.schemas.levels import LEVELS
from prior_sg.schemas.members import said

if TYPE_CHECKING:
    from prior_sg.deploy.api.asking import Asking
    from prior_sg.deploy.api.client import Client
    from prior_sg.schemas.answers import (
        Details,
        Difference,
        MarkerInRegion,
        Neighbour,
        NodeWithRegions,
        Outlook,
        RegionBeliefs,
        Route,
        Thing,
    )
    from prior_sg.schemas.foresight import MissingLabel
    from prior_sg.schemas.members import MapMember

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
DECIMALS = 2


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

    if arguments.limit < 1:
        raise UserError("--limit must be at least 1")
    if arguments.object:
        arguments.what, arguments.label = "object", arguments.object
    word, *rest = arguments.words
    run, show = ASKED.get(word, FOUND) if rest else (ASKED | ALONE).get(word, FOUND)
    try:
        with warnings.catch_warnings(record=True) as said, _opened(arguments) as scene:
            warnings.simplefilter("always", UserWarning)
            if arguments.scene is None:
                _require_some(scene)
            found = run(scene, arguments, rest if run is not _find else arguments.words)
    except (NotInSceneError, ValueError) as error:  # the latter of what no question may hold
        raise UserError(str(error)) from error
    notes = [str(warning.message) for warning in said]
    if arguments.json:
        print(msgspec.json.encode({"answer": found, "notes": notes}).decode())
        return 0
    for note in notes:
        console.print(f"note: {note}")
    show(found)
    return 0


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


def _find(scene: "Asking", arguments: argparse.Namespace, words: Sequence[str]) -> "list[Thing]":
    return scene.find(" ".join(words), arguments.what, arguments.limit)


def _near(scene: "Asking", arguments: argparse.Namespace, words: Sequence[str]) -> "list[Thing]":
    point = _numbers(words, 3, "near X Y Z")
    return scene.near(point, arguments.limit, arguments.what or "object", arguments.label)


def _within(scene: "Asking", arguments: argparse.Namespace, words: Sequence[str]) -> "list[Thing]":
    *point, radius_m = _numbers(words, 4, "within X Y Z RADIUS")
    return scene.within(point, radius_m, arguments.what, arguments.label, arguments.limit)


def _in_box(scene: "Asking", arguments: argparse.Namespace, words: Sequence[str]) -> "list[Thing]":
    corners = _numbers(words, 6, "in-box X Y Z X Y Z")
    return scene.in_box(corners[:3], corners[3:], arguments.what, arguments.label, arguments.limit)


def _label(scene: "Asking", arguments: argparse.Namespace, words: Sequence[str]) -> "list[Thing]":
    return scene.labelled(" ".join(words), arguments.what, arguments.limit)


def _objects(scene: "Asking", arguments: argparse.Namespace, words: Sequence[str]) -> "list[Thing]":
    at = words.index("in") if "in" in words else len(words)
    return scene.objects_in(" ".join(words[at + 1 :]), " ".join(words[:at]) or arguments.label, arguments.limit)


def _one(scene: "Asking", arguments: argparse.Namespace, words: Sequence[str]) -> "dict[str, Any]":
    what: Any = arguments.words[0]
    number = _id(words, f"{what} 7")
    found: dict[str, Any] = {"details": scene.describe(what, number), "neighbours": scene.neighbours(what, number)}
    return found | ({"beliefs": scene.candidates(number, arguments.limit)} if what == "region" else {})


def _levels(scene: "Asking", arguments: argparse.Namespace, words: Sequence[str]) -> "list[NodeWithRegions]":
    level, *label = words or ("",)
    if level not in LEVELS:
        raise UserError(f"name a level: {', '.join(LEVELS)}; such as `prior-sg query level zone ward`")
    return scene.levels(level, " ".join(label) or arguments.label, limit=arguments.limit)


def _markers(scene: "Asking", arguments: argparse.Namespace, words: Sequence[str]) -> "list[MarkerInRegion]":
    return scene.markers(_id(words, "marker 7") if words else None, limit=arguments.limit)


def _route(scene: "Asking", arguments: argparse.Namespace, words: Sequence[str]) -> "Route":
    if len(words) != 2:
        raise UserError("a route needs two ends: prior-sg query route kitchen bedroom (quote names of several words)")
    return scene.route(words[0], words[1], arguments.clearance)


def _unseen(scene: "Asking", arguments: argparse.Namespace, words: Sequence[str]) -> "Outlook":
    return scene.where_to_look(" ".join(words), arguments.start, arguments.clearance, arguments.limit)


def _missing(scene: "Asking", arguments: argparse.Namespace, words: Sequence[str]) -> "list[MissingLabel]":
    return scene.missing(arguments.limit)


def _changed(scene: "Asking", arguments: argparse.Namespace, words: Sequence[str]) -> "Difference":
    from prior_sg.deploy.api.client import Client

    if not isinstance(scene, Client):
        raise UserError("a saved scene is of one revision; ask the running store, without --scene")
    return scene.changed_since(_id(words, "changed 120"))


def _numbers(words: Sequence[str], count: int, form: str) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise UserError(f"say `{form}` in metres of the world, or put a sentence in quotes; see prior-sg query --help")
    return numbers


def _id(words: Sequence[str], example: str) -> int:
    if len(words) != 1 or not words[0].removeprefix("-").isdecimal():
        raise UserError(f"name one number, such as `prior-sg query {example}`, or put a sentence in quotes")
    return int(words[0])


def _show_things(things: "Sequence[Thing]") -> None:
    """One row each, with the columns that this question fills."""
    if not things:
        console.print("nothing")
        return
    extra = [name for name in ("score", "distance_m") if getattr(things[0], name) is not None]
    table = Table(
        *(name.removesuffix("_m") for name in extra), "what", "id", "label", "probability", "region", "position m"
    )
    for one in things:
        label = f"{one.label or '(no label)'}{' (predicted)' if one.predicted else ''}"
        region = "-" if one.region < 0 or one.what == "region" else str(one.region)
        values = [f"{getattr(one, name):.{DECIMALS}f}" for name in extra]
        table.add_row(*values, one.what, str(one.id), label, f"{one.probability:.2f}", region, _at(one.position_m))
    console.print(table)


def _show_levels(found: "Sequence[NodeWithRegions]") -> None:
    table = Table("level", "id", "label", "probability", "area m²", "regions")
    for one in found:
        node, regions = one.node, ", ".join(f"{region.label} {region.id}" for region in one.regions)
        table.add_row(node.level, str(node.id), node.label, f"{node.probability:.2f}", f"{node.area_m2:.1f}", regions)
    console.print(table)


def _show_one(found: "dict[str, Any]") -> None:
    details: Details = found["details"]
    neighbours: list[Neighbour] = found["neighbours"]
    if details.thing is not None:
        _show_things([details.thing])
    if details.region is not None:
        region = details.region
        objects = f"objects {', '.join(map(str, region.object_ids))}" if region.object_ids else "no objects"
        console.print(f"{region.place_count} places, {region.area_m2:.1f} m², {objects}{_made_of(region.members)}")
        _show_beliefs(found["beliefs"])
    if details.place is not None:
        place = details.place
        beliefs = ", ".join(f"{one.label} {one.probability:.2f}" for one in place.beliefs)
        console.print(f"radius {place.radius_m:.2f} m, unknown {place.unknown:.2f}; {beliefs}")
    if details.object is not None:
        low, high = _at(details.object.min_m), _at(details.object.max_m)
        console.print(
            f"box from {low} to {high}, seen in {details.object.frames} keyframes{_made_of(details.object.members)}"
        )
    for one in neighbours:
        doors = f", {sum(way.door for way in one.ways)} doors of {len(one.ways)} ways" if one.ways else ""
        length = f", {one.length_m:.2f} m" if one.length_m else ""
        clearance = f", clearance {one.clearance_m:.2f} m" if one.clearance_m else ""
        console.print(f"beside {one.thing.what} {one.thing.id} {one.thing.label}{length}{clearance}{doors}")


def _show_markers(found: "list[MarkerInRegion]") -> None:
    for one in found:
        marker, region = one.marker, one.region
        where = "in no region" if region is None else f"in {region.label} (region {region.id})"
        doubt = f"; in doubt: {marker.doubt}" if marker.doubt else ""
        console.print(f"{marker.key} at {_at(marker.position_m)} {where}, from {marker.frames} keyframes{doubt}")


def _made_of(members: "Sequence[MapMember]") -> str:
    return f"; made of {', '.join(map(said, members))}" if members else ""


def _show_beliefs(found: "RegionBeliefs") -> None:
    table = Table("label", "probability")
    for one in found.beliefs:
        table.add_row(one.label, f"{one.probability:.2f}")
    console.print(table)
    console.print(f"unknown {found.unknown:.2f}; {found.predicted_share:.0%} of {found.places} places predicted")


def _show_route(found: "Route") -> None:
    if not found.found:
        console.print(found.reason)
        return
    gaps = f"; {found.start_gap_m:.2f} m from the start, {found.goal_gap_m:.2f} m from the goal"
    console.print(
        f"{found.length_m:.2f} m over {len(found.place_ids)} places, clearance {found.clearance_m:.2f} m{gaps}"
    )
    console.print("through " + (" → ".join(f"{one.label} {one.id}" for one in found.regions) or "no region"))
    table = Table("place", "position m")
    for number, point_m in zip(found.place_ids, found.waypoints_m, strict=True):
        table.add_row(str(number), _at(point_m))
    console.print(table)


def _show_outlook(found: "Outlook") -> None:
    if found.found:
        console.print(f"seen already: {', '.join(f'{one.label} {one.id}' for one in found.found)}")
    console.print(f"another {found.label} behind any opening: {found.probability:.2f} (predicted)")
    table = Table("expected m", "probability", "way m", "place", "width m", "out of", "beyond m")
    for one in found.prospects:
        opening = one.opening
        figures = (f"{one.expected_m:.1f}", f"{one.probability:.3f}", f"{one.way_m:.1f}", str(opening.place_id))
        table.add_row(*figures, f"{opening.width_m:.1f}", f"region {opening.region}", _at(opening.beyond_m))
    console.print(table)
    why = next(entry for entry in found.prospects[0].opening.labels if entry.label == found.label)
    told = (
        f"adjacency {why.adjacency:.2f}, existence {why.existence:.2f}, {why.found} found, {why.met} such borders met"
    )
    console.print(f"why the first: {told}")
    if found.route is not None:
        _show_route(found.route)


def _show_missing(found: "list[MissingLabel]") -> None:
    table = Table("label", "probability (predicted)", "found so far")
    for one in found:
        table.add_row(one.label, f"{one.probability:.2f}", str(one.found))
    console.print(table if found else "nothing")


def _show_difference(found: "Difference") -> None:
    for title, things in (("appeared", found.appeared), ("gone", found.gone)):
        if things:
            console.print(title)
            _show_things(things)
    for one in found.renamed:
        console.print(f"{one.thing.what} {one.thing.id}: {one.former_label or '(no label)'} → {one.thing.label}")
    console.print(
        f"places: {found.places_appeared} new, {found.places_gone} gone, {found.places_relabelled} with another label"
    )


def _at(point_m: Sequence[float]) -> str:
    return " ".join(f"{value:.{DECIMALS}f}" for value in point_m)


Asked = tuple[Callable[["Asking", argparse.Namespace, Sequence[str]], Any], Callable[[Any], None]]
ASKED: dict[str, Asked] = {  # by first word; whatever else is a sentence
    "near": (_near, _show_things),
    "within": (_within, _show_things),
    "in-box": (_in_box, _show_things),
    "label": (_label, _show_things),
    "objects": (_objects, _show_things),
    "level": (_levels, _show_levels),
    "region": (_one, _show_one),
    "place": (_one, _show_one),
    "object": (_one, _show_one),
    "marker": (_markers, _show_markers),
    "route": (_route, _show_route),
    "unseen": (_unseen, _show_outlook),
    "changed": (_changed, _show_difference),
}
FOUND: Asked = (_find, _show_things)
ALONE: dict[str, Asked] = {"missing": (_missing, _show_missing)}  # words that ask by themselves, and begin sentences
