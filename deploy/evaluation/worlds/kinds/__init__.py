"""The kinds of worlds: from random numbers to a plan."""

from collections.abc import Callable

import numpy as np

from prior_sg.deploy.evaluation.worlds.kinds.campus import campus
from prior_sg.deploy.evaluation.worlds.kinds.clinic import clinic
from prior_sg.deploy.evaluation.worlds.kinds.home import home
from prior_sg.deploy.evaluation.worlds.kinds.hospital import hospital
from prior_sg.deploy.evaluation.worlds.kinds.hotel import hotel
from prior_sg.deploy.evaluation.worlds.kinds.house import house
from prior_sg.deploy.evaluation.worlds.kinds.office import office
from prior_sg.deploy.evaluation.worlds.kinds.school import school
from prior_sg.deploy.evaluation.worlds.kinds.shop import shop
from prior_sg.deploy.evaluation.worlds.kinds.station import station
from prior_sg.deploy.evaluation.worlds.kinds.tower import tower
from prior_sg.deploy.evaluation.worlds.plan import Plan

KINDS: dict[str, Callable[[np.random.Generator], Plan]] = {
    "home": home,
    "office": office,
    "hospital": hospital,
    "hotel": hotel,
    "shop": shop,
    "station": station,
    "school": school,
    "tower": tower,
    "campus": campus,
    "house": house,
    "clinic": clinic,
}
