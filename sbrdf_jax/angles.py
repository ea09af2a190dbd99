"""Directions and angles between them; the only statement of the azimuth convention.

The incident direction has azimuth 0; the mirror direction is at phi_o = pi. A direction
(theta, phi) is the unit vector (sin theta cos phi, sin theta sin phi, cos theta).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sbrdf_jax.array_module import AnyArray, array_module

MIRROR_AZIMUTH = np.pi
SAME_ANGLE = 1e-9  # rad; closer angles are one: degrees in a file and back are not exact
GRAZING = float(np.radians(85.0))  # beyond it a cosine that divides is that of this angle


def wrap_azimuth(phi):
    """Wrap azimuths [rad] to [0, 2 pi), for NumPy and JAX arrays alike."""
    return phi % (2 * np.pi)


def fold_azimuth(phi):
    """Fold azimuths [rad] onto the half circle [0, pi] of a bilateral sample: |wrap(phi)|."""
    return abs((phi + np.pi) % (2 * np.pi) - np.pi)


def unit_vector(theta: Float[AnyArray, "*shape"], phi: Float[AnyArray, "*shape"]) -> Float[AnyArray, "*shape 3"]:
    """Return unit vectors of the directions (theta, phi) [rad]."""
    xp = array_module(theta, phi)
    sin_theta = xp.sin(theta)
    return xp.stack([sin_theta * xp.cos(phi), sin_theta * xp.sin(phi), xp.cos(theta) + 0 * phi], axis=-1)


def angle_between(
    theta_a: Float[Array, "*shape"],
    phi_a: Float[Array, "*shape"],
    theta_b: Float[Array, "*shape"],
    phi_b: Float[Array, "*shape"],
) -> Float[Array, "*shape"]:
    """Angle between two directions [rad], 0 to pi, accurate where it is small.

    By 2 asin(|a - b| / 2), not arccos(a . b), which loses half of the digits near 0. The
    gradient at coincidence is taken as 0, where the angle itself has a corner.

    Args:
        theta_a: Polar angle of the first direction [rad].
        phi_a: Azimuth of the first direction [rad].
        theta_b: Polar angle of the second direction [rad].
        phi_b: Azimuth of the second direction [rad].

    Returns:
        Angle between the two [rad].
    """
    half_theta = jnp.sin((theta_a - theta_b) / 2) ** 2
    half_phi = jnp.sin((phi_a - phi_b) / 2) ** 2
    haversine = half_theta + jnp.sin(theta_a) * jnp.sin(theta_b) * half_phi
    is_zero = haversine <= 0
    safe = jnp.where(is_zero, 0.25, jnp.clip(haversine, 0.0, 1.0))
    # near pi the square root's slope is unbounded: atan2 keeps both ends accurate
    angle = 2 * jnp.arctan2(jnp.sqrt(safe), jnp.sqrt(jnp.maximum(1 - safe, 1e-300)))
    return jnp.where(is_zero, 0.0, angle)


def half_angle(theta_i: np.ndarray, theta_o: np.ndarray, phi_o: np.ndarray) -> np.ndarray:
    """Angle between the normal and the half vector of incidence and exitance [rad], on the host.

    By the tangent of the half vector's components, not the arccosine, which loses half of the
    digits near the mirror direction.
    """
    along = np.sin(theta_i) + np.sin(theta_o) * np.cos(phi_o)
    across = np.sin(theta_o) * np.sin(phi_o)
    return np.arctan2(np.hypot(along, across), np.cos(theta_i) + np.cos(theta_o))
