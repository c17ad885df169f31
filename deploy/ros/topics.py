"""Which topics a scene becomes, and their messages (pure): drawn anew for each scene, told where they have changed."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.ros import frames, grids, masks, messages
from prior_sg.deploy.ros.grids import CellValues, Ground
from prior_sg.deploy.ros.markers import ARRAY, marker_array
from prior_sg.deploy.ros.messages import Classes
from prior_sg.deploy.ros.rules import Look
from prior_sg.deploy.showing.export import scene_json
from prior_sg.deploy.viewing.drawing import Painter
from prior_sg.schemas.scene import Scene

STRING = "std_msgs/msg/String"
MARKERS, REGION_GRID, FREE_GRID, TABLE, SCENE, TASK_STATE = (
    "markers",
    "region_grid",
    "free_grid",
    "regions",
    "scene",
    "task",
)
LATCHED = {
    MARKERS: ARRAY,
    REGION_GRID: grids.GRID,
    FREE_GRID: grids.GRID,
    TABLE: STRING,
    SCENE: STRING,
    TASK_STATE: STRING,
}
TF_TOPIC, SET_TASK = "/tf", "set_task"


def latched_types(look: Look) -> dict[str, str]:
    """Types of the latched topics by their names within the node."""
    types = dict(LATCHED)
    for of in look.filters():
        types |= {f"{of}_mask": grids.GRID, f"{of}_info": masks.INFO}
    return types


@dataclass
class Teller:
    """Makes messages of one scene after another: colours and values of regions stay what they are."""

    classes: Classes
    look: Look
    painter: Painter = field(default_factory=Painter)
    values: CellValues = field(default_factory=CellValues)

    def about(self, scene: Scene) -> Iterator[tuple[str, Any]]:
        """Topic within the node and message, of all that a scene says."""
        ground = grids.ground_of(scene, self.look.cell_m, self.look.heights_m)
        values = self._values(scene)
        yield MARKERS, marker_array(self.classes, self.painter.draw(scene), self.look.frame)
        yield REGION_GRID, self._grid(ground, grids.region_cells(ground, values))
        yield FREE_GRID, self._grid(ground, grids.free_cells(ground))
        yield TABLE, self._text(self._table(scene, values))
        yield SCENE, self._text(scene_json(scene))
        if self.look.rules:
            around = grids.widened(ground, masks.MARGIN_M)
            for of in self.look.filters():
                cells = masks.mask_cells(around, scene.regions, self.look.rules, of)
                yield f"{of}_mask", self._grid(around, cells)

    def filter_infos(self) -> Iterator[tuple[str, Any]]:
        """What Nav2 has to be told of the masks, once: with every telling it subscribes again."""
        for of in self.look.filters():
            topic = self.look.topic(f"{of}_mask")
            yield f"{of}_info", masks.filter_info(self.classes, of, topic, self.look.frame)

    def tf(self, scene: Scene, stamp_ns: int) -> Any:
        """Where regions are, at a time."""
        return frames.transforms(self.classes, scene.regions, self.look.node, self.look.frame, stamp_ns)

    def task_state(self, state: Mapping[str, Any]) -> Any:
        """What has become of the task."""
        return self._text(dict(state))

    def _values(self, scene: Scene) -> dict[int, int]:
        largest = sorted(scene.regions, key=lambda region: (-region.area_m2, region.id))
        return self.values.of([region.id for region in largest])

    def _table(self, scene: Scene, values: dict[int, int]) -> dict[str, Any]:
        colors = self.painter.label_colors(scene)
        return frames.table(scene, self.look.node, self.look.frame, values, colors)

    def _grid(self, ground: Ground, cells: Any) -> Any:
        return grids.occupancy_grid(self.classes, ground.layout, cells, self.look.frame)

    def _text(self, told: dict[str, Any]) -> Any:
        return messages.text(self.classes, json_text(told, indent=None))
