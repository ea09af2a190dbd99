"""How smooth: chosen by the data, by leave-one-out and leave-one-incident-angle-out, both in closed form.

A field is read between measured directions of a measured incident angle and between
incident angles: what is best for the one alone can be poor for the other.
"""

import math
from typing import NamedTuple

import numpy as np

from sbrdf_jax.resampling.guided.centres import Centres
from sbrdf_jax.resampling.guided.inverse import leave_group_out, leave_one_out
from sbrdf_jax.resampling.guided.nodes import ModeVariance, Term, mode_variance

CONSTANT = 1e-2  # variance of a constant, relative to the half-angle term's
PRIOR = (
    Term("half", 1.5, 1.0, (3.0, 1.5, 1.0)),
    Term("azimuth", 0.5, 0.18, (10.0, 3.3, 3.3)),
    Term("half", 0.5, 0.02, (3.0, 0.5, 1.0)),
    Term("difference", math.inf, 0.006, (1.2, 0.6, 0.09)),
    Term("difference", math.inf, 0.002, (0.4, 0.2, 0.03)),
)
NOISE_LADDER = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 3e-1)  # noise variance relative to the half-angle term's
FIRST_NOISE = 3e-3


class Choice(NamedTuple):
    """A noise level, and the curve that led to it: (noise, left-out error) each."""

    variance: ModeVariance
    noise: float
    curve: tuple[tuple[float, float], ...]
    left_out: np.ndarray  # [centre, wavelength] leave-one-out residuals
    reciprocity_cost: float  # left-out error with nodes tied by reciprocity over that without; 1 where not tied


def mean_root(residual: np.ndarray) -> float:
    """Mean root of absolute residuals, squared: outliers count little."""
    return float(np.mean(np.sqrt(np.abs(residual))) ** 2)


def left_out_error(
    centres: Centres, residual: np.ndarray, variance: ModeVariance, noise: float
) -> tuple[float, np.ndarray]:
    """Geometric mean of the errors of left-out directions and of left-out incident angles, in z.

    Args:
        centres: Where the samples are.
        residual: z minus the lobe model's [centre, wavelength].
        variance: The prior.
        noise: Noise variance of one sample.

    Returns:
        The error, inf where there is none, and the leave-one-out residuals [centre, wavelength].
    """
    seen = centres.number > 0
    _, lower, blocks = centres.inverse(variance, noise)
    out, dual = leave_one_out(lower, residual)
    error = mean_root(out[seen])
    if centres.num_groups > 1:
        error = float(np.sqrt(error * mean_root(leave_group_out(blocks, dual)[0][seen])))
    return error if np.isfinite(error) else np.inf, out


def choose_smoothing(centres: Centres, residual: np.ndarray, noise: float | None) -> Choice:
    """Choose how smooth the residual is: the noise climbs a ladder while `left_out_error` falls.

    Args:
        centres: Where the samples are.
        residual: z minus the lobe model's [centre, wavelength].
        noise: Fixed relative noise variance; None: chosen.
    """
    variance = mode_variance(PRIOR, CONSTANT, centres.reciprocal)
    tried: dict[float, tuple[float, np.ndarray]] = {}

    def error(level: float) -> float:
        if level not in tried:
            tried[level] = left_out_error(centres, residual, variance, level)
        return tried[level][0]

    if noise is None:
        ladder = NOISE_LADDER
        step = ladder.index(FIRST_NOISE)
        for direction in (1, -1):
            while 0 <= step + direction < len(ladder) and error(ladder[step + direction]) < error(ladder[step]):
                step += direction
        noise = ladder[step]
    cost = 1.0
    if centres.reciprocal:
        free = mode_variance(PRIOR, CONSTANT)
        cost = error(noise) / left_out_error(centres, residual, free, noise)[0]
    error(noise)
    curve = tuple((level, found[0]) for level, found in sorted(tried.items()))
    return Choice(variance, noise, curve, tried[noise][1], cost)
