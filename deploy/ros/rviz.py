"""A configuration of RViz that opens with what the bridge tells."""

from importlib import resources

from prior_sg.deploy.ros.options import check_frame, check_node
from prior_sg.deploy.ros.rules import Look

FILE = "prior_sg.rviz"


def configuration(node: str = Look.node, frame: str = Look.frame) -> str:
    """The file's text for a bridge of this name and frame. Raises UserError."""
    text = resources.files(__package__).joinpath(FILE).read_text()
    check_node(node)
    check_frame(frame)
    topics = text.replace(f" /{Look.node}/", f" /{node}/")
    return topics.replace(f"Fixed Frame: {Look.frame}\n", f"Fixed Frame: {frame}\n")
