"""How well the nodes of the levels above regions fit the ground truth: F1_S and F1_G as of regions, level by level.

A place belongs to the node of its region, and to the true node of the true region that holds it. Places whose true
region is in no node of a level, as staircases are on no floor, are left out there.
"""

from collections.abc import Sequence

import numpy as np

from prior_sg.deploy.evaluation.metrics import Overlap, assign, scores_of
from prior_sg.deploy.truth import GroundTruth, TrueNode
from prior_sg.schemas.levels import LevelName, LevelNode, regions_in
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.scene import Scene

NONE = -1  # in no node


def levels_in(truth: GroundTruth) -> list[LevelName]:
    """The levels that a ground truth knows."""
    return list(dict.fromkeys(node.level for node in truth.nodes))


def level_scores(scene: Scene, free: VoxelMap, truth: GroundTruth) -> dict[LevelName, dict[str, float]]:
    """f1_s and f1_g of each level that the truth knows."""
    assignment = assign(scene, free, truth)
    found = {}
    for level in levels_in(truth):
        true = [node for node in truth.nodes if node.level == level]
        columns = true_nodes(true, assignment.true_ids)
        kept = columns != NONE
        rows = nodes_at(scene.nodes, level, assignment.estimated_ids)
        overlap = _overlap(scene.nodes, level, true, (rows[kept], columns[kept], assignment.volumes[kept]))
        semantic = scores_of(overlap, overlap.same_label)
        geometric = scores_of(overlap, np.ones_like(overlap.same_label))
        found[level] = {"f1_s": semantic["f1"], "f1_g": geometric["f1"]}
    return found


def true_nodes(nodes: Sequence[TrueNode], true_ids: np.ndarray) -> np.ndarray:
    """Number (place,) of the true node that holds each true region id, NONE where there is none."""
    held = {region: number for number, node in enumerate(nodes) for region in node.regions}
    return np.array([held.get(region, NONE) for region in true_ids.tolist()], np.int64)


def nodes_at(nodes: Sequence[LevelNode], level: LevelName, regions: np.ndarray) -> np.ndarray:
    """Id (place,) of the node of a level that holds each region id, NONE where there is none."""
    node_of = regions_in(nodes, level)
    return np.array([NONE if one == NO_REGION else node_of.get(one, NONE) for one in regions.tolist()], np.int64)


def _overlap(
    nodes: Sequence[LevelNode],
    level: LevelName,
    true: Sequence[TrueNode],
    places: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> Overlap:
    """Shared volumes; `places` are node ids, numbers of true nodes, and volumes."""
    estimated_ids, columns, volumes = places
    labelled = estimated_ids != NONE
    estimates, rows = np.unique(estimated_ids[labelled], return_inverse=True)
    truths, columns = np.unique(columns, return_inverse=True)
    shared = np.zeros((len(estimates), len(truths)), np.int64)
    np.add.at(shared, (rows, columns[labelled]), volumes[labelled])
    names = {node.id: node.label for node in nodes if node.level == level}
    same = [[names[e] == true[t].label for t in truths.tolist()] for e in estimates.tolist()]
    return Overlap(
        shared,
        shared.sum(axis=1),
        np.bincount(columns, volumes, minlength=len(truths)).astype(np.int64),
        np.array(same, bool).reshape(shared.shape),
    )
