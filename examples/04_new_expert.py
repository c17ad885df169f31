"""An expert of one's own, from a program outside the package: much free space speaks against regions with low ceilings.

python examples/04_new_expert.py [RECORDING]
"""

import itertools
import sys

import numpy as np

import prior_sg
from prior_sg.deploy.sample import SAMPLE
from prior_sg.services.segmenter.core.experts import REGISTRY
from prior_sg.services.segmenter.core.experts.context import Context

HEIGHT_M = {"garage": 2.2, "hallway": 2.4}  # everything else: 2.6
SPREAD_M = 0.3


def ceiling(context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Gaussian of how far the free sphere would stick out of each region's usual height; sure of large spheres."""
    height_m = np.array([HEIGHT_M.get(region.name, 2.6) for region in context.prior.regions])
    free_m = 2 * context.radii_m
    outside_m = np.maximum(free_m[:, None] - height_m, 0.0)
    log_likelihood = -0.5 * (outside_m / SPREAD_M) ** 2
    log_probabilities = log_likelihood - np.logaddexp.reduce(log_likelihood, axis=1, keepdims=True)
    return log_probabilities, np.minimum(free_m / 3.0, 1.0)


def main(recording: str = str(SAMPLE), frames: int | None = None) -> list[str]:
    """Register it, give it a weight beside the others, and print the votes on one place; returns who voted."""
    REGISTRY["ceiling"] = ceiling
    experts = {"visual": 4.0, "environment": 0.1, "ceiling": 0.5}
    with prior_sg.Mapper("residential home", "real-estate listing", settings={"segmenter.experts": experts}) as mapper:
        for frame in itertools.islice(prior_sg.open_source(recording), frames):
            mapper.add(frame)
        widest = mapper.scene.places.radii_m.argmax()
        reply = mapper.explain(int(mapper.scene.places.ids[widest]))
    for vote in reply.votes:
        favourite = reply.labels[int(np.argmax(vote.log_probabilities))]
        print(f"{vote.expert}: {favourite}, confidence {vote.confidence:.2f}, weight {vote.weight:.2f}")
    return [vote.expert for vote in reply.votes]


if __name__ == "__main__":
    main(*sys.argv[1:])
