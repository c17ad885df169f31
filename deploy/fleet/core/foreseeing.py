"""What lies beyond the openings of the merged map, foreseen as a robot's segmenter does of its own (pure).

Behind an opening into what another robot knows nothing is foreseen: it is none (`fusing.openings`). It takes one prior:
where robots follow several, what one of them calls a kitchen is nothing to the others.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from prior_sg.deploy.fleet.core.believing import CFG
from prior_sg.schemas.foresight import Foresight
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.scene import Scene
from prior_sg.services.segmenter.core.foresight.openings import openings_of
from prior_sg.services.segmenter.core.foresight.telling import differs, foresight
from prior_sg.services.segmenter.core.map.frontiers import Frontiers
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from prior_sg.services.segmenter.core.map.table import Places


def foreseen(scene: Scene, prior: Prior | None, digests: Iterable[str]) -> Foresight:
    """Of a merged scene, by the prior that its maps' `digests` all name; nothing where they name others, or it is not
    there."""
    if prior is None or {*digests} != {prior.digest()} or not scene.regions:
        return Foresight()
    rows = np.searchsorted(scene.place_ids, scene.edges)
    graph = ReceivedGraph(
        scene.place_ids,
        scene.positions_m.astype(np.float64),
        scene.radii_m.astype(np.float64),
        rows.reshape(-1, 2),
        scene.clearances_m.astype(np.float64),
    )
    told = dict(zip(scene.labels, scene.posteriors.astype(np.float32).T, strict=True))
    nothing = np.zeros(len(scene.place_ids), np.float32)
    posteriors = np.stack([told.get(region.name, nothing) for region in prior.regions], axis=1)
    places = replace(Places.none(), regions=scene.place_regions, posteriors=posteriors)
    out = np.column_stack((scene.frontier_directions, scene.frontier_areas_m2)).astype(np.float64)
    frontiers = Frontiers(dict(zip(scene.frontier_ids.tolist(), out, strict=True)))
    regions = {region.id: region for region in scene.regions}
    return foresight(openings_of(graph, places, frontiers, CFG.foresight), regions, prior, CFG.foresight)


def news(told: Foresight | None, now: Foresight) -> Foresight | None:
    """What is foreseen now, where it is news to who was told."""
    return now if differs(told, now, CFG.foresight) else None
