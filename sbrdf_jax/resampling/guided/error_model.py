"""What the data say about their own errors: floor, outliers, and the local scale of the residuals."""

import dataclasses
from typing import Any

import numpy as np
import scipy.spatial
from jaxtyping import Float

from sbrdf_jax.array_module import AnyArray, array_module
from sbrdf_jax.records import pytree

SMALLEST_FLOOR = 5e-4  # 1/sr, an albedo of 0.16 %: below it, what is measured is mostly clipped noise
FLOOR_SHARE = (0.03, 0.3)  # bounds of the floor, as shares of the measurement's typical value
DARK_SHARE = 0.2
MOST_SAMPLES = 8192  # more say no more about the errors of all
TO_SIGMA = 1.4826  # median absolute deviation to standard deviation
NUM_NEIGHBOURS = 25
NEIGHBOUR_SCALE = (0.5, 0.25, 0.4)  # of half, theta_i, theta_o, where residuals are compared
OUTLIER = 5.0  # residuals so many times the local scale begin to lose weight
MAX_FACTOR = 100.0  # largest noise variance of an outlier, relative: next to no weight
SAMPLES_OF_SPECTRUM = 8
COVERED = 0.6827
SORTED_TOGETHER = 256  # residuals whose weights are summed before the sum is looked into
NO_WEIGHT = 1e-9
BETWEEN = (0.3, 10.0)  # bounds of what a standard error grows by between measured incident angles
MIRROR_PARAMETERS = 3  # width, grazing exponent, amplitude: what samples of the mirror image are fitted with
TABLE_WIDTH = 0.4  # nodes of the table over which residuals are pooled


def estimate_floor(theta_i: np.ndarray, theta_o: np.ndarray, azimuth: np.ndarray, value: np.ndarray) -> float:
    """Estimate where noise stops being relative, from differences of neighbours in the dark.

    Args:
        theta_i: Incident polar angles [rad].
        theta_o: Outgoing polar angles [rad].
        azimuth: Folded azimuths [rad].
        value: BRDF [sample, wavelength] [1/sr].

    Returns:
        Floor of the generalised logarithm [1/sr].
    """
    place = np.stack([20 * theta_i, np.sin(theta_o) * np.cos(azimuth), np.sin(theta_o) * np.sin(azimuth)], axis=1)
    some = spread_rows(len(place))
    neighbour = np.asarray(scipy.spatial.KDTree(place).query(place[some], k=2)[1])
    one, other = value[neighbour[:, 0]], value[neighbour[:, 1]]
    level, difference = (one + other) / 2, np.abs(one - other)
    positive = level > 0
    typical = float(np.median(level[positive]))
    dark = positive & (level <= np.quantile(level[positive], DARK_SHARE))
    noise = TO_SIGMA * float(np.median(difference[dark])) / np.sqrt(2)
    return float(np.clip(max(noise, SMALLEST_FLOOR), FLOOR_SHARE[0] * typical, FLOOR_SHARE[1] * typical))


def spread_rows(count: int) -> np.ndarray:
    """Rows that stand for all: all of a few, else some drawn at random, always the same."""
    if count <= MOST_SAMPLES:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, MOST_SAMPLES, replace=False))


def noise_factors(half: np.ndarray, theta_i: np.ndarray, theta_o: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Noise variance of each sample relative to its neighbours', from leave-one-out residuals.

    A residual of more than `OUTLIER` times what its neighbours show is a glint or a fault: its weight falls.

    Args:
        half: log(theta_h [deg] + 1) [sample].
        theta_i: Incident polar angles [rad].
        theta_o: Outgoing polar angles [rad].
        residual: Leave-one-out residuals in z [sample, wavelength].
    """
    size = np.maximum(np.sqrt(np.mean(np.clip(residual, -1.0, 1.0) ** 2, axis=1)), 1e-5)
    place = np.stack([half, theta_i, theta_o], axis=1) / np.asarray(NEIGHBOUR_SCALE)
    k = min(NUM_NEIGHBOURS, len(size))
    if k < 5:
        return np.ones(len(size))
    neighbour = np.asarray(scipy.spatial.KDTree(place).query(place, k=k)[1])
    local = np.exp(np.median(np.log(size)[neighbour[:, 1:]], axis=1))
    excess = np.maximum(size / local - OUTLIER, 0.0)
    return np.minimum(1 + excess**2, MAX_FACTOR)


@pytree()
class ResidualScale:
    """Local scale of standardised residuals on a uniform table over (theta_i, half, z)."""

    log_scale: Any  # [theta_i, half, z]
    start: Any  # [3]
    step: Any  # [3]
    # what a standard error grows by between incident angles; nothing in results of earlier versions
    between_theta_i: Any = dataclasses.field(default_factory=lambda: np.zeros(1))  # [knot] rad
    between_log_scale: Any = dataclasses.field(default_factory=lambda: np.zeros(1))  # [knot]
    # deviation of the logarithm of the lobe model's mirror term; nothing in results of earlier versions
    mirror: Any = dataclasses.field(default_factory=lambda: np.zeros(()))


def fit_residual_scale(
    theta_i: np.ndarray,
    half: np.ndarray,
    z: np.ndarray,
    standardised: np.ndarray,
    shape: tuple[int, int, int] = (9, 7, 7),
) -> ResidualScale:
    """Calibrate: the scale below which 68 % of the standardised residuals lie, where they were measured.

    Args:
        theta_i: Incident polar angles [rad] [sample].
        half: log(theta_h [deg] + 1) [sample].
        z: Predicted generalised logarithm [sample, wavelength].
        standardised: Residual over its predicted deviation [sample, wavelength].
        shape: Numbers of table nodes.
    """
    every = max(1, z.shape[1] // SAMPLES_OF_SPECTRUM)
    z, standardised = z[:, ::every], np.abs(standardised[:, ::every])
    wide = np.ones_like(z)
    features = np.stack([theta_i[:, None] * wide, half[:, None] * wide, z], axis=-1).reshape(-1, 3)
    size = standardised.reshape(-1)
    start, stop = np.quantile(features, 0.01, axis=0), np.quantile(features, 0.99, axis=0)
    start[1] = 0.0  # the mirror direction, however few its samples
    step = np.maximum((stop - start) / (np.asarray(shape) - 1), 1e-3)
    order = np.argsort(size)
    features, size = (np.clip(features[order], start, stop) - start) / step, size[order]
    near = [np.exp(-0.5 * ((features[:, k, None] - np.arange(shape[k])) / TABLE_WIDTH) ** 2) for k in range(3)]
    table = np.empty(shape)
    plane = (near[0][:, :, None] * near[1][:, None, :]).reshape(len(size), -1)
    parts = [slice(first, first + SORTED_TOGETHER) for first in range(0, len(size), SORTED_TOGETHER)]
    # far from all samples: the nearest ones decide
    weight = np.stack([plane[part].T @ near[2][part] + NO_WEIGHT * len(size[part]) for part in parts])
    before = np.cumsum(weight.reshape(len(parts), *shape), axis=0)
    for i, j, k in np.ndindex(shape):
        wanted = COVERED * before[-1, i, j, k]
        part = min(int(np.searchsorted(before[:, i, j, k], wanted)), len(parts) - 1)
        own = np.cumsum(plane[parts[part], i * shape[1] + j] * near[2][parts[part], k] + NO_WEIGHT)
        missing = wanted - (before[part - 1, i, j, k] if part else 0.0)
        table[i, j, k] = size[parts[part]][min(int(np.searchsorted(own, missing)), len(own) - 1)]
    return ResidualScale(log_scale=np.log(np.maximum(table, 1e-6)), start=start, step=step)


def estimate_mirror_deviation(share: Float[np.ndarray, " centre"], error: Float[np.ndarray, " centre"]) -> float:
    """Estimate how far the logarithm of the mirror image may be off where no sample says.

    The lobe model is fitted to all samples, those left out too: a peak that a few samples saw agrees with them
    better than with others. What they are off by when they are left out counts more for the fewer they are; of
    none, or no more than the model has parameters, a factor of e is assumed.

    Args:
        share: What part of z the mirror term is of.
        error: Size of the residuals of z, left out.
    """
    peak = share > 0.5
    number = float((share[peak] ** 2).sum())
    assumed = 1 / (1 + number)
    return float(
        np.sqrt((share[peak] ** 2 @ error[peak] ** 2 + assumed) / (max(number - MIRROR_PARAMETERS, 0) + assumed))
    )


def fit_between_scale(theta_i: Float[np.ndarray, " group"], ratios: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Calibrate what lies between measured incident angles, by incident angles that were left out.

    Args:
        theta_i: Measured incident angles, increasing [rad].
        ratios: For each, the squares of its residuals when it is left out, over what they were expected to be.

    Returns:
        Knots of `between_scale`: 1 at the measured angles; midway, and as far beyond the first and the last, what 68 %
        of the residuals need.
    """
    if len(theta_i) < 2:
        return {}
    needed = [np.sqrt(np.quantile(ratio, COVERED)) if len(ratio) else 1.0 for ratio in ratios]
    log_scale = np.log(np.clip(needed, *BETWEEN))
    gap = np.diff(theta_i) / 2
    beyond = np.concatenate([theta_i[:1] - gap[:1], theta_i[:-1] + gap, theta_i[-1:] + gap[-1:]])
    there = np.concatenate([log_scale[:1], (log_scale[:-1] + log_scale[1:]) / 2, log_scale[-1:]])
    knots, values = np.concatenate([beyond, theta_i]), np.concatenate([there, np.zeros(len(theta_i))])
    order = np.argsort(knots)
    return {"between_theta_i": knots[order], "between_log_scale": values[order]}


def between_scale(scale: ResidualScale, theta_i: Float[AnyArray, "*direction"]) -> Float[AnyArray, "*direction"]:
    """Interpolate by how much a standard error grows between measured incident angles."""
    xp = array_module(theta_i, scale.between_theta_i)
    return xp.exp(xp.interp(theta_i, scale.between_theta_i, scale.between_log_scale))


def residual_scale(
    scale: ResidualScale,
    theta_i: Float[AnyArray, "*#direction"],
    half: Float[AnyArray, "*direction"],
    z: Float[AnyArray, "*direction wavelength"],
) -> Float[AnyArray, "*direction wavelength"]:
    """Interpolate the table of `fit_residual_scale`, linearly in its logarithm."""
    xp, table = array_module(scale.log_scale, theta_i, half, z), scale.log_scale

    def place(axis, feature):
        x = xp.clip((feature - scale.start[axis]) / scale.step[axis], 0.0, table.shape[axis] - 1.0)
        low = xp.clip(xp.floor(xp.nan_to_num(x)), 0.0, table.shape[axis] - 2.0)  # nan is no index
        return low.astype(np.int32), x - low

    (i, along_i), (j, along_j), (k, along_k) = place(0, theta_i), place(1, half), place(2, z)
    along_i, along_j, one = along_i[..., None], along_j[..., None], np.int32(1)
    below, above = ((1 - along_j) * table[row, j] + along_j * table[row, j + one] for row in (i, i + one))
    of_direction = (1 - along_i) * below + along_i * above  # [*direction, node of z]
    low, high = (xp.take_along_axis(of_direction, index, axis=-1) for index in (k, k + one))
    return xp.exp((1 - along_k) * low + along_k * high)
