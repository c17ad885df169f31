"""Nodes of the levels above regions (pure)."""

from prior_sg.schemas.answers import Nodes, NodeWithRegions
from prior_sg.schemas.levels import LEVELS, LevelNode, regions_in
from prior_sg.schemas.names import same
from prior_sg.schemas.queries import NodesOf
from prior_sg.services.scene_store.core.queries.index import Index
from prior_sg.services.scene_store.core.queries.labels import nearest_labels, not_there
from prior_sg.services.scene_store.core.queries.things import thing


def nodes(index: Index, question: NodesOf) -> Nodes:
    """From below by id, each with its regions."""
    if question.region is not None and index.row("region", question.region) is None:
        return Nodes(reason=not_there(index, "region", question.region))
    held = {level: regions_in(index.scene.nodes, level) for level in LEVELS}
    found = [
        node
        for node in index.scene.nodes
        if question.level in (None, node.level)
        and question.id in (None, node.id)
        and same(question.label) in ("", same(node.label))
        and (question.region is None or held[node.level].get(question.region) == node.id)
    ]
    if not found:
        return Nodes(reason=_nothing(index, question))
    listed = [
        NodeWithRegions(
            node=node,
            regions=[
                thing(index, "region", row)
                for row, region in enumerate(index.regions)
                if held[node.level].get(region.id) == node.id
            ],
        )
        for node in found[: question.limit]
    ]
    return Nodes(nodes=listed, total=len(found))


def _nothing(index: Index, question: NodesOf) -> str:
    """Why there is none, and what there is, in one sentence."""
    there = [node for node in index.scene.nodes if question.level in (None, node.level)]
    wanted = question.level or "zone, floor, building or district"
    if not there:
        return f"the scene has no {wanted} yet"
    names = sorted({node.label for node in there})
    if question.label and question.label not in names:
        hints = nearest_labels(question.label, names) or names
        return f"no {wanted} is labelled {question.label!r}; there are: {', '.join(hints)}"
    return f"there is no such {wanted}; there are: {', '.join(map(_named, there))}"


def _named(node: LevelNode) -> str:
    return f"{node.level} {node.id} ({node.label})"
