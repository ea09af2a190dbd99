"""The distinct directions of a grid up to mirror symmetry, and how often each one counts.

The lobe's peak lies in the plane of incidence, so every critical angle keeps mirror twins
together and least squares falls apart into two: the part of a field that is even in phi_o,
with the even harmonics and the lobe, and the odd part, with the odd harmonics.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sbrdf_jax.angles import SAME_ANGLE, fold_azimuth, wrap_azimuth

SAME_VALUE = 1e-12  # of the largest; mirror twins closer than this are equal


class DirectionSet(NamedTuple):
    """The distinct directions of the inclusive grid; eq. (18) counts each as often as it has nodes."""

    theta_o: Float[np.ndarray, " direction"]  # rad
    phi_o: Float[np.ndarray, " direction"]  # rad, 0 to pi
    weight: Float[np.ndarray, " direction"]  # nodes of the direction and of its mirror twin
    index: Int[np.ndarray, "theta_o phi_o"]  # direction of each node
    side: Float[np.ndarray, "theta_o phi_o"]  # of each node: 1, or -1 beyond pi, or 0 in the plane of incidence

    def split(self, value: Float[np.ndarray, "theta_i theta_o phi_o coefficient"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the even and the odd part of values at the nodes, [theta_i, coefficient, direction].

        The mean over the nodes of a direction, with the sign of their side for the odd part,
        which is exactly 0 for a field that is its own mirror image to rounding. A value that is
        not finite makes its whole lane NaN.
        """
        value = np.where(np.isfinite(value), value, np.nan)  # infinities times 0 would warn
        nodes = np.moveaxis(value.reshape(len(value), -1, value.shape[-1]), 1, 2)
        share = np.zeros((self.index.size, len(self.weight)))
        share[np.arange(self.index.size), self.index.ravel()] = 1 / self.weight[self.index.ravel()]
        even, odd = nodes @ share, nodes @ (self.side.reshape(-1, 1) * share)
        largest = np.max(np.abs(even), axis=2, keepdims=True)
        return even, np.where(np.abs(odd).max(axis=2, keepdims=True) > SAME_VALUE * largest, odd, 0.0)


def distinct_directions(theta_o: np.ndarray, phi_o: np.ndarray) -> DirectionSet:
    """Return the distinct directions of a grid.

    Args:
        theta_o: Axis [rad]; at 0 all azimuths are one direction.
        phi_o: Axis [rad], symmetric about pi; may hold both 0 and 2 pi.

    Raises:
        ValueError: an axis that is not symmetric.
    """
    if not np.allclose(np.sort(wrap_azimuth(-phi_o)), np.sort(wrap_azimuth(phi_o)), rtol=0, atol=SAME_ANGLE):
        raise ValueError("phi_o: expected nodes that are symmetric about the plane of incidence")
    theta, azimuth = np.meshgrid(theta_o, wrap_azimuth(phi_o), indexing="ij")
    phi = np.where(theta < SAME_ANGLE, 0.0, fold_azimuth(azimuth))
    in_plane = (phi < SAME_ANGLE) | (phi > np.pi - SAME_ANGLE)
    side = np.where(in_plane, 0.0, np.where(azimuth < np.pi, 1.0, -1.0))
    key = np.round(np.stack([theta.ravel(), phi.ravel()], axis=1) / SAME_ANGLE)
    _, first, index, count = np.unique(key, axis=0, return_index=True, return_inverse=True, return_counts=True)
    index = index.reshape(theta.shape)  # NumPy 2.0 gave it another shape
    return DirectionSet(theta.ravel()[first], phi.ravel()[first], count.astype(float), index, side)
