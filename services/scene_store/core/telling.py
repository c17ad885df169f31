"""What a stored graph says: the scene, in which its streams meet, and what is announced of a revision (pure)."""

import numpy as np

from prior_sg.schemas.levels import rank
from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.scene import Scene, SceneRevision
from prior_sg.services.scene_store.core.graph import Belief, Graph, rows, stamp_ns


def scene(graph: Graph) -> Scene:
    """The scene graph as a message, sorted by id: equal graphs of one revision give equal bytes.

    A place without a belief has region -1, a posterior of zeros and unknown mass 1. Environment and task are those the
    regions were made for, so that they fit the labels; before the first regions, those of the task.
    """
    ids = sorted(graph.places)
    places = [graph.places[place] for place in ids]
    missing = Belief(NO_REGION, np.zeros(len(graph.alignment.labels), np.float16), 1.0)
    beliefs = [graph.beliefs.get(place, missing) for place in ids]
    edges = sorted(graph.edges)
    cameras = [seen.camera_m for _, seen in sorted(graph.sightings.items()) if seen.epoch == graph.place_cursor.epoch]
    aligned = graph.alignment
    source = aligned if graph.region_cursor.epoch >= 0 or graph.task is None else graph.task
    return Scene(
        robot=graph.robot,
        stamp_ns=stamp_ns(graph),
        environment=source.environment,
        task=source.task,
        prior_digest=aligned.prior_digest,
        space=aligned.space,
        labels=list(aligned.labels),
        regions=[graph.regions[region] for region in sorted(graph.regions)],
        place_ids=np.array(ids, np.int64),
        positions_m=rows([place.position_m for place in places], 3, np.float32),
        radii_m=np.array([place.radius_m for place in places], np.float32),
        basis_points=np.array([place.basis_points for place in places], np.int16),
        place_regions=np.array([belief.region for belief in beliefs], np.int64),
        posteriors=rows([belief.posterior for belief in beliefs], len(aligned.labels), np.float16),
        unknown=np.array([belief.unknown for belief in beliefs], np.float16),
        edges=rows(edges, 2, np.int64),
        clearances_m=np.array([graph.edges[edge] for edge in edges], np.float32),
        trajectory=rows(cameras, 3, np.float32),
        predicted_ids=np.array(
            [place for place, belief in zip(ids, beliefs, strict=True) if belief.predicted], np.int64
        ),
        objects=[graph.objects[number] for number in sorted(graph.objects)],
        origin_m=graph.origin_m,
        revision=graph.revision,
        nodes=sorted(graph.nodes.values(), key=rank),
        foresight=graph.foresight,
        markers=[graph.markers[key] for key in sorted(graph.markers)],
        merged_of=list(graph.merged_of),
        **_details(graph),
    )


def _details(graph: Graph) -> dict[str, np.ndarray]:
    """Openings and ground as columns of the scene."""
    openings = rows([graph.frontiers[place] for place in sorted(graph.frontiers)], 4, np.float32)
    surfaces = [graph.surfaces[place] for place in sorted(graph.surfaces)]
    return {
        "frontier_ids": np.array(sorted(graph.frontiers), np.int64),
        "frontier_directions": openings[:, :3],
        "frontier_areas_m2": openings[:, 3],
        "surface_ids": np.array(sorted(graph.surfaces), np.int64),
        "ellipses": rows([surface[:3] for surface in surfaces], 3, np.float32),
        "hull_counts": np.array([(len(surface) - 3) // 2 for surface in surfaces], np.int64),
        "hulls_m": np.concatenate([np.zeros(0, np.float32), *(surface[3:] for surface in surfaces)]).reshape(-1, 2),
    }


def revision_of(graph: Graph, store_epoch: int) -> SceneRevision:
    """What the store announces after a delta."""
    return SceneRevision(
        robot=graph.robot,
        epoch=store_epoch,
        revision=graph.revision,
        stamp_ns=stamp_ns(graph),
        places=len(graph.places),
        edges=len(graph.edges),
        regions=len(graph.regions),
    )
