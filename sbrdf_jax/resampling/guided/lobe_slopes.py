"""Derivatives of the lobe model's terms by its shape, for the fit on the host."""

import numpy as np
from jaxtyping import Float

from sbrdf_jax.resampling.guided.coordinates import Coordinates, floored_cos
from sbrdf_jax.resampling.guided.lobe_model import HIGHEST_EXPONENT, fresnel, lobe_terms, log_shadowing

DIFFERENCE = 1e-5  # of log(n - 1), for central differences of Fresnel's formula


def lobe_slopes(shape: Float[np.ndarray, " 9"], at: Coordinates) -> Float[np.ndarray, "9 4 sample"]:
    """Return the derivatives of `lobe_terms` by each shape parameter: most are a term times a logarithm's derivative.

    Args:
        shape: `SHAPE_NAMES`.
        at: Coordinates [sample].
    """
    cos_i, cos_o = floored_cos(at.theta_i), floored_cos(at.theta_o)
    cosines = np.stack([cos_i, cos_o, at.cos_difference, np.ones_like(cos_i)])
    reflected, below, above = (fresnel(cosines, 1 + np.exp(shape[0] + h)) for h in (0.0, -DIFFERENCE, DIFFERENCE))
    by_index = (above - below) / (2 * DIFFERENCE)
    log_fresnel = np.log(reflected[2] / reflected[3])
    fresnel_slope = by_index[2] / reflected[2] - by_index[3] / reflected[3]
    _, mirror, *lobes = lobe_terms(shape, at).T
    slopes = np.zeros((len(shape), 4, len(cos_i)))
    slopes[0, 0] = -by_index[0] * (1 - reflected[1]) - by_index[1] * (1 - reflected[0])
    slopes[0, 1] = mirror * fresnel_slope
    ratio = at.tan2_half / np.exp(2 * shape[1])
    slopes[1, 1] = mirror * 2 * np.where(ratio < HIGHEST_EXPONENT, ratio, 0.0)
    for k, lobe in enumerate(lobes):
        width, (fresnel_power, shadowing_power) = np.exp(shape[2 + k]), shape[4 + 2 * k : 6 + 2 * k]
        shadowing, shadowing_slope = 0.0, 0.0
        for cos in (cos_i, cos_o):
            root2 = 1 + width**2 * (1 - cos**2) / cos**2
            shadowing = shadowing + log_shadowing(width, cos)
            shadowing_slope = shadowing_slope - (root2 - 1) / (root2 + np.sqrt(root2))
        ratio = at.tan2_half / width**2
        slopes[0, 2 + k] = lobe * fresnel_power * fresnel_slope
        slopes[2 + k, 2 + k] = lobe * (shadowing_power * shadowing_slope + 4 * ratio / (1 + ratio))
        slopes[4 + 2 * k, 2 + k] = lobe * log_fresnel
        slopes[5 + 2 * k, 2 + k] = lobe * shadowing
    slopes[8, 1] = -mirror * np.log(cos_i * cos_o)
    return slopes
