"""A running system tells what changes: regions that appear, split, merge or get another name, as they do.

prior-sg up --source deploy/sample/home.mcap &
prior-sg task "real-estate listing" --environment "residential home"
python examples/05_follow_changes.py
"""

import sys

import prior_sg
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.scene import SceneRevision


def main(connect: str = "tcp/127.0.0.1:7447", changes: int | None = None) -> int:
    """Print until Ctrl-C, or until regions have changed so often; returns how often."""
    seen = 0
    with prior_sg.Client(connect) as client:
        for message in client.changes(deltas=True):
            match message:
                case SceneRevision():
                    print(f"stored: {message.places} places, {message.regions} regions")
                case RegionDelta():
                    print("; ".join(f"region {event.region} {event.kind}: {event.label}" for event in message.events))
                    seen += 1
            if seen == changes:
                break
    return seen


if __name__ == "__main__":
    main(*sys.argv[1:])
