"""Drop-outs: samples far below everything that was measured round them, at the same incident angle.

Levels are compared in a logarithm that is linear below the noise. Round each incident angle
the samples form a triangulation; a basin of it that holds few samples is filled up to the
level at which it overflows (an area closing, as in image morphology). What is filled by a
large factor is a drop-out. A lone low sample and a short row of them are found alike; a
slope, a valley or a dark half of the hemisphere overflows at its own level and is not.
"""

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
            start, index = _neighbours(samples.theta_o[member], samples.phi_o[member])
            if _may_be_deep(level, start, index):
                bounds = zip(start[:-1], start[1:], strict=True)
                mask[member] = _low(level, [index[a:b].tolist() for a, b in bounds])
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


def _may_be_deep(level: np.ndarray, start: np.ndarray, index: np.ndarray) -> bool:
    """Whether some local minimum may be the floor of a deep basin; spares the search where data are smooth."""
    some = np.diff(start) > 0
    below = level[some]
    lowest, highest = (f.reduceat(level[index], start[:-1][some]) for f in (np.minimum, np.maximum))
    # with as many neighbours as a basin has samples, one of them lies on its rim
    enclosed = np.diff(start)[some] < MAX_TOGETHER
    return bool(np.any((below <= lowest) & (enclosed | (highest - below > np.log(MIN_FACTOR)))))


def _low(level: np.ndarray, neighbours: list[list[int]]) -> np.ndarray:
    """Mask of the samples that lie deep in a basin, and of those half in its shadow."""
    low = np.zeros(len(level), bool)
    for members, rim_level in _basins(level, neighbours):
        deep = [m for m in members if rim_level - level[m] > np.log(MIN_FACTOR)]
        around = {k for m in members for k in neighbours[m]} - set(members)
        if not deep or len(around) < MIN_NEIGHBOURS:
            continue  # the end of a row of samples: one neighbour proves nothing
        low[deep] = True
        for edge in {k for m in deep for k in neighbours[m]} - set(deep):
            others = [k for k in neighbours[edge] if k not in deep]
            if len(others) >= MIN_NEIGHBOURS and np.median(level[others]) - level[edge] > np.log(EDGE_FACTOR):
                low[edge] = True
    return low


def _basins(level: np.ndarray, neighbours: list[list[int]]) -> list[tuple[list[int], float]]:
    """Return the basins of at most `MAX_TOGETHER` samples, each with the level at which it overflows.

    Samples are flooded from the lowest up; a basin is closed by the sample that joins it to a
    larger one.
    """
    parent = [-1] * len(level)
    members: dict[int, list[int] | None] = {}  # by root; None where there are too many
    closed = []

    def root(k):
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = parent[k]
        return k

    for sample in np.argsort(level, kind="stable").tolist():
        joined = {root(k) for k in neighbours[sample] if parent[k] >= 0}
        parent[sample] = sample
        basins = [members.pop(r) for r in joined]
        for r in joined:
            parent[r] = sample
        union = [sample] + [m for basin in basins if basin is not None for m in basin]
        if None in basins or len(union) > MAX_TOGETHER:
            closed += [(basin, float(level[sample])) for basin in basins if basin is not None]
            members[sample] = None
        else:
            members[sample] = union
    return closed


def _neighbours(theta_o: np.ndarray, phi_o: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (start, index): the neighbours of direction k are index[start[k] : start[k + 1]].

    By triangulation, or along a scan in one plane.
    """
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
