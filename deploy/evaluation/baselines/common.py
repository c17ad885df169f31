"""What every baseline is given, and how its answer becomes a scene that `evaluate` can score.

All baselines see the places, the encoder's crops and the region concepts that our method sees; they differ in how they
attach features to places and how they cut regions.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from prior_sg.schemas.features import Pyramid, TextEmbeddings
from prior_sg.schemas.places import PlaceDelta, VoxelMap
from prior_sg.schemas.regions import NO_REGION, Region
from prior_sg.schemas.scene import Scene
from prior_sg.services.segmenter.core.evidence import kernel
from prior_sg.services.segmenter.core.evidence.archive import FrameArchive, integrate_all
from prior_sg.services.segmenter.core.regions.components import footprint_m2

NO_LABEL = ""
FOOTPRINT_CELL_M = 0.1


@dataclass(frozen=True)
class Inputs:
    """One mapped sequence: places, views, region concepts, map."""

    place_ids: np.ndarray  # (place,)
    positions_m: np.ndarray  # (place, 3) world
    radii_m: np.ndarray  # (place,)
    edges: np.ndarray  # (edge, 2) rows of places, smaller first
    clearances_m: np.ndarray  # (edge,)
    pyramids: tuple[Pyramid, ...]
    names: tuple[str, ...]  # region names
    text: TextEmbeddings  # one concept per name
    trajectory_m: np.ndarray  # (keyframe, 3) camera centres, world
    voxels: VoxelMap
    query_radius_m: float = 0.75  # r_Q, the median over the prior's regions as in our segmenter

    def __post_init__(self) -> None:
        if len(self.names) != len(self.text.embeddings):
            raise ValueError("every region name needs one concept, in the same order")

    @classmethod
    def of(
        cls,
        snapshot: PlaceDelta | Scene,
        pyramids: Sequence[Pyramid],
        names: Sequence[str],
        text: TextEmbeddings,
        voxels: VoxelMap,
        *,
        query_radius_m: float = 0.75,
    ) -> "Inputs":
        """From a stored scene or a snapshot of the place graph, places sorted by id."""
        order = np.argsort(snapshot.place_ids, kind="stable")
        ids = np.asarray(snapshot.place_ids)[order]
        trajectory_m = snapshot.trajectory if isinstance(snapshot, Scene) else snapshot.past_cameras_m
        return cls(
            place_ids=ids,
            positions_m=np.asarray(snapshot.positions_m, np.float64)[order],
            radii_m=np.asarray(snapshot.radii_m, np.float64)[order],
            edges=np.sort(np.searchsorted(ids, snapshot.edges), axis=1).astype(np.int64).reshape(-1, 2),
            clearances_m=np.asarray(snapshot.clearances_m, np.float64),
            pyramids=tuple(pyramids),
            names=tuple(names),
            text=text,
            trajectory_m=np.asarray(trajectory_m),
            voxels=voxels,
            query_radius_m=query_radius_m,
        )

    @cached_property
    def views(self) -> "Views":
        """The frames with one embedding of the whole image each.

        Our pyramids hold no crop of the whole image; the unit mean of the crops of the pyramid's largest layer, which
        together cover the image, stands in for it. Frames whose crops the A_min filter all removed (a wall close by)
        have no embedding and are left out.
        """
        views = [pyramid for pyramid in self.pyramids if len(pyramid.layers)]
        dim = self.text.embeddings.shape[1]
        means = [p.embeddings[p.layers == p.layers.max()].astype(np.float64).mean(axis=0) for p in views]
        return Views(tuple(views), unit(np.array(means).reshape(len(views), dim)))

    @cached_property
    def descriptors(self) -> tuple[np.ndarray, np.ndarray]:
        """Our method's d_vis (place, dim) and whether each place (place,) was observed at all."""
        archive, evidence, cfg = FrameArchive(), kernel.Evidence(), kernel.KernelConfig()
        for pyramid in self.pyramids:
            archive.add(pyramid.frame_id, kernel.compact(pyramid), math.inf)
        rows = list(range(len(self.place_ids)))
        evidence.add(rows)
        targets = kernel.Targets(evidence.of(rows), self.positions_m)
        integrate_all(evidence, archive, targets, self.query_radius_m, cfg)
        return evidence.descriptors(targets.slots), evidence.frames[targets.slots] > 0


@dataclass(frozen=True)
class Views:
    """Frames and one unit embedding each."""

    pyramids: tuple[Pyramid, ...]
    embeddings: np.ndarray  # (frame, dim)

    @cached_property
    def cameras_m(self) -> np.ndarray:
        """Camera centres (frame, 3), world."""
        return np.array([p.world_from_camera[:3, 3] for p in self.pyramids], float).reshape(-1, 3)


@dataclass(frozen=True)
class Answer:
    """A baseline's result, per place."""

    labels: list[str]  # NO_LABEL where the method gives none
    regions: np.ndarray  # (place,) region id, NO_REGION = the method left the place out


def unit(vectors: np.ndarray) -> np.ndarray:
    """Rows (n, dim) at unit length; zero rows stay zero."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors, dtype=float), where=lengths > 0)


def similarities(features: np.ndarray, text: TextEmbeddings, standardised: bool) -> np.ndarray:
    """Similarity (n, concept) of features (n, dim) of any length: the cosine, or its number of standard deviations
    above the concept's background mean, the scale on which our visual expert compares concepts."""
    cosines = unit(features) @ text.embeddings.astype(np.float64).T
    return (cosines - text.background_mean) / text.background_std if standardised else cosines


def to_scene(inputs: Inputs, labels: Sequence[str], regions: np.ndarray) -> Scene:
    """The scene in which each place has this region id; a region's label is that of its first place.

    Raises ValueError when the labels within one region differ.
    """
    entries = []
    for region in np.unique(regions[regions != NO_REGION]).tolist():
        rows = np.flatnonzero(regions == region).tolist()
        if len({labels[row] for row in rows}) > 1:
            raise ValueError(f"region {region} carries several labels")
        entries.append(_region(inputs, region, labels[rows[0]], rows))
    count = len(inputs.place_ids)
    return Scene(
        robot=inputs.voxels.robot,
        stamp_ns=0,
        environment="",
        task="",
        prior_digest="",
        space=inputs.text.space,
        labels=list(inputs.names),
        regions=entries,
        place_ids=inputs.place_ids,
        positions_m=inputs.positions_m.astype(np.float32),
        radii_m=inputs.radii_m.astype(np.float32),
        basis_points=np.zeros(count, np.int16),
        place_regions=np.asarray(regions, np.int64),
        posteriors=np.array([[label == name for name in inputs.names] for label in labels], np.float16).reshape(
            count, -1
        ),
        unknown=np.array([label == NO_LABEL for label in labels], np.float16),
        edges=inputs.place_ids[inputs.edges],
        clearances_m=inputs.clearances_m.astype(np.float32),
        trajectory=inputs.trajectory_m.astype(np.float32),
    )


def _region(inputs: Inputs, region: int, label: str, rows: list[int]) -> Region:
    x, y, z = inputs.positions_m[rows].mean(axis=0).tolist()
    return Region(
        id=region,
        label=label,
        place_count=len(rows),
        probability=1.0,
        position_m=(x, y, z),
        area_m2=footprint_m2(inputs.positions_m[rows], inputs.radii_m[rows], FOOTPRINT_CELL_M),
    )
