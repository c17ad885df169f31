"""The kinds of worlds: from random numbers to a plan."""

from collections.abc import Callable

import numpy as np

from prior_sg.deploy.evaluation.worlds.kinds.home import home
from prior_sg.deploy.evaluation.worlds.kinds.hospital import hospital
from prior_sg.deploy.evaluation.worlds.kinds.office import office
from prior_sg.deploy.evaluation.worlds.plan import Plan

KINDS: dict[str, Callable[[np.random.Generator], Plan]] = {"home": home, "office": office, "hospital": hospital}
