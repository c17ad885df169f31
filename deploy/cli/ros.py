"""`prior-sg ros`: what a recording of ROS holds, or a robot publishes."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from prior_sg.deploy.cli.ros_results import add_results
from prior_sg.deploy.cli.shared import Commands, console
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.terminal import Table

if TYPE_CHECKING:
    from prior_sg.services.ingest.core.ros.topics import Topic


def add_commands(commands: Commands) -> None:
    """`ros` and its actions."""
    what = "look into a recording of ROS or at a robot, and tell ROS 2 of a running system"
    parser = commands.add("ros", cmd_topics, what, "prior-sg ros topics walk.bag", "ros")
    actions = Commands(parser, "action", "ACTION", "prior-sg ros ")
    listing = "list the topics of a recording, or of a robot, and what each would serve as"
    topics = actions.add("topics", cmd_topics, listing, "topics ros2:/", "ros")
    topics.add_argument(
        "source", help="a rosbag2 folder, a file ending in .mcap, .db3 or .bag, or ros2:/ for a robot (docs/sources.md)"
    )
    topics.add_argument("--domain", default="", help="domain of a robot; default: ROS_DOMAIN_ID, else 0")
    topics.add_argument("--seconds", type=float, default=3.0, help="to listen to a robot (default: %(default)s)")
    topics.add_argument("--json", action="store_true", help="print JSON")
    add_results(actions)


def cmd_topics(arguments: argparse.Namespace) -> int:
    """List topics by name, and mark those that a run would read. Raises UserError and SourceError."""
    from prior_sg.services.ingest.core.options import ReadOptions, is_robot
    from prior_sg.services.ingest.core.ros.topics import chosen, cloud_chosen

    live = is_robot(arguments.source)
    topics = _heard(arguments) if live else _recorded(Path(arguments.source))
    if arguments.json:
        print(json_text([_as_builtins(topic) for topic in topics], None))
        return 0
    console.print(_table(topics))
    try:
        choice = cloud_chosen(topics, ReadOptions()) or chosen(topics, ReadOptions())
        console.print(f"would read {choice.said()}", soft_wrap=True)
    except ValueError as error:
        console.print(f"would not be read: {error}", soft_wrap=True)
    return 0


def _recorded(path: Path) -> "list[Topic]":
    """Topics of a recording. Raises UserError and SourceError."""
    from prior_sg.services.ingest.sources.ros.bag import is_recording
    from prior_sg.services.ingest.sources.ros.foreign import open_bag

    if not path.exists() or not is_recording(path):
        raise UserError(
            f"{path} is no recording of ROS: give a rosbag2 folder, a file ending in .mcap, .db3 or .bag, or ros2:/"
        )
    return open_bag(path).topics()


def _heard(arguments: argparse.Namespace) -> "list[Topic]":
    """Topics of a running robot, of the types that can serve. Raises UserError and SourceError."""
    from prior_sg.deploy.ros.options import domain_of
    from prior_sg.services.ingest.sources.ros.live import heard

    domain = domain_of(arguments.domain)
    with console.status(f"listening to {arguments.source}"):
        return heard(arguments.source, domain, arguments.seconds)


def _table(topics: "list[Topic]") -> Table:
    rows = Table("topic", "type", "messages", "per second", "frame", "serves as")
    for topic in topics:
        serves = " ".join(filter(None, (topic.taken_for or "-", f"({topic.encoding})" if topic.encoding else "")))
        rate = f"{topic.rate_hz:.1f}" if topic.rate_hz else "-"
        rows.add_row(topic.name, topic.type, str(topic.count), rate, topic.frame, serves)
    return rows


def _as_builtins(topic: "Topic") -> dict:
    return {
        "topic": topic.name,
        "type": topic.type,
        "messages": topic.count,
        "rate_hz": round(topic.rate_hz, 3),
        "encoding": topic.encoding,
        "frame": topic.frame,
        "serves_as": topic.taken_for,
    }
