"""The scene as a graph of networkx: node-link JSON and GraphML.

Nodes are named `place:10`, `region:4`, `object:7`; their attributes are the columns of `prior_sg.Scene`, edges have a
`kind` as in `Scene.to_networkx`. GraphML knows no lists: points become x_m, y_m, z_m, and beliefs one number per label.
"""

import re
from pathlib import Path
from typing import Any

from prior_sg.deploy.api.scene import Scene, flat_row
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.showing.material import Material

NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # characters XML 1.0 cannot hold


def write_node_link(material: Material, path: Path) -> None:
    """`networkx.node_link_graph(..., edges="links")` reads it, and so does D3."""
    import networkx

    told = networkx.node_link_data(_graph(material), edges="links")
    path.write_text(json_text(told))


def write_graphml(material: Material, path: Path) -> None:
    """Flat attributes; characters that XML cannot hold are left out."""
    import networkx

    graph = _graph(material)
    for attributes in (graph.graph, *(found for _, found in graph.nodes(data=True))):
        flat = {_clean(name): _clean(value) for name, value in flat_row(_unfolded(attributes)).items()}
        attributes.clear()
        attributes.update(flat)
    networkx.write_graphml_xml(graph, path, named_key_ids=False)


def _graph(material: Material) -> Any:
    """With names that are text, and beliefs as `posterior` by label."""
    import networkx

    scene = Scene(material.scene)
    graph = networkx.relabel_nodes(scene.to_networkx(), lambda node: f"{node[0]}:{node[1]}")
    graph.graph |= {"environment": scene.environment, "stamp_ns": scene.stamp_ns, "origin_m": [*scene.message.origin_m]}
    for name, attributes in graph.nodes(data=True):
        attributes["layer"] = name.partition(":")[0]
    rows = zip(scene.places.ids.tolist(), scene.places.posteriors.tolist(), strict=True)
    for place, posterior in rows:
        if any(posterior):
            graph.nodes[f"place:{place}"]["posterior"] = dict(zip(scene.labels, posterior, strict=True))
    return graph


def _unfolded(attributes: dict[str, Any]) -> dict[str, Any]:
    """A belief as one attribute per label."""
    belief = {f"p({label})": value for label, value in attributes.get("posterior", {}).items()}
    return {name: value for name, value in attributes.items() if name != "posterior"} | belief


def _clean(value: Any) -> Any:
    return NOT_XML.sub("", value) if isinstance(value, str) else value
