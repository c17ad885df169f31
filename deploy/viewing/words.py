"""What the page says, as HTML fragments (pure). All text from outside is escaped: names come from models and files."""

import base64
import html
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from prior_sg.deploy.api.client import Health
from prior_sg.deploy.inspecting.explain import gains
from prior_sg.deploy.showing.colors import Color
from prior_sg.deploy.viewing.drawing import edges_left_out, level_title
from prior_sg.deploy.viewing.search import Hit
from prior_sg.deploy.viewing.ways import Stop, Way
from prior_sg.schemas import members
from prior_sg.schemas.answers import MarkerInRegion, Thing
from prior_sg.schemas.levels import nodes_above
from prior_sg.schemas.members import said
from prior_sg.schemas.names import shown
from prior_sg.schemas.queries import Spot
from prior_sg.schemas.regions import NO_REGION, PosteriorReply, Region
from prior_sg.schemas.scene import Scene
from prior_sg.schemas.status import ServiceStatus

CANDIDATES, MOST_ROWS, MOST_LOSSES = 3, 40, 2
NEAR_M = 0.3  # a way that ends so close to what was asked for ends there
FAINT, SMALL = "opacity:.62", "opacity:.62;font-size:11.5px"
NUMBER = "flex:none;text-align:right;font-variant-numeric:tabular-nums"
TRACK = "background:rgba(128,138,150,.22)"
AGREES, DISAGREES = "#4E79A7", "#F28E2B"  # blue and orange: told apart by all eyes


def text_of(text: str) -> str:
    """A text from outside, safe in HTML."""
    return html.escape(shown(text), quote=True)


def headline(scene: Scene, title: str) -> str:
    """The task in force, where, and how much there is."""
    task = text_of(members.headline(scene.task, scene.merged_of, scene.plain))
    counts = ", ".join(
        _counted(count, name)
        for count, name in (
            (len(scene.regions), "region"),
            (len(scene.place_ids), "place"),
            (len(scene.objects), "object"),
        )
    )
    if (one_of := edges_left_out(scene)) > 1:
        counts += f"; one of {one_of} edges is drawn"
    named = f"{scene.robot}, {members.merged_map(scene.merged_of)}" if scene.merged_of else scene.robot
    where = " · ".join(part for part in (text_of(scene.environment), text_of(named), text_of(title)) if part)
    return (
        f'<div style="{_BOX};padding-bottom:8px"><div style="font-size:19px;font-weight:650;line-height:1.25">{task}'
        f'</div><div style="font-size:12px;{FAINT};margin-top:3px">{where}<br>{counts}</div></div>'
    )


def _counted(count: int, name: str, several: str = "") -> str:
    return f"{count} {name if count == 1 else several or name + 's'}"


_BOX = "padding:2px 12px 6px;font-size:13px;line-height:1.4"


def legend(scene: Scene, colors: Mapping[str, Color]) -> str:
    """Regions, largest first: colour, name, what else they may be, probability and area."""
    if not scene.regions:
        if scene.merged_of:
            return note(f"no regions yet: they come with a task of {' or '.join(scene.merged_of)}")
        return note("no regions yet: they come with the first images and a task")
    ordered = sorted(scene.regions, key=lambda region: -region.area_m2)
    rows = "".join(_legend_row(scene, region, colors[region.label]) for region in ordered[:MOST_ROWS])
    more = len(ordered) - MOST_ROWS
    return (
        f'<div style="{_BOX}">{rows}{f"and {more} smaller ones, on the map and under Find" if more > 0 else ""}</div>'
    )


def _legend_row(scene: Scene, region: Region, color: Color) -> str:
    others = ", ".join(f"{text_of(name)} {_percent(share)}" for name, share in candidates(scene, region)[1:])
    fill = f"border:2px dashed rgb{color}" if region.predicted else f"background:rgb{color};border:2px solid rgb{color}"
    kind = " <i>predicted</i>" if region.predicted else ""
    return (
        '<div style="display:flex;gap:9px;align-items:baseline;padding:4px 0">'
        f'<span style="flex:none;width:10px;height:10px;border-radius:3px;{fill}"></span>'
        f'<span style="flex:1;min-width:0"><b style="font-weight:600">{text_of(region.label)}</b>{kind}'
        f'<span style="{SMALL};display:block">{f"or {others}" if others else "no other"}</span></span>'
        f'<span style="{NUMBER}">{_percent(region.probability)}'
        f'<span style="{SMALL};display:block">{region.area_m2:.0f} m²</span></span></div>'
    )


def candidates(scene: Scene, region: Region) -> list[tuple[str, float]]:
    """The region's label and the likeliest others, with their mean posterior over its places."""
    rows = scene.place_regions == region.id
    if not rows.any() or not scene.labels:
        return [(region.label, region.probability)]
    mean = scene.posteriors[rows].astype(np.float32).mean(axis=0)
    others = [column for column in np.argsort(-mean).tolist() if scene.labels[column] != region.label]
    return [(region.label, region.probability), *((scene.labels[c], float(mean[c])) for c in others[: CANDIDATES - 1])]


def region_story(scene: Scene, region: Region) -> str:
    """A region in words: what it is, what it may be, what it holds and where it leads."""
    names = {other.id: other.label for other in scene.regions}
    held = sorted({item.label for item in scene.objects if item.id in set(region.object_ids) and item.label})
    doors = sum(way.door for way in region.transitions)
    ways = sorted({names[other] for other in region.neighbour_ids if other in names})
    lines = [
        f"{_counted(region.place_count, 'place')}, {region.area_m2:.1f} m², {_percent(region.unknown)} unknown",
        f"holds {', '.join(map(text_of, held))}" if held else "holds no named object",
        f"leads to {', '.join(map(text_of, ways))}" + (f" ({_counted(doors, 'door')})" if doors else "")
        if ways
        else "leads nowhere yet",
    ]
    if above := nodes_above(scene.nodes).get(region.id):
        lines.append("in " + ", ".join(text_of(level_title(node)) for node in above))
    if region.members:
        lines.append("made of " + ", ".join(text_of(said(member)) for member in region.members))
    if region.predicted:
        lines.insert(0, "a prediction from its surroundings: barely seen itself")
    likely = candidates(scene, region)
    bars = _bars(likely, AGREES) + _others(len(scene.labels) - len(likely), f"region {region.id}")
    return f'{_title(region.label, f"region {region.id}")}<div style="{_BOX}">{"<br>".join(lines)}{bars}</div>'


def marker_story(found: MarkerInRegion) -> str:
    """A printed marker in words: where it is, from how many keyframes, and what is doubtful about it."""
    marker, region = found.marker, found.region
    x, y, z = marker.position_m
    where = "in no region yet" if region is None else f"in {text_of(region.label)} (region {region.id})"
    lines = [
        f"{where}, at x {x:.2f}, y {y:.2f}, z {z:.2f} m",
        f"{100 * marker.size_m:.1f} cm wide, seen in {_counted(marker.frames, 'keyframe')}",
        f"in doubt: {text_of(marker.doubt)}; nothing is concluded from it" if marker.doubt else "no doubt about it",
    ]
    title = _title(f"marker {marker.id}", marker.dictionary)
    return f'{title}<div style="{_BOX}">{"<br>".join(lines)}</div>'


def place_story(scene: Scene, place: int) -> str:
    """What the scene itself says of a place."""
    row = int(np.searchsorted(scene.place_ids, place))
    belief = scene.posteriors[row].astype(float).tolist()
    ranked = sorted(zip(scene.labels, belief, strict=True), key=lambda pair: -pair[1])[: CANDIDATES + 2]
    label = next((region.label for region in scene.regions if region.id == scene.place_regions[row]), "")
    said = f"unknown {_percent(float(scene.unknown[row]))}, {2 * float(scene.radii_m[row]):.1f} m of free space around"
    title = _title(label or "not labelled yet", f"place {place}")
    others = _others(len(scene.labels) - len(ranked), f"place {place}")
    return f'{title}<div style="{_BOX}">{said}{_bars(ranked, AGREES)}{others}</div>'


def _others(count: int, thing: str) -> str:
    """That there are so many labels more, and where to see them."""
    return f'<div style="{SMALL}">{_counted(count, "other label")}: prior-sg query {thing}</div>' if count > 0 else ""


def explanation(reply: PosteriorReply) -> str:
    """Why a place carries its label: who speaks for it and who against, before the runner-up."""
    seen = f"seen in {_counted(reply.frames, 'image')}" if reply.frames else "never seen"
    rival, by_source = gains(reply)
    if not rival:
        return note(f"the prior knows no region but {reply.label}")
    ordered = sorted(by_source.items(), key=lambda pair: -abs(pair[1]))
    parts = [(source, gain) for source, gain in ordered if abs(gain) >= 0.005]
    total = sum(by_source.values())
    most = max((abs(gain) for _, gain in parts), default=1.0)
    rows = "".join(_gain_row(source, gain, most) for source, gain in parts)
    silent = [source for source, gain in ordered if abs(gain) < 0.005]
    quiet = f'<div style="{SMALL}">no opinion: {", ".join(map(text_of, silent))}</div>' if silent else ""
    who = f"place {reply.place_id}, {seen}" + (", predicted" if reply.predicted else "")
    return (
        f'<div style="{_BOX}"><div style="font-weight:600;margin-top:6px">Why {text_of(reply.label)} and not '
        f'{text_of(rival)}?</div><div style="{SMALL}">{who}; together {total:+.2f}, '
        f"to the right speaks for it</div>{rows}{quiet}</div>"
    )


def _gain_row(source: str, gain: float, most: float) -> str:
    width = 50 * abs(gain) / most
    side = f"left:50%;width:{width:.1f}%" if gain > 0 else f"right:50%;width:{width:.1f}%"
    color = AGREES if gain > 0 else DISAGREES
    return (
        f'<div style="display:flex;gap:8px;align-items:center;padding:2px 0"><span style="flex:none;width:92px;'
        f'overflow:hidden;text-overflow:ellipsis">{text_of(source)}</span>'
        f'<span style="flex:1;position:relative;height:9px;border-radius:5px;{TRACK}">'
        f'<span style="position:absolute;top:0;bottom:0;{side};background:{color};'
        f'border-radius:5px"></span></span><span style="width:44px;{NUMBER}">{gain:+.2f}</span></div>'
    )


def _bars(shares: Sequence[tuple[str, float]], color: str) -> str:
    return '<div style="margin-top:6px">' + "".join(_bar(name, share, color) for name, share in shares) + "</div>"


def _bar(name: str, share: float, color: str) -> str:
    return (
        '<div style="display:flex;gap:8px;align-items:center;padding:2px 0"><span style="flex:none;width:92px;'
        f'overflow:hidden;text-overflow:ellipsis;white-space:nowrap">{text_of(name)}</span>'
        f'<span style="flex:1;height:9px;border-radius:5px;{TRACK}"><span style="display:block;height:100%;'
        f'border-radius:5px;width:{100 * min(max(share, 0.0), 1.0):.1f}%;background:{color}"></span></span>'
        f'<span style="width:44px;{NUMBER}">{_percent(share)}</span>'
        "</div>"
    )


def health_table(health: Health | None) -> str:
    """Every process: how fast, what it dropped, what is wrong."""
    if health is None:
        return note("a recording has no processes")
    if not health.processes and not health.silent:
        return note("no service is running; start them with `prior-sg up`")
    rows = [_process_row(one.instance, *_state_of(one)) for one in health.processes]
    rows += [_process_row(instance, False, text_of(reason)) for instance, reason in sorted(health.silent.items())]
    return f'<div style="{_BOX}">{"".join(rows)}</div>'


def _state_of(process: ServiceStatus) -> tuple[bool, str]:
    lost = sum(topic.missed + topic.malformed for topic in process.topics)
    faults = [f"{lost} messages lost"] if lost else []
    faults += [f"waits for {name}" for name in process.waiting_for]
    busy = f"{_percent(process.busy_share)} busy, {process.step_ms_p50:.0f} ms a step, {process.backlog} waiting"
    told = [
        busy,
        f"{process.resident_mb:.0f} MB",
        *faults,
        *(f"{loss.count} {loss.what}" for loss in process.losses[:MOST_LOSSES]),
    ]
    if (more := len(process.losses) - MOST_LOSSES) > 0:
        told.append(f"and {_counted(more, 'other loss', 'other losses')}: prior-sg health")
    return not faults, text_of(", ".join(told))


def _process_row(name: str, well: bool, told: str) -> str:
    mark = ("●", "#59A14F", "runs") if well else ("▲", "#E15759", "has trouble")
    return (
        f'<div style="padding:3px 0"><span style="color:{mark[1]}" title="{mark[2]}">{mark[0]}</span>'
        f" <b>{text_of(name)}</b>"
        f'<div style="{SMALL};margin-left:17px">{told}</div></div>'
    )


def answers(found: Iterable[Hit]) -> str:
    """Results of a search, best first: number, name, kind and score."""
    rows = "".join(
        f'<div style="display:flex;gap:8px;padding:2px 0"><span style="{FAINT}">{number}</span><span style="flex:1">'
        f'<b style="font-weight:600">{text_of(hit.label)}</b>'
        f' <span style="{FAINT}">{text_of(hit.what)}</span></span>'
        f'<span style="{NUMBER}">{"" if hit.score is None else _percent(hit.score)}</span></div>'
        for number, hit in enumerate(found, 1)
    )
    return f'<div style="{_BOX}">{rows}</div>' if rows else ""


def way_story(way: Way) -> str:
    """A way in words: where to, how long and how wide, what it passes, and what of it nobody has checked."""
    route, goal = way.route, way.route.goal
    found = "Way" if route.found else "No way"
    there = _marker_of(way.trip.goal)
    if goal:
        title = _title(f"{found} to {goal.label or 'there'}", f"{goal.what} {goal.id}")
    else:
        title = _title(f"{found} to {there}" if there else found, "")
    begin = way.trip.start
    start = "where the robot is" if begin.here else _marker_of(begin) or _told_thing(route.start)
    if not route.found:
        return title + note(route.reason)
    lines = [
        f"<b>{route.length_m:.1f} m</b> from {start}",
        f"at least {route.clearance_m:.2f} m to whatever is beside it",
        *([_passed(way.stops)] if way.stops else []),
        *(
            f"not known to be free: {gap_m:.1f} m {where}"
            for gap_m, where in ((route.start_gap_m, "at its start"), (route.goal_gap_m, "at its end"))
            if gap_m > NEAR_M
        ),
    ]
    return f'{title}<div style="{_BOX}">{"<br>".join(lines)}</div>'


def _passed(stops: Sequence[Stop]) -> str:
    """What a way leads through, with the numbers that stand on the map."""
    first, *then = (text_of(stop.label) for stop in stops)
    return f"{first} → " + " → ".join(f"{n} {label}" for n, label in enumerate(then, 1)) if then else f"within {first}"


def _marker_of(spot: Spot) -> str:
    """The marker that an end of a way is; empty where it is none."""
    return f"marker {spot.id}" if spot.what == "marker" else ""


def _told_thing(thing: Thing | None) -> str:
    return "the point chosen" if thing is None else text_of(f"{thing.label or thing.what} ({thing.what} {thing.id})")


def card(svg: str) -> str:
    """A picture on white, as wide as there is room; as an image, in which nothing runs."""
    data = base64.b64encode(svg.encode()).decode()
    return (
        '<div style="margin:6px 12px;border-radius:8px;overflow:hidden;background:#fff">'
        f'<img alt="the prior as a graph" style="display:block;width:100%" '
        f'src="data:image/svg+xml;base64,{data}"></div>'
    )


def note(text: str) -> str:
    """A faint sentence."""
    return f'<div style="{_BOX};{FAINT}">{text_of(text)}</div>'


def _title(name: str, kind: str) -> str:
    return (
        f'<div style="{_BOX};padding-bottom:0"><span style="font-size:17px;font-weight:650">{text_of(name)}</span> '
        f'<span style="{FAINT}">{text_of(kind)}</span></div>'
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f}\N{NO-BREAK SPACE}%"


def region_of(scene: Scene, region: int) -> Region | None:
    """The region of an id."""
    return next((one for one in scene.regions if one.id == region and region != NO_REGION), None)
