"""Homes drawn from a prior graph, for `prior-sg bench learning`.

A home is a square of rooms, each of one label; rooms side by side are joined by a door. Labels are drawn from
P(r | E0), their layout from the odds of P(ri <-> rj), objects from P(o | r). A robot sees it badly: a room looks partly
like one of another label, objects are missed or mistaken.
"""

from dataclasses import dataclass

import msgspec
import numpy as np

from prior_sg.schemas.features import Pyramid, TextEmbeddings, TextRequest
from prior_sg.schemas.frames import Intrinsics
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import Prior
from prior_sg.services.segmenter.core.experts.context import ObjectView

ROBOT = "bench"
WIDTH = 3  # rooms
ROOM_STEPS = 4  # places, 1 m apart
SHUFFLES = 1000  # exchanges of two rooms while a layout is drawn
SAME = 0.1  # P(touching) of two rooms of one label, which would be one region; small, but layouts must stay reachable
VIEWS = 6  # keyframes of a room
LEAST_LOOKALIKE = 0.2
CROP_NOISE = 0.15  # of each number of a crop's embedding
CAMERA = Intrinsics(width_px=64, height_px=48, fx_px=40.0, fy_px=40.0, cx_px=31.5, cy_px=23.5)
_ROOMS = np.arange(WIDTH**2).reshape(WIDTH, WIDTH)
DOORS = np.concatenate(  # (door, 2) rooms
    [np.stack((a.ravel(), b.ravel()), 1) for a, b in ((_ROOMS[:-1], _ROOMS[1:]), (_ROOMS[:, :-1], _ROOMS[:, 1:]))]
)


@dataclass(frozen=True)
class Sight:
    """How well a robot sees."""

    lookalike: float  # how much at most a room looks like another label, against its own; at least LEAST_LOOKALIKE
    detected: float  # share of the objects
    mistaken: float  # share of those that are taken for any other, believed as firmly as the rest


def layouts(prior: Prior, homes: int, rng: np.random.Generator) -> np.ndarray:
    """Label (home, room) of each room: P(r | E0), then P(layout) ~ product over the doors of the odds of touching.

    That is the distribution of independent P(ri <-> rj), given that the rooms which touch form this square; drawn by
    Metropolis exchanges, which in crowded homes with firm odds stop a little short of it.
    """
    existence = np.array([region.existence for region in prior.regions])
    labels = rng.choice(len(existence), (homes, WIDTH**2), p=existence / existence.sum())
    touching = np.clip(prior.adjacency.astype(float), 1e-3, 1 - 1e-3)
    np.fill_diagonal(touching, SAME)
    log_odds = np.log(touching / (1 - touching))

    def score(drawn: np.ndarray) -> np.ndarray:
        return np.asarray(log_odds[drawn[:, DOORS[:, 0]], drawn[:, DOORS[:, 1]]].sum(axis=1))

    for _ in range(SHUFFLES):
        one, other = rng.choice(WIDTH**2, 2, replace=False)
        proposed = labels.copy()
        proposed[:, [one, other]] = labels[:, [other, one]]
        gain = score(proposed) - score(labels)
        accepted = np.log(rng.uniform(size=homes)) < gain
        labels[accepted] = proposed[accepted]
    return labels


def touching_frequency(labels: np.ndarray, count: int) -> np.ndarray:
    """Share (label, label) of the pairs of rooms with these labels that touch; NaN where there was no pair."""
    pairs, touching = np.zeros((count, count)), np.zeros((count, count))
    first, second = np.triu_indices(labels.shape[1], 1)
    for counts, one, other in ((pairs, first, second), (touching, DOORS[:, 0], DOORS[:, 1])):
        np.add.at(counts, (labels[:, one], labels[:, other]), 1)
        np.add.at(counts, (labels[:, other], labels[:, one]), 1)
    with np.errstate(invalid="ignore"):
        return np.asarray(touching / pairs)


@dataclass(frozen=True)
class Home:
    """What there is, and what a robot receives of it."""

    truth: np.ndarray  # (place,) label
    places: PlaceDelta
    pyramids: list[Pyramid]
    objects: ObjectView


def home(labels: np.ndarray, prior: Prior, sight: Sight, space: str, rng: np.random.Generator) -> Home:
    """One home with the rooms `labels` (room,), objects of which follow `prior`, as it is seen."""
    side = WIDTH * ROOM_STEPS
    x, y = (axis.ravel() for axis in np.mgrid[:side, :side])
    room = _ROOMS[x // ROOM_STEPS, y // ROOM_STEPS]
    positions_m = np.stack((x + 0.5, y + 0.5, np.ones(side**2)), axis=1)
    looks = [look(int(label), len(prior.regions), sight, rng) for label in labels]
    pyramids = [
        pyramid(index * VIEWS + view, middle_m(index), 2 * np.pi * view / VIEWS, looks[index], space=space, rng=rng)
        for index in range(len(labels))
        for view in range(VIEWS)
    ]
    return Home(labels[room], _delta(positions_m, _edges(side)), pyramids, furniture(labels, prior, sight, rng))


def look(label: int, labels: int, sight: Sight, rng: np.random.Generator) -> np.ndarray:
    """What a room of this label looks like (label,): like itself, and partly like one other."""
    other = (label + rng.integers(1, labels)) % labels
    return np.eye(labels)[label] + rng.uniform(LEAST_LOOKALIKE, sight.lookalike) * np.eye(labels)[other]


def middle_m(room: int) -> np.ndarray:
    """Middle (x, y) of a room."""
    return (np.array(divmod(room, WIDTH)) + 0.5) * ROOM_STEPS


def pyramid(
    frame_id: int, at_m: np.ndarray, heading_rad: float, seen: np.ndarray, *, space: str, rng: np.random.Generator
) -> Pyramid:
    """What a level camera in the middle of a room sees; the doors are shut to it."""
    forward, down = np.array((np.cos(heading_rad), np.sin(heading_rad), 0.0)), np.array((0.0, 0.0, -1.0))
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = np.cross(down, forward), down, forward, (*at_m, 1.0)
    columns_px = (np.arange(16) + 0.5) * 4 - 0.5
    rays = (columns_px[:, None] - CAMERA.cx_px) / CAMERA.fx_px * pose[:3, 0] + forward  # of depth 1
    depth_m = ROOM_STEPS / 2 / np.abs(rays[:, :2]).max(axis=1)
    sides_px = np.repeat((24.0, 48.0), (6, 3))
    centers_px = np.concatenate([np.arange(0, 64 - side + 1, 8) + side / 2 - 0.5 for side in (24, 48)])
    embeddings = seen + CROP_NOISE * rng.standard_normal((len(sides_px), len(seen)))
    return Pyramid(
        robot=ROBOT,
        frame_id=frame_id,
        stamp_ns=frame_id,
        space=space,
        worker=ROBOT,
        intrinsics=CAMERA,
        world_from_camera=pose,
        centers_px=np.stack((centers_px, np.full(len(sides_px), 23.5)), axis=1).astype(np.float32),
        sigmas_px=(sides_px / 2).astype(np.float32),
        layers=(sides_px > 24).astype(np.uint8),
        depths_m=np.full(len(sides_px), 2.0, np.float32),
        embeddings=(embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True)).astype(np.float16),
        surface_m=np.tile(depth_m.astype(np.float32), (12, 1)),
        crops_total=len(sides_px),
    )


def furniture(labels: np.ndarray, prior: Prior, sight: Sight, rng: np.random.Generator) -> ObjectView:
    """The objects of all rooms that were detected, with a belief in what each is."""
    room, kind = np.nonzero(
        rng.uniform(size=(len(labels), len(prior.objects))) < sight.detected * prior.containment[labels]
    )
    taken_for = np.where(
        rng.uniform(size=len(kind)) < sight.mistaken, rng.integers(0, len(prior.objects), len(kind)), kind
    )
    concepts = np.full((len(kind), len(prior.objects)), sight.mistaken / (len(prior.objects) - 1))
    concepts[np.arange(len(kind)), taken_for] = 1 - sight.mistaken
    corners_m = np.array([middle_m(int(index)) for index in room]).reshape(-1, 2) - ROOM_STEPS / 2
    spots_m = corners_m + rng.uniform(0.3, ROOM_STEPS - 0.3, corners_m.shape)
    return ObjectView(np.arange(len(kind)), np.column_stack((spots_m, np.full(len(kind), 0.8))), concepts)


def text(request: TextRequest, prior: Prior) -> TextEmbeddings:
    """The concept of each region, by its first phrase; another revision's objects do not change what it looks like."""
    rows = {region.phrases[0]: row for row, region in enumerate(prior.regions)}
    count = len(request.concepts)
    return TextEmbeddings(
        space=request.space,
        embeddings=np.eye(len(rows), dtype=np.float32)[[rows[phrases[0]] for phrases in request.concepts]],
        background_mean=np.full(count, 0.3, np.float32),
        background_std=np.full(count, 0.25, np.float32),
        temperature=2.0,
        null_score=0.0,
    )


def exchanged(prior: Prior, pairs: int, rng: np.random.Generator) -> Prior:
    """The same names, but `pairs` of regions have exchanged their objects, neighbours and frequencies."""
    order, moved = np.arange(len(prior.regions)), rng.permutation(len(prior.regions))[: 2 * pairs].reshape(-1, 2)
    order[moved] = order[moved[:, ::-1]]
    regions = [
        msgspec.structs.replace(region, existence=prior.regions[source].existence)
        for region, source in zip(prior.regions, order.tolist(), strict=True)
    ]
    return msgspec.structs.replace(
        prior, regions=regions, containment=prior.containment[order], adjacency=prior.adjacency[np.ix_(order, order)]
    )


def _edges(side: int) -> np.ndarray:
    """Neighbours on the grid; between rooms only at the two doorway places."""
    grid, found = np.arange(side**2).reshape(side, side), []
    for rows in (grid, grid.T):
        wall = (np.arange(1, side) % ROOM_STEPS == 0)[:, None]
        door = np.isin(np.arange(side) % ROOM_STEPS, (1, 2))
        passable = ~wall | door
        found.append(np.stack((rows[:-1][passable], rows[1:][passable]), axis=1))
    return np.concatenate(found)


def _delta(positions_m: np.ndarray, edges: np.ndarray) -> PlaceDelta:
    none = np.zeros(0, np.int64)
    return PlaceDelta(
        robot=ROBOT,
        epoch=1,
        revision=0,
        stamp_ns=1,
        frame_id=0,
        place_ids=np.arange(len(positions_m)),
        positions_m=positions_m.astype(np.float32),
        radii_m=np.full(len(positions_m), 0.5, np.float32),
        basis_points=np.full(len(positions_m), 3, np.int16),
        removed_ids=none,
        merged_ids=none.reshape(0, 2),
        edges=np.sort(edges, axis=1),
        clearances_m=np.full(len(edges), 0.4, np.float32),
        removed_edges=none.reshape(0, 2),
    )
