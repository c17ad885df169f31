"""A recording becomes a scene graph, and another task divides the same map anew: the five lines of a notebook.

python examples/01_notebook.py [RECORDING]
"""

import itertools
import sys

import prior_sg
from prior_sg.deploy.sample import SAMPLE


def main(recording: str = str(SAMPLE), frames: int | None = None) -> prior_sg.Scene:
    """Print the regions for two tasks; `frames` ends early."""
    with prior_sg.Mapper(environment="residential home", task="real-estate listing") as mapper:
        for frame in itertools.islice(prior_sg.open_source(recording), frames):
            mapper.add(frame)
        print(mapper.scene)
        scene = mapper.task("hospitality service")
        print(scene)
    return scene


if __name__ == "__main__":
    main(*sys.argv[1:])
