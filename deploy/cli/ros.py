"""`prior-sg ros`: what a recording of ROS holds."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from prior_sg.deploy.cli.ros_results import add_results
from prior_sg.deploy.cli.shared import Commands, console
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.json_text import json_text

if TYPE_CHECKING:
    from prior_sg.services.ingest.core.ros.topics import Topic


def add_commands(commands: Commands) -> None:
    """`ros` and its actions."""
    parser = commands.add("ros", cmd_topics, "look into a recording of ROS", "prior-sg ros topics walk.bag", "ros")
    actions = Commands(parser, "action", "ACTION", "prior-sg ros ")
    topics = actions.add(
        "topics", cmd_topics, "list the topics of a recording and what each would serve as", "topics walk.bag", "ros"
    )
    topics.add_argument("source", type=Path, help="a rosbag2 folder, or a file ending in .mcap, .db3 or .bag")
    topics.add_argument("--json", action="store_true", help="print JSON")
    add_results(actions)


def cmd_topics(arguments: argparse.Namespace) -> int:
    """List topics by name, and mark those that a run would read. Raises UserError and SourceError."""
    from prior_sg.services.ingest.core.options import ReadOptions
    from prior_sg.services.ingest.core.ros.topics import chosen
    from prior_sg.services.ingest.sources.ros_bag import Bag, is_recording

    if not arguments.source.exists() or not is_recording(arguments.source):
        raise UserError(
            f"{arguments.source} is no recording of ROS: give a rosbag2 folder, or a file ending in .mcap, .db3 or .bag"
        )
    topics = Bag(arguments.source).topics()
    if arguments.json:
        print(json_text([_as_builtins(topic) for topic in topics], None))
        return 0
    console.print(_table(topics))
    try:
        console.print(f"would read {chosen(topics, ReadOptions()).said()}", soft_wrap=True)
    except ValueError as error:
        console.print(f"would not be read: {error}", soft_wrap=True)
    return 0


def _table(topics: "list[Topic]") -> Table:
    table = Table("topic", "type", "messages", "per second", "frame", "serves as")
    for topic in topics:
        serves = " ".join(filter(None, (topic.taken_for or "-", f"({topic.encoding})" if topic.encoding else "")))
        rate = f"{topic.rate_hz:.1f}" if topic.rate_hz else "-"
        table.add_row(topic.name, topic.type, str(topic.count), rate, topic.frame, serves)
    return table


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
