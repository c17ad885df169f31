"""Settings of the place graph, under Hydra's names where Hydra has them, and the rules they make in voxels (pure)."""

from typing import Any, ClassVar, Literal

import msgspec

from prior_sg.schemas.codec import Signed
from prior_sg.services.images import MAX_PRINCIPAL_OFFSET
from prior_sg.services.place_graph.core.ground import GroundRules
from prior_sg.services.place_graph.core.skeleton.distance import FieldRules
from prior_sg.services.place_graph.core.skeleton.graph import GraphRules
from prior_sg.services.place_graph.core.skeleton.places import ExtractionRules, Policy
from prior_sg.services.place_graph.core.trajectory import Bounds
from prior_sg.services.place_graph.core.volume import tsdf

AT_ONCE = 2**31  # blocks: with a `slice_blocks` of so many each keyframe gives one delta
SLICE_VOXELS = 100  # for each of `slice_blocks`; with two thirds of it all slices together take longer
MAX_FIELD_VOXELS = 120  # offsets to the nearest obstacle are kept in 8 bits

# What each preset changes of the defaults, which are those of `indoor`. `hydra` are the defaults in Hydra's code,
# `habitat`, `uhumans2` and `clio` those of its configurations of that name; their diagrams have voxels of 0.2 m.
PRESETS: dict[str, dict[str, Any]] = {
    "indoor": {},
    # Middles of whole cells lie a cell apart, that of a share f of one (1 + f) / 2 beside it: small ones are in reach.
    "mixed": {"field_voxels": 2, "merge_policy": "middle", "node_merge_distance_m": 0.85},
    "outdoor": {
        "voxel_m": 0.2,
        "truncation_m": 0.6,
        "max_range_m": 15.0,
        "max_distance_m": 6.0,
        "voronoi_min_distance_m": 0.5,
        "compression_distance_m": 2.0,
        "min_node_distance_m": 0.8,
        "min_edge_distance_m": 0.5,
        "node_merge_distance_m": 1.0,
        "freespace_max_length_m": 5.0,
        "freespace_min_clearance_m": 0.5,
        "map_window_max_radius_m": 45.0,
        "min_cluster_area_m2": 10.0,
        "pure_final_place_size_m": 3.0,
        "max_speed_m_s": 25.0,
        "jump_slack_m": 3.0,
    },
    "hydra": {
        "voxel_m": 0.2,
        "max_distance_m": 2.0,
        "min_diff_m": 0.001,
        "voronoi_min_distance_m": 0.2,
        "parent_l1_separation": 3.0,
        "parent_cos_angle_separation": 0.5,
        "compression_distance_m": 0.5,
        "min_node_distance_m": 0.3,
        "min_edge_distance_m": 0.4,
        "node_merge_distance_m": 0.3,
        "add_freespace_edges": False,
    },
    "habitat": {
        "voxel_m": 0.2,
        "max_distance_m": 4.5,
        "min_diff_m": 0.1,
        "freespace_num_nodes_to_check": 10,
        "freespace_num_neighbors_to_find": 2,
    },
    "uhumans2": {
        "voxel_m": 0.2,
        "max_distance_m": 4.5,
        "min_diff_m": 0.1,
        "compression_distance_m": 1.5,
        "min_edge_distance_m": 0.25,
        "node_merge_distance_m": 0.7,
        "merge_policy": "distance",
        "add_freespace_edges": False,
    },
    "clio": {
        "truncation_m": 0.25,
        "min_diff_m": 0.1,
        "voronoi_min_distance_m": 0.4,
        "parent_l1_separation": 25.0,
        "parent_cos_angle_separation": 0.1,
        "min_edge_distance_m": 0.25,
        "freespace_num_nodes_to_check": 10,
        "freespace_num_neighbors_to_find": 3,
        "freespace_min_clearance_m": 0.3,
    },
}


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """Defaults are those of Hydra's habitat preset unless a comment says otherwise."""

    PRESETS: ClassVar[dict[str, dict[str, Any]]] = PRESETS

    # Other settings win.
    preset: Literal["indoor", "mixed", "outdoor", "hydra", "habitat", "uhumans2", "clio"] = "indoor"
    places: Literal["3d", "2d"] = "3d"  # free-space spheres; or ellipses on the ground, for large or unbounded spaces

    # Map.
    voxel_m: float = 0.1  # side of a voxel of the map
    field_voxels: int = 1  # voxels of the map along one side of a voxel of distances and diagram: 1, 2 or 4
    truncation_m: float = 0.3  # the signed distance is clipped here, and nothing is fused farther behind a surface
    surface_voxels: float = 0.5  # a voxel whose signed distance is below this many voxels is an obstacle
    min_range_m: float = 0.2  # nearer measurements are the robot itself or noise
    max_range_m: float = 5.0  # nothing is fused farther from the camera; farther surfaces still clear what lies before
    max_weight: float = 1e5  # 1 / m^2 of evidence for one voxel; beyond it, old evidence fades
    use_constant_weight: bool = False  # weigh measurements alike, instead of by 1 / depth^2 as sensors are precise
    map_window_max_radius_m: float = 20.0  # blocks farther from the camera are compressed; an update reads up to 19 m
    map_mb: float = 512.0  # all voxels, open and compressed; beyond it the oldest are dropped and their places freeze
    # Blocks of 16 x 16 x 16 voxels that a keyframe is fused into at once; a view of 5 m at 0.1 m concerns 20 to 60. One
    # that concerns more is worked off in slices, after each of which readers are told and questions answered. With
    # `field_voxels` of 2 or 4 a slice has as many times the blocks.
    slice_blocks: int = 128
    archive_mb: float = 256.0  # compressed depth images kept for pose updates, oldest dropped first
    # Keyframes heard without an answer from ingest's archive before the map is told as it is; its publisher's cache
    # brings 32 at once, behind which the answer waits.
    archive_patience: int = 64

    # Distances and Voronoi diagram.
    max_distance_m: float = 3.0  # distances end here: half the height of the highest halls (Clio 3.0, habitat 4.5)
    min_distance_m: float = 0.2  # no place and no part of the diagram lies nearer to an obstacle
    voronoi_min_distance_m: float = 0.3  # the Voronoi diagram ends this close to obstacles
    parent_l1_separation: float = 20.0  # voxels: obstacles farther apart than this (L1) are distinct basis points ...
    parent_cos_angle_separation: Signed = 0.2  # ... and so are those seen under an angle with a smaller cosine

    # Places and edges.
    compression_distance_m: float = 1.0  # side of the cells that become one place each
    min_node_distance_m: float = 0.4  # smallest radius of a place
    min_edge_distance_m: float = 0.2  # smallest clearance of an edge between touching places
    node_merge_distance_m: float = 0.5  # touching places nearer than this become one
    # Where in its cell a place stands, and which of two absorbs the other: Hydra's voxel with most basis points, or
    # that of the greatest distance; or the middle of the cell's part of the diagram, of the larger part.
    merge_policy: Policy = "basis_points"
    add_overlap_edges: bool = False  # join spheres that overlap
    overlap_num_neighbors_to_check: int = 4  # nearest places looked at
    overlap_min_clearance_m: float = 0.4  # smallest radius of the lens two spheres share
    add_freespace_edges: bool = True  # join places that see each other
    freespace_max_length_m: float = 2.0  # longest edge across free space
    freespace_num_nodes_to_check: int = 0  # nearest places in sight looked at; 0 = all (habitat 10)
    freespace_num_neighbors_to_find: int = 0  # nearest of them joined; 0 = all without a third between (habitat 2)
    freespace_min_clearance_m: float = 0.2  # smallest clearance of such an edge: doorways
    min_component_size: int = 3  # smaller connected parts of the graph are not published
    min_diff_m: float = 0.01  # smaller changes of a position, radius or clearance are not published (habitat 0.1)
    frontier_min_area_m2: float = 0.1  # smaller openings to unobserved space are not told: holes in the depth

    # 2D places.
    surface_min_clearance_m: float = 1.0  # free height above ground
    surface_max_step_m: float = 0.2  # greatest difference in height of neighbouring ground
    surface_max_slope: float = 0.6  # greatest rise over run: 31 degrees; the voxel that rounding may add is not counted
    min_cluster_area_m2: float = 2.0  # smaller connected ground is an outlier: table tops (Hydra: 600 mesh vertices)
    furniture_max_area_m2: float = 8.0  # smaller ground from which one falls on most sides is a table top or a bed
    pure_final_place_size_m: float = 1.0  # pieces with a longer side are halved ... (uhumans2; in the code 3)
    min_final_place_points: int = 10  # ... if they have more voxels than this (uhumans2; in the code 1000 vertices)
    place_overlap_threshold_m: float = 0.1  # smallest overlap of ellipses that are joined
    place_max_neighbor_z_diff_m: float = 0.5  # greatest difference in height of such

    # Poses and cameras that cannot be true.
    max_speed_m_s: float = 3.0  # of a camera carried or driven indoors; a faster pose is a jump; 0 = believe everything
    jump_slack_m: float = 1.0  # what stamps and trackers may be wrong by, on top
    relocalised_after: int = 5  # keyframes that go on from a jump before it is believed ...
    max_contradiction: float = 0.4  # ... unless more of their depth contradicts the map: 0.1 to 0.33 with true poses of
    # the development sequences, above 0.58 half a metre beside them
    max_principal_offset: float = MAX_PRINCIPAL_OFFSET  # share by which the principal point may be off the middle

    def __post_init__(self) -> None:
        if not 0 < self.voxel_m <= min(self.truncation_m, self.compression_distance_m):
            raise ValueError("voxel_m must be positive and at most truncation_m and compression_distance_m")
        if self.field_voxels not in {1, 2, 4} or self.graph_voxel_m > self.compression_distance_m:
            raise ValueError("field_voxels must be 1, 2 or 4, and that many voxels at most compression_distance_m")
        if not self.voxels(self.max_distance_m) <= MAX_FIELD_VOXELS:
            raise ValueError(f"max_distance_m may be at most {MAX_FIELD_VOXELS} voxels")
        if not 0 <= self.min_range_m < self.max_range_m:
            raise ValueError("min_range_m must be at least 0 and below max_range_m")
        if not self.slice_blocks >= 1:
            raise ValueError("slice_blocks must be at least 1")
        if not (self.map_mb > 0 and self.archive_mb >= 0):
            raise ValueError("map_mb must be positive and archive_mb at least 0")

    def voxels(self, length_m: float) -> float:
        """A length in voxels."""
        return length_m / self.graph_voxel_m

    @property
    def coarseness(self) -> int:
        """Voxels of the map along one side of a voxel of the graph; ground is divided in the map itself."""
        return self.field_voxels if self.places == "3d" else 1

    @property
    def graph_voxel_m(self) -> float:
        """Side of a voxel of distances, diagram and graph."""
        return self.voxel_m * self.coarseness

    @property
    def most_blocks(self) -> int:
        """Blocks in a slice: more where what follows from them is coarser and costs less."""
        return self.slice_blocks * self.coarseness

    @property
    def most_voxels(self) -> int:
        """Voxels whose distances may be expected to change at once, where a keyframe is worked off in slices."""
        return SLICE_VOXELS * self.slice_blocks

    @property
    def fusion(self) -> tsdf.Fusion:
        """How depth is fused."""
        return tsdf.Fusion(
            voxel_m=self.voxel_m,
            truncation_m=max(self.truncation_m, 2 * self.voxel_m),
            surface_m=self.surface_voxels * self.voxel_m,
            min_range_m=self.min_range_m,
            max_range_m=self.max_range_m,
            max_weight=self.max_weight,
            constant_weight=self.use_constant_weight,
        )

    @property
    def field_rules(self) -> FieldRules:
        """How far distances reach and what is on the diagram."""
        return FieldRules(
            max_distance=self.voxels(self.max_distance_m),
            voronoi_min_distance=self.voxels(max(self.voronoi_min_distance_m, self.min_distance_m)),
            parent_l1=self.parent_l1_separation,
            parent_cos=self.parent_cos_angle_separation,
        )

    @property
    def extraction_rules(self) -> ExtractionRules:
        """What becomes a place."""
        return ExtractionRules(
            cell=self.cell_voxels,
            min_radius=self.voxels(self.min_node_distance_m),
            merge=self.voxels(self.node_merge_distance_m),
            policy=self.merge_policy,
        )

    @property
    def graph_rules(self) -> GraphRules:
        """What makes places one and what joins them."""
        return GraphRules(
            cell=self.cell_voxels,
            merge=self.voxels(self.node_merge_distance_m),
            edge=self.voxels(self.min_edge_distance_m),
            reach=self.voxels(self.freespace_max_length_m) if self.add_freespace_edges else 0.0,
            free=self.voxels(self.freespace_min_clearance_m),
            check=self.freespace_num_nodes_to_check,
            find=self.freespace_num_neighbors_to_find,
            overlap=self.voxels(self.overlap_min_clearance_m),
            overlap_check=self.overlap_num_neighbors_to_check if self.add_overlap_edges else 0,
        )

    @property
    def ground_rules(self) -> GroundRules:
        """What is ground and how it is divided."""
        return GroundRules(
            clearance=round(self.voxels(self.surface_min_clearance_m)),
            step=max(1, round(self.voxels(self.surface_max_step_m))),
            slope=self.surface_max_slope,
            piece=self.voxels(self.pure_final_place_size_m),
            points=self.min_final_place_points,
            cluster=round(self.min_cluster_area_m2 / self.graph_voxel_m**2),
            overlap=self.voxels(self.place_overlap_threshold_m),
            rise=self.voxels(self.place_max_neighbor_z_diff_m),
            furniture=round(self.furniture_max_area_m2 / self.graph_voxel_m**2),
        )

    @property
    def bounds(self) -> Bounds:
        """How far the camera gets."""
        return Bounds(self.max_speed_m_s, self.jump_slack_m)

    @property
    def cell_voxels(self) -> int:
        """Voxels along one side of a compression cell."""
        return max(1, round(self.compression_distance_m / self.graph_voxel_m))


def preset(name: str, **settings: Any) -> Config:
    """The configuration of a preset, with further settings."""
    return Config(**{"preset": name, **PRESETS[name], **settings})
