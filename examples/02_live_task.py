"""A running system gets another task; its new regions are printed as soon as they stand.

prior-sg up --source deploy/sample/home.mcap &
python examples/02_live_task.py "hospitality service" "residential home"
"""

import sys

import prior_sg


def main(task: str, environment: str | None = None, connect: str = "tcp/127.0.0.1:7447") -> prior_sg.Scene:
    """Print the largest regions, and how the processes feel; the environment may stay the one in force."""
    with prior_sg.Client(connect) as client:
        scene = client.task(task, environment)
        regions = scene.regions
        for row in (-regions.areas_m2).argsort()[:5]:
            print(f"{regions.labels[row]}: {regions.place_counts[row]} places, {regions.areas_m2[row]:.1f} m²")
        for process in client.health().processes:
            print(f"{process.service}: busy {process.busy_share:.0%}, {process.backlog} waiting")
    return scene


if __name__ == "__main__":
    main(*sys.argv[1:])
