"""A scene as a picture, without the page that shows it (pure).

Places and edges lie in blocks of consecutive ids, so that a change sends the blocks it touches. Predicted regions are
faint and dashed; unknown places fade to grey; boxes larger than furniture stay out, as in the printed map.
"""

import re
from dataclasses import dataclass, field

import numpy as np

from prior_sg.deploy.showing.colors import UNLABELLED, Color, LabelColors
from prior_sg.deploy.showing.map import FURNITURE_M
from prior_sg.deploy.showing.places import SHOWN_AREA_M2
from prior_sg.deploy.viewing.footprint import Footprint, Grounds
from prior_sg.deploy.viewing.shapes import Arrows, Lines, Mesh, Name, Picture, Points, dashed
from prior_sg.schemas.levels import LEVELS, LevelName, LevelNode, regions_in
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.names import shown
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import NO_REGION, Region
from prior_sg.schemas.scene import Scene
from prior_sg.services.geometry import pose_from_quaternion, transform

NO_NAME = r"\W"
BLOCK = 4096  # consecutive ids of places whose dots and edges are one shape
OBJECT_BLOCK = 512
MOST_EDGES = 60_000
MOST_NAMES = 60  # of objects: more cover each other
PLACE_M, LIT_PLACE_M, EDGE_PX = 0.085, 0.2, 0.75
FAINTER = 0.45  # edges than their places
ABOVE_FLOOR_M = 0.14  # of regions, so that floor points do not shine through
FLOOR_OPACITY, PREDICTED_OPACITY, DIMMED_OPACITY = 0.5, 0.16, 0.1
DASH_M = 0.18
ABOVE_REGIONS_M, LEVEL_NAME_ABOVE_M = 0.06, 0.9  # outlines of the levels above, each so much over the one below
PATH_DASH_M, ROBOT_NAME_ABOVE_M = 0.12, 0.45
LEAST_FORESEEN, MOST_FORESEEN = 0.1, 16  # expected regions: least probability, and how many are drawn
DISC_M, DISC_CORNERS = 0.6, 24
SHEET = np.array([(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)])  # of a marker, in its own frame
SHEET_OPACITY, MARKER_NAME_ABOVE_M = 0.85, 0.12
SHORT_ARROW_M, LONG_ARROW_M = 0.25, 0.8
CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
EDGES_OF_BOX = [(a, b) for a in range(8) for b in range(a) if abs(CORNERS[a] - CORNERS[b]).sum() == 1]


@dataclass(frozen=True)
class Theme:
    """Colours beside those of labels."""

    dark: bool
    background: Color
    ink: Color
    object: Color
    path: Color
    opening: Color = (230, 120, 20)
    light: Color = (255, 196, 0)  # of what a search found
    way: Color = (255, 45, 120)  # to what somebody asked for


DARK = Theme(True, (22, 25, 31), (236, 239, 244), (196, 204, 216), (246, 248, 250))
LIGHT = Theme(False, (246, 247, 249), (31, 35, 40), (75, 82, 92), (20, 20, 24))


@dataclass(frozen=True)
class Lit:
    """Ids that stand out; while there are any, regions without one are dimmed."""

    regions: frozenset[int] = frozenset()
    places: frozenset[int] = frozenset()
    objects: frozenset[int] = frozenset()
    picked: int = NO_REGION  # the region that somebody asks about: outlined, and dims nothing

    def __bool__(self) -> bool:
        return bool(self.regions or self.places or self.objects)


@dataclass
class Painter:
    """Draws one scene after another; labels keep their colours, ground that has not changed is kept."""

    theme: Theme = DARK
    colors: LabelColors = field(default_factory=LabelColors)
    level_colors: LabelColors = field(default_factory=LabelColors)
    grounds: Grounds = field(default_factory=Grounds)

    def ground(self, scene: Scene) -> dict[int, Footprint]:
        """The footprint of each region."""
        return self.grounds.of(scene)

    def label_colors(self, scene: Scene) -> dict[str, Color]:
        """The colour of each label that is on the map."""
        return self.colors.of(region.label for region in scene.regions)

    def draw(self, scene: Scene, lit: Lit = Lit()) -> Picture:
        """All of the scene but its points and images."""
        colors = self.label_colors(scene)
        picture: Picture = {}
        ground = self.ground(scene)
        for region in scene.regions:
            picture |= _region(self.theme, region, ground.get(region.id), colors[region.label], lit)
        picture |= _levels(scene, ground, self.level_colors.of(node.label for node in scene.nodes))
        tints = _place_tints(self.theme, scene, colors)
        picture |= _places(self.theme, scene, tints, lit)
        picture |= _edges(self.theme, scene, tints)
        picture |= _objects(self.theme, scene, lit)
        picture |= _openings(self.theme, scene)
        picture |= _markers(self.theme, scene)
        picture |= self._foreseen(scene)
        picture |= _path(self.theme, scene)
        return picture

    def _foreseen(self, scene: Scene) -> Picture:
        """Regions expected beyond openings: translucent discs in the colour of the likeliest label, which is named."""
        likely = [
            (opening, max(opening.labels, key=lambda entry: entry.next))
            for opening in scene.foresight.openings
            if opening.labels
        ]
        likely = [pair for pair in likely if pair[1].next >= LEAST_FORESEEN]
        likely = sorted(likely, key=lambda pair: -pair[1].next)[:MOST_FORESEEN]
        colors = self.colors.of(entry.label for _, entry in likely)
        picture: Picture = {}
        for opening, entry in likely:
            root = f"/foreseen/{opening.place_id}"
            x, y, z = opening.beyond_m
            way = np.array([[opening.position_m, opening.beyond_m]], np.float32)
            told = f"{shown(entry.label)} {100 * entry.next:.0f} %, expected"
            picture[f"{root}/disc"] = disc(opening.beyond_m, colors[entry.label], PREDICTED_OPACITY)
            picture[f"{root}/way"] = Lines(dashed(way, PATH_DASH_M), np.array(self.theme.opening, np.uint8), 1.5)
            picture[f"{root}/name"] = Name(told, (x, y, z + ROBOT_NAME_ABOVE_M), 0.65)
        return picture


def disc(center_m: tuple[float, float, float], color: Color, opacity: float) -> Mesh:
    """A level disc."""
    angles = np.linspace(0, 2 * np.pi, DISC_CORNERS, endpoint=False)
    rim = np.stack((np.cos(angles), np.sin(angles), np.zeros(DISC_CORNERS)), axis=1) * DISC_M
    following = (np.arange(DISC_CORNERS) + 1) % DISC_CORNERS
    faces = np.stack((np.zeros(DISC_CORNERS), np.arange(DISC_CORNERS) + 1, following + 1), axis=1)
    vertices = (np.vstack((np.zeros(3), rim)) + center_m).astype(np.float32)
    return Mesh(vertices, faces.astype(np.uint32), color, opacity)


def _region(theme: Theme, region: Region, ground: Footprint | None, color: Color, lit: Lit) -> Picture:
    """Its ground and outline, where it has any, and its name."""
    lifted = np.array((0, 0, ABOVE_FLOOR_M), np.float32)
    dimmed = bool(lit) and region.id not in lit.regions and not lit.objects.intersection(region.object_ids)
    found, chosen = region.id in lit.regions, region.id == lit.picked
    opacity = DIMMED_OPACITY if dimmed else PREDICTED_OPACITY if region.predicted else FLOOR_OPACITY
    root = f"/regions/{region.id}"
    x, y, z = region.position_m
    name = Name(title_of(region), (x, y, z), 0.75 if dimmed else 1.0)
    if ground is None:
        return {f"{root}/name": name}
    outline = ground.outline + 2 * lifted
    if region.predicted:
        middles = outline.mean(axis=1)
        outline = outline[np.floor((middles[:, 0] + 1.7 * middles[:, 1]) / DASH_M) % 2 == 0]
    tint = theme.light if found else theme.ink if chosen else mixed(color, theme.background, 0.6 if dimmed else 0.0)
    return {
        f"{root}/floor": Mesh(ground.vertices + lifted, ground.faces, color, opacity),
        f"{root}/outline": Lines(outline, np.array(tint, np.uint8), 4.0 if found or chosen else 2.0),
        f"{root}/name": name,
    }


def _levels(scene: Scene, ground: dict[int, Footprint], colors: dict[str, Color]) -> Picture:
    """Of each node above regions the outlines of its regions, and its name; a layer for each level."""
    picture: Picture = {}
    held: dict[tuple[LevelName, int], list[np.ndarray]] = {}
    for level in LEVELS:
        for region, number in regions_in(scene.nodes, level).items():
            if region in ground:
                held.setdefault((level, number), []).append(ground[region].outline)
    for node in scene.nodes:
        lifted = np.array((0, 0, ABOVE_FLOOR_M + ABOVE_REGIONS_M * (2 + LEVELS.index(node.level))), np.float32)
        root, (x, y, z) = f"/{node.level}s/{node.id}", node.position_m
        if outlines := held.get((node.level, node.id)):
            tint = np.array(colors[node.label], np.uint8)
            picture[f"{root}/outline"] = Lines(np.concatenate(outlines) + lifted, tint, 3.5)
        above_m = LEVEL_NAME_ABOVE_M * (1 + LEVELS.index(node.level))
        picture[f"{root}/name"] = Name(level_title(node), (x, y, z + above_m), 1.1)
    return picture


def level_title(node: LevelNode) -> str:
    """What a node of a level is called: several may have one label."""
    return f"{shown(node.label)} ({node.level} {node.id})"


def title_of(region: Region) -> str:
    """What stands on the map."""
    told = f"{shown(region.label)} {100 * region.probability:.0f} %"
    return f"{told}, predicted" if region.predicted else told


def _places(theme: Theme, scene: Scene, tints: np.ndarray, lit: Lit) -> Picture:
    picture: Picture = {}
    for block, rows in blocks(scene.place_ids, BLOCK):
        picture[f"/places/{block}"] = Points(scene.positions_m[rows], tints[rows], PLACE_M)
    found = np.flatnonzero(np.isin(scene.place_ids, list(lit.places)))
    if len(found):
        glow = np.tile(np.array(theme.light, np.uint8), (len(found), 1))
        picture["/answers/places"] = Points(scene.positions_m[found], glow, LIT_PLACE_M)
    return picture


def _place_tints(theme: Theme, scene: Scene, colors: dict[str, Color]) -> np.ndarray:
    """The colour of each place's region, greyer the more of its mass is unknown (place, 3)."""
    ids = np.array([region.id for region in scene.regions], np.int64)
    table = np.array([UNLABELLED, *(colors[region.label] for region in scene.regions)], np.float32)
    order = np.argsort(ids, kind="stable")
    at = np.searchsorted(ids[order], scene.place_regions) if len(ids) else np.zeros(len(scene.place_ids), int)
    at = np.minimum(at, max(len(ids) - 1, 0))
    known = ids[order][at] == scene.place_regions if len(ids) else np.zeros(len(scene.place_ids), bool)
    rows = np.where(known, order[at] + 1, 0) if len(ids) else np.zeros(len(scene.place_ids), int)
    grey = np.array(mixed(UNLABELLED, theme.background, 0.45), np.float32)
    share = np.clip(scene.unknown.astype(np.float32), 0, 1)[:, None] ** 2
    return (table[rows] * (1 - share) + grey * share).astype(np.uint8)


def _edges(theme: Theme, scene: Scene, tints: np.ndarray) -> Picture:
    """Between places that are there, in their fainter colours; an edge lies in the block of its larger id."""
    if not len(scene.edges):
        return {}
    rows = np.searchsorted(scene.place_ids, scene.edges)
    drawn = (rows < len(scene.place_ids)).all(axis=1) & (scene.edges.sum(axis=1) % edges_left_out(scene) == 0)
    rows = rows[drawn]
    faint = (tints * (1 - FAINTER) + np.array(theme.background) * FAINTER).astype(np.uint8)
    return {
        f"/edges/{block}": Lines(scene.positions_m[rows[of]], faint[rows[of]], EDGE_PX)
        for block, of in blocks(scene.place_ids[rows.max(axis=1)], BLOCK)
    }


def edges_left_out(scene: Scene) -> int:
    """One of how many edges is drawn: of very many, some show the graph as well, and browsers stay fluent."""
    return max(1, -(-len(scene.edges) // MOST_EDGES))


def blocks(ids: np.ndarray, size: int) -> list[tuple[int, np.ndarray]]:
    """Rows by block of consecutive ids."""
    numbers = ids // size
    return [(int(block), np.flatnonzero(numbers == block)) for block in np.unique(numbers)]


def is_furniture(item: SceneObject) -> bool:
    """Not a piece of a wall, nor several things that touch."""
    return max(high - low for low, high in zip(item.min_m[:2], item.max_m[:2], strict=True)) <= FURNITURE_M


def _objects(theme: Theme, scene: Scene, lit: Lit) -> Picture:
    """Boxes, darker with a name; names of those that are most surely something."""
    items = [item for item in scene.objects if is_furniture(item)]
    picture: Picture = {}
    for kind, named in (("objects", True), ("unnamed", False)):
        some = [item for item in items if bool(item.label) == named and item.id not in lit.objects]
        tint = theme.object if named else mixed(theme.object, theme.background, 0.7)
        for block, rows in blocks(np.array([item.id for item in some], np.int64), OBJECT_BLOCK):
            boxes = box_lines([some[row] for row in rows.tolist()])
            picture[f"/{kind}/boxes/{block}"] = Lines(boxes, np.array(tint, np.uint8), 1.5)
    found = [item for item in scene.objects if item.id in lit.objects]
    if found:
        picture["/answers/objects"] = Lines(box_lines(found), np.array(theme.light, np.uint8), 3.0)
    sure = sorted((item for item in items if item.label), key=lambda item: -item.known * item.probability)
    for item in [*found, *(item for item in sure if item.id not in lit.objects)][:MOST_NAMES]:
        x, y, _ = item.position_m
        text, layer = shown(item.label) or "object", "answers" if item.id in lit.objects else "objects"
        picture[f"/{layer}/names/{item.id}"] = Name(text, (x, y, item.max_m[2] + 0.1), 0.65)
    return picture


def box_lines(items: list[SceneObject]) -> np.ndarray:
    """Edges of boxes (12 * item, 2, 3)."""
    low = np.array([item.min_m for item in items], np.float32).reshape(-1, 1, 1, 3)
    high = np.array([item.max_m for item in items], np.float32).reshape(-1, 1, 1, 3)
    return (low + (high - low) * CORNERS[EDGES_OF_BOX]).reshape(-1, 2, 3).astype(np.float32)


def _openings(theme: Theme, scene: Scene) -> Picture:
    """Arrows into unobserved space, longer the wider the opening."""
    rows = np.searchsorted(scene.place_ids, scene.frontier_ids)
    shown_ = (scene.frontier_areas_m2 >= SHOWN_AREA_M2) & (rows < len(scene.place_ids))
    if not shown_.any():
        return {}
    starts = scene.positions_m[rows[shown_]]
    lengths = np.clip(np.sqrt(scene.frontier_areas_m2[shown_]) * 0.5, SHORT_ARROW_M, LONG_ARROW_M)
    ends = starts + scene.frontier_directions[shown_] * lengths[:, None]
    return {"/frontiers/arrows": Arrows(np.stack((starts, ends), axis=1).astype(np.float32), theme.opening, 0.015)}


def _markers(theme: Theme, scene: Scene) -> Picture:
    """Each printed marker as a sheet of its own size, and its name; one in doubt is only an outline, and says so."""
    picture: Picture = {}
    for marker in scene.markers:
        root = marker_root(marker)
        corners_m = sheet_of(marker)
        outline = np.stack((corners_m, np.roll(corners_m, -1, axis=0)), axis=1)
        tint = theme.opening if marker.doubt else theme.ink
        x, y, _ = marker.position_m
        above = (x, y, float(corners_m[:, 2].max()) + MARKER_NAME_ABOVE_M)
        picture[f"{root}/outline"] = Lines(outline, np.array(tint, np.uint8), 2.5)
        picture[f"{root}/name"] = Name(f"marker {marker.id}{', in doubt' if marker.doubt else ''}", above, 0.65)
        if not marker.doubt:
            faces = np.array([(0, 1, 2), (0, 2, 3)], np.uint32)
            picture[f"{root}/sheet"] = Mesh(corners_m, faces, tint, SHEET_OPACITY)
    return picture


def sheet_of(marker: SceneMarker) -> np.ndarray:
    """Corners (4, 3) of a marker's square, float32, world, from below left as it is printed."""
    pose = pose_from_quaternion(np.array(marker.position_m), np.array(marker.quaternion_xyzw))
    return transform(pose, marker.size_m * SHEET).astype(np.float32)


def marker_root(marker: SceneMarker) -> str:
    """What the names of its shapes begin with: the number first, and of its dictionary what no path is made of."""
    return f"/markers/{marker.id}/in_{re.sub(NO_NAME, '_', marker.dictionary)}"


def _path(theme: Theme, scene: Scene) -> Picture:
    """Where the robot has been, dashed and named, so that nobody takes it for a way to go: in blocks of keyframes."""
    if not len(scene.trajectory):
        return {}
    steps = np.stack((scene.trajectory[:-1], scene.trajectory[1:]), axis=1)
    color = np.array(theme.path, np.uint8)
    picture: Picture = {
        f"/trajectory/{block}": Lines(dashed(steps[rows], PATH_DASH_M), color, 1.8)
        for block, rows in blocks(np.arange(len(steps)), BLOCK)
    }
    x, y, z = scene.trajectory[-1].tolist()
    return picture | {"/trajectory/robot": Name("robot", (x, y, z + ROBOT_NAME_ABOVE_M), 0.75)}


def mixed(color: Color, other: Color, share: float) -> Color:
    """A colour with a share of another."""
    red, green, blue = (round(a * (1 - share) + b * share) for a, b in zip(color, other, strict=True))
    return red, green, blue
