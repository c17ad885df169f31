"""Answers of `prior-sg query` on the terminal."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from prior_sg.deploy.cli.shared import console
from prior_sg.deploy.terminal import Table
from prior_sg.schemas.foresight import REACH_M
from prior_sg.schemas.members import said

if TYPE_CHECKING:
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

DECIMALS = 2


def show_things(things: "Sequence[Thing]") -> None:
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


def show_levels(found: "Sequence[NodeWithRegions]") -> None:
    """One row each, with the regions in it."""
    table = Table("level", "id", "label", "probability", "area m²", "regions")
    for one in found:
        node, regions = one.node, ", ".join(f"{region.label} {region.id}" for region in one.regions)
        table.add_row(node.level, str(node.id), node.label, f"{node.probability:.2f}", f"{node.area_m2:.1f}", regions)
    console.print(table)


def show_one(found: "dict[str, Any]") -> None:
    """All about one thing."""
    details: Details = found["details"]
    neighbours: list[Neighbour] = found["neighbours"]
    if details.thing is not None:
        show_things([details.thing])
    if details.region is not None:
        region = details.region
        objects = f"objects {', '.join(map(str, region.object_ids))}" if region.object_ids else "no objects"
        console.print(f"{region.place_count} places, {region.area_m2:.1f} m², {objects}{_made_of(region.members)}")
        show_beliefs(found["beliefs"])
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


def show_markers(found: "list[MarkerInRegion]") -> None:
    """A line each."""
    for one in found:
        marker, region = one.marker, one.region
        where = "in no region" if region is None else f"in {region.label} (region {region.id})"
        doubt = f"; in doubt: {marker.doubt}" if marker.doubt else ""
        console.print(f"{marker.key} at {_at(marker.position_m)} {where}, from {marker.frames} keyframes{doubt}")


def _made_of(members: "Sequence[MapMember]") -> str:
    return f"; made of {', '.join(map(said, members))}" if members else ""


def show_beliefs(found: "RegionBeliefs") -> None:
    """What a region may be."""
    table = Table("label", "probability")
    for one in found.beliefs:
        table.add_row(one.label, f"{one.probability:.2f}")
    console.print(table)
    console.print(f"unknown {found.unknown:.2f}; {found.predicted_share:.0%} of {found.places} places predicted")


def show_route(found: "Route") -> None:
    """A way, or why there is none."""
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


def show_outlook(found: "Outlook") -> None:
    """Openings in the order in which to try them, and what that order goes by."""
    if found.found:
        console.print(f"seen already: {', '.join(f'{one.label} {one.id}' for one in found.found)}")
    console.print(f"another {found.label} behind any opening: {found.probability:.2f} (predicted)")
    leads = any(one.toward for one in found.prospects)
    begins = f"in {REACH_M:.0f} m"
    table = Table("per 10 m", "leads there", "way m", begins, "search m", "place", "width m", "region", "beyond m")
    for one in found.prospects:
        opening = one.opening
        table.add_row(
            f"{10 * one.per_metre:.2f}",
            f"{one.toward:.2f}" if leads else "-",
            f"{one.way_m:.1f}",
            f"{one.probability:.2f}",
            f"{one.expected_m:.1f}",
            str(opening.place_id),
            f"{opening.width_m:.1f}",
            str(opening.region),
            _at(opening.beyond_m),
        )
    console.print(table)
    console.print(_order_of(found.label, found.look_m, "leads there" if leads else begins))
    why = next(entry for entry in found.prospects[0].opening.labels if entry.label == found.label)
    told = (
        f"adjacency {why.adjacency:.2f}, existence {why.existence:.2f}, {why.found} found, {why.met} such borders met"
    )
    console.print(f"why the first: {told}")
    if found.route is not None:
        show_route(found.route)


def _order_of(label: str, look_m: float, chance: str) -> str:
    """What the columns of an outlook mean."""
    return (
        f"in the order of `per 10 m`: `{chance}` for every 10 m of the way and of a look behind ({look_m:.1f} m). "
        f"`leads there`: the chance that the nearest unseen {label} is come to through this opening, however far "
        f"behind; `in {REACH_M:.0f} m`: that one begins so near behind it; `search m`: what a search walks that "
        "begins with it"
    )


def show_missing(found: "list[MissingLabel]") -> None:
    """What is probably still to be found."""
    table = Table("label", "probability (predicted)", "found so far")
    for one in found:
        table.add_row(one.label, f"{one.probability:.2f}", str(one.found))
    console.print(table if found else "nothing")


def show_difference(found: "Difference") -> None:
    """What is new, gone and renamed."""
    for title, things in (("appeared", found.appeared), ("gone", found.gone)):
        if things:
            console.print(title)
            show_things(things)
    for one in found.renamed:
        console.print(f"{one.thing.what} {one.thing.id}: {one.former_label or '(no label)'} → {one.thing.label}")
    console.print(
        f"places: {found.places_appeared} new, {found.places_gone} gone, {found.places_relabelled} with another label"
    )


def _at(point_m: Sequence[float]) -> str:
    return " ".join(f"{value:.{DECIMALS}f}" for value in point_m)
