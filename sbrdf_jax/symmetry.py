"""Whether a measurement is symmetric to the plane of incidence, as folding it takes for granted."""

import numpy as np
import scipy.spatial

from sbrdf_jax.angles import fold_azimuth, wrap_azimuth
from sbrdf_jax.records import RawSamples

MOST_SAMPLES = 4096  # more tell no more
FEWEST_PAIRS = 20
REACH = np.radians(8.0)  # between the mirror twin of a direction and the nearest measured one
CONTRADICTED = 0.02  # median relative difference from which twins may contradict each other,
TIMES_NEIGHBOURS = 3.0  # and so many times that of neighbours on one side


def contradiction(samples: RawSamples) -> float | None:
    """Return the median relative difference of mirror twins where it contradicts the symmetry; None where it does not.

    Twins are a direction on one side of the plane of incidence and the nearest to its mirror image on the other; how
    much neighbours differ on one side, by noise and by the field's slope, says what is to be expected of them.
    """
    some = np.linspace(0, samples.num_samples - 1, min(samples.num_samples, MOST_SAMPLES)).round().astype(int)
    part = samples.take(np.unique(some))
    value = np.maximum(np.nan_to_num(part.value), 0.0)
    off_plane = np.abs(np.sin(part.phi_o)) * np.sin(part.theta_o)
    far = wrap_azimuth(part.phi_o) > np.pi
    sides = [np.flatnonzero((off_plane > np.sin(REACH)) & side) for side in (~far, far)]
    if min(map(len, sides)) < FEWEST_PAIRS:
        return None
    azimuth, sin_theta = fold_azimuth(part.phi_o), np.sin(part.theta_o)
    place = np.stack([sin_theta * np.cos(azimuth), sin_theta * np.sin(azimuth), np.cos(part.theta_o), part.theta_i], 1)
    one, other = sides
    twin_distance, twin = scipy.spatial.KDTree(place[other]).query(place[one])
    distance, neighbour = scipy.spatial.KDTree(place[one]).query(place[one], k=2)
    twins = _difference(value[one], value[other[twin]])[twin_distance < REACH]
    neighbours = _difference(value[one], value[one[neighbour[:, 1]]])[distance[:, 1] < REACH]
    if min(len(twins), len(neighbours)) < FEWEST_PAIRS:
        return None
    found, expected = float(np.median(twins)), float(np.median(neighbours))
    return found if found > max(CONTRADICTED, TIMES_NEIGHBOURS * expected) else None


def _difference(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Relative difference of spectra [row, wavelength], by row."""
    total = (one + other).sum(axis=1)
    return 2 * np.abs((one - other).sum(axis=1)) / np.where(total > 0, total, 1.0)
