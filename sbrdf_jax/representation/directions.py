"""The distinct directions of a grid, how often each one counts, and where the lobe points."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sbrdf_jax.angles import MIRROR_AZIMUTH, fold_azimuth, wrap_azimuth

SAME_ANGLE = 1e-9  # rad; angles closer than this are one
SAME_VALUE = 1e-12  # of the largest; mirror twins closer than this are equal


class DirectionSet(NamedTuple):
    """The distinct directions of the inclusive grid; eq. (18) counts each as often as it has nodes."""

    theta_o: Float[np.ndarray, " direction"]  # rad
    phi_o: Float[np.ndarray, " direction"]  # rad, 0 to pi where mirror twins are one direction
    weight: Float[np.ndarray, " direction"]  # nodes of the direction
    index: Int[np.ndarray, "theta_o phi_o"]  # direction of each node
    folded: bool  # mirror twins are one direction

    def merge(self, value: Float[np.ndarray, "theta_i theta_o phi_o coefficient"]) -> np.ndarray:
        """Return the mean over the nodes of each direction, [theta_i, direction, coefficient]."""
        nodes = value.reshape(len(value), -1, value.shape[-1])
        share = np.zeros((len(self.weight), self.index.size))
        share[self.index.ravel(), np.arange(self.index.size)] = 1 / self.weight[self.index.ravel()]
        return share @ nodes


def distinct_directions(theta_o: np.ndarray, phi_o: np.ndarray, *, folded: bool) -> DirectionSet:
    """Return the distinct directions of a grid whose phi_o may hold both 0 and 2 pi.

    Args:
        theta_o: Axis [rad]; at 0 all azimuths are one direction.
        phi_o: Axis [rad].
        folded: Take phi_o and -phi_o as one direction.
    """
    theta, phi = np.meshgrid(theta_o, fold_azimuth(phi_o) if folded else wrap_azimuth(phi_o), indexing="ij")
    phi = np.where((theta < SAME_ANGLE) | (phi > 2 * np.pi - SAME_ANGLE), 0.0, phi)
    key = np.round(np.stack([theta.ravel(), phi.ravel()], axis=1) / SAME_ANGLE)
    _, first, index, count = np.unique(key, axis=0, return_index=True, return_inverse=True, return_counts=True)
    index = index.reshape(theta.shape)  # NumPy 2.0 gave it another shape
    return DirectionSet(theta.ravel()[first], phi.ravel()[first], count.astype(float), index, folded)


def is_bilateral(value: Float[np.ndarray, "theta_i theta_o phi_o coefficient"], phi_o: np.ndarray) -> bool:
    """Return whether a field on a symmetric phi_o axis equals its own mirror image."""
    if not np.allclose(phi_o + phi_o[::-1], 2 * np.pi, rtol=0, atol=SAME_ANGLE):
        return False
    largest = np.max(np.abs(value), initial=0.0, where=np.isfinite(value))
    return np.allclose(value, value[:, :, ::-1], rtol=0, atol=SAME_VALUE * largest, equal_nan=True)


def parabola_peak(
    mean: Float[np.ndarray, "theta_i theta_o phi_o"], theta_i: np.ndarray, theta_o: np.ndarray, phi_o: np.ndarray
) -> Float[np.ndarray, " theta_i"]:
    """Return the polar angle of the lobe's peak [rad], at the mirror azimuth, for each incident angle.

    The vertex of a parabola through the logarithms of three nodes round the largest one, in the
    plane of incidence, where theta_o counts negative on the side of the incidence.

    Args:
        mean: The spectra's mean at the nodes [1/sr].
        theta_i: Axis [rad].
        theta_o: Axis [rad], from 0.
        phi_o: Axis [rad].

    Numerics:
        0 at normal incidence, by symmetry. The largest node itself where it is the last one or
        a logarithm does not exist; the mirror direction where nothing is positive.
    """
    front = mean[:, :, np.argmin(np.abs(phi_o - MIRROR_AZIMUTH))]
    back = mean[:, :, np.argmin(fold_azimuth(phi_o))]
    is_pole = theta_o < SAME_ANGLE
    signed = np.concatenate([-theta_o[~is_pole][::-1], theta_o])
    peaks = np.array(theta_i, float)
    for i, curve in enumerate(np.concatenate([back[:, ~is_pole][:, ::-1], front], axis=1)):
        ahead = np.where((signed >= 0) & np.isfinite(curve), curve, -np.inf)
        top = int(np.argmax(ahead))
        if theta_i[i] < SAME_ANGLE or not ahead[top] > 0:
            continue
        peaks[i] = signed[top]
        near = slice(top - 1, top + 2)
        if 0 < top < len(signed) - 1 and np.all(curve[near] > 0):
            peaks[i] = np.clip(_vertex(signed[near], np.log(curve[near])), 0, np.pi / 2)
    return peaks


def _vertex(x, y):
    """Return where the parabola through three points is extreme, within them; the middle one if they lie on a line."""
    left, right = (y[1] - y[0]) / (x[1] - x[0]), (y[2] - y[1]) / (x[2] - x[1])
    curvature = (right - left) / (x[2] - x[0])
    if not curvature < 0:
        return x[1]
    return np.clip((x[0] + x[1] - left / curvature) / 2, x[0], x[2])
