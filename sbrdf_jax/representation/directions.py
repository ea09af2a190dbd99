"""The distinct directions of a grid, and how often each one counts."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sbrdf_jax.angles import fold_azimuth, wrap_azimuth

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
