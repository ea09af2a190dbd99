"""Drop-outs: samples far below everything that was measured round them, at the same incident angle.

Levels are compared in a logarithm that is linear below the noise. Round each incident angle
the samples form a triangulation; a basin of it that holds few samples is filled up to the
level at which it overflows (an area closing, as in image morphology). What is filled by a
large factor is a drop-out. A lone low sample and a short row of them are found alike; a
slope, a valley or a dark half of the hemisphere overflows at its own level and is not.
"""

import functools

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import Delaunay

from sbrdf_jax.records import RawSamples

MAX_TOGETHER = 4  # samples of one basin; a larger dark region is taken as measured
MIN_FACTOR = 2.5  # by which a basin's level lies below its rim
EDGE_FACTOR = 2.0  # by which a drop-out's half-shadowed neighbour lies below its other neighbours
MIN_NEIGHBOURS = 3  # round a basin
MIN_SAMPLES = 8  # of an incident angle


def find_dropouts(samples: RawSamples, incidence: Int[np.ndarray, " sample"]) -> np.ndarray:
    """Return the mask of samples that lie far below all their angular neighbours, in most wavelengths.

    Args:
        samples: Finite values [1/sr] and angles; wavelengths that are NaN throughout are left out.
        incidence: Which incident angle each sample belongs to, from 0.

    Returns:
        Boolean mask [sample].

    Numerics:
        The level of a sample is the mean over wavelengths of log(max(value, 0) + noise), the noise being
        that of each incident angle, from second differences along the spectrum. The factors between
        a basin and its rim are therefore those of values well above the noise: near it nothing is found.
        Every scale follows from the data, so multiplying all values changes nothing.
    """
    live = np.isfinite(samples.value).any(axis=0)
    mask = np.zeros(samples.num_samples, bool)
    order = np.argsort(incidence, kind="stable")
    for member in np.split(order, np.flatnonzero(np.diff(incidence[order])) + 1):
        if len(member) < MIN_SAMPLES:
            continue
        value = samples.value[member][:, live]
        noise = spectral_noise(value)
        if noise > 0:
            level = np.log(np.maximum(value, 0) + noise).mean(axis=1)
            angles = (np.asarray(a[member], np.float64).tobytes() for a in (samples.theta_o, samples.phi_o))
            mask[member] = _low(level, *_neighbours(*angles))
    return mask


def spectral_noise(value: Float[np.ndarray, "sample wavelength"]) -> float:
    """Estimate the absolute noise [as value] of the darker half of some samples; 0 if nothing is positive.

    The median second difference along the spectrum, where three neighbours are positive (clipped
    zeros tell nothing), as a standard deviation. With fewer than three wavelengths there is no
    such estimate: a tenth of the median positive value stands in.
    """
    if not np.any(value > 0):
        return 0.0
    stand_in = 0.1 * float(np.median(value[value > 0]))
    if value.shape[1] < 3:
        return stand_in
    level = np.median(value, axis=1)
    dark = value[level <= np.median(level)]
    left, mid, right = dark[:, :-2], dark[:, 1:-1], dark[:, 2:]
    positive = (left > 0) & (mid > 0) & (right > 0)
    if not positive.any():
        return stand_in
    second_difference = np.abs(left - 2 * mid + right)[positive]
    # a floor keeps the logarithm finite where spectra are exactly straight
    return max(1.4826 * float(np.median(second_difference)) / np.sqrt(6), 1e-5 * stand_in)


def _low(level: np.ndarray, start: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Mask of the samples that lie deep in a basin, and of those half in its shadow."""

    def neighbours(sample):
        return index[start[sample] : start[sample + 1]].tolist()

    deep = np.zeros(len(level), bool)
    candidates = _candidates(level, start, index)
    basins, overflow = _flood(candidates, level, start, index)
    far_below = overflow - level[candidates] > np.log(MIN_FACTOR)
    for sample, members, rim in zip(candidates[far_below], basins[far_below], overflow[far_below], strict=True):
        basin = set(members[level[members] < rim].tolist())
        around = {k for m in basin for k in neighbours(m)} - basin
        deep[sample] = len(around) >= MIN_NEIGHBOURS  # at the end of a row of samples, one neighbour proves nothing
    low = deep.copy()
    for edge in {k for m in np.flatnonzero(deep) for k in neighbours(m) if not deep[k]}:
        others = [k for k in neighbours(edge) if not deep[k]]
        if len(others) >= MIN_NEIGHBOURS and np.median(level[others]) - level[edge] > np.log(EDGE_FACTOR):
            low[edge] = True
    return low


def _candidates(level: np.ndarray, start: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Samples that may be deep: one neighbour is far above, or a basin may hold them all."""
    count = np.diff(start)
    far_above = np.zeros(len(level), bool)
    some = count > 0
    highest = np.maximum.reduceat(level[index], start[:-1][some])
    far_above[some] = highest - level[some] > np.log(MIN_FACTOR)
    return np.flatnonzero(far_above | (some & (count <= MAX_TOGETHER)))


def _flood(samples: np.ndarray, level: np.ndarray, start: np.ndarray, index: np.ndarray):
    """Flood a basin from each sample, always over the lowest sample at its shore, until it holds `MAX_TOGETHER` + 1.

    Returns:
        Who is flooded [sample, member], and the level at which each basin overflows; -inf where the shore ends first.
    """
    nobody, count = len(level), np.diff(start)
    table = np.full((nobody + 1, max(count.max(initial=0), 1)), nobody)
    table[np.repeat(np.arange(nobody), count), np.arange(len(index)) - np.repeat(start[:-1], count)] = index
    height = np.append(level, np.inf)
    basin = samples[:, None]
    for _ in range(MAX_TOGETHER):
        shore = table[basin].reshape(len(samples), -1)
        flooded = (shore[:, :, None] == basin[:, None, :]).any(axis=2)
        lowest = np.where(flooded, np.inf, height[shore]).argmin(axis=1)[:, None]
        next_one = np.where(np.take_along_axis(flooded, lowest, 1), nobody, np.take_along_axis(shore, lowest, 1))
        basin = np.concatenate([basin, next_one], axis=1)
    full = (basin < nobody).all(axis=1)
    return basin, np.where(full, height[basin].max(axis=1), -np.inf)


@functools.lru_cache(maxsize=64)
def _neighbours(theta_o: bytes, phi_o: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return (start, index): the neighbours of direction k are index[start[k] : start[k + 1]].

    By triangulation, or along a scan in one plane; kept for the next measurement in the same directions.
    """
    theta_o, phi_o = np.frombuffer(theta_o), np.frombuffer(phi_o)
    radius = 2 * np.sin(theta_o / 2)  # equal-area
    point = np.stack([radius * np.cos(phi_o), radius * np.sin(phi_o)], axis=1)
    centred = point - point.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=False)
    count = len(point)
    if spread[1] <= 1e-3 * spread[0]:  # all in one plane: two to either side
        position = np.argsort(centred @ axes[0], kind="stable")
        near = np.argsort(position)[:, None] + np.array([-2, -1, 1, 2])
        inside = (near >= 0) & (near < count)
        return np.concatenate([[0], np.cumsum(inside.sum(axis=1))]), position[near[inside]]
    return Delaunay(point).vertex_neighbor_vertices
