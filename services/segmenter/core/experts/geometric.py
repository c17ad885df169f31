"""The geometric expert: how well the local inclination fits each region."""

import numpy as np
import scipy

from prior_sg.services.segmenter.core.experts.context import Context


def geometric(context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Von Mises of the inclination about each region's expected angle (paper, The Geometric Expert).

    kappa = 1 / variance. Each density is normalised before the regions are compared, or a region would gain by being
    sharp; regions of one variance give the paper's exp(kappa cos(theta - mu)) exactly. Confidence is support times
    anisotropy.
    """
    mean_rad = np.array([region.inclination_mean_rad for region in context.prior.regions])
    kappa = np.array([region.inclination_std_rad for region in context.prior.regions]) ** -2.0
    deviation = np.cos(context.inclination_rad[:, None] - mean_rad)
    log_density = kappa * (deviation - 1.0) - np.log(scipy.special.i0e(kappa))  # without -log(2 pi), which all share
    log_mass = log_density - np.logaddexp.reduce(log_density, axis=1, keepdims=True)
    return log_mass, context.support * context.anisotropy
