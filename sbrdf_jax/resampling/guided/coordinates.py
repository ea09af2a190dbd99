"""Where the guided method works: coordinates in which a glossy field is smooth, and a generalised logarithm.

Two systems share theta_i and theta_o: the third coordinate is log(theta_h[deg] + 1), which
stretches the neighbourhood of the mirror direction, or the folded azimuth. Near either
pole the azimuth is compressed to a constant, so that the field is exactly isotropic there.
"""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from sbrdf_jax.angles import GRAZING, fold_azimuth
from sbrdf_jax.array_module import AnyArray, array_module
from sbrdf_jax.records import pytree

COS_FLOOR = float(np.cos(GRAZING))  # every cosine that divides or weighs is at least this
EXTRAPOLATION = np.deg2rad(10.0)  # beyond the measured range the field goes on so far, then stays
POLE_BLEND = 0.005  # sin(theta_i) sin(theta_o) at which the azimuth has half of its effect
COS_POWER = 0.25  # of both cosines, in the floor
LARGEST_Z = 80.0  # an exponential of more would be of no use to anyone


@pytree()
class Coordinates:
    """Directions as the guided method sees them; the polar angles have the shapes that they came with."""

    half: Any  # log(theta_h [deg] + 1)
    azimuth: Any  # rad, folded to [0, pi], pi / 2 at the poles
    theta_i: Any  # rad, clamped
    theta_o: Any  # rad, clamped
    tan2_half: Any  # tan(theta_h)^2
    cos_difference: Any  # cosine of the angle between half vector and incidence
    difference: Any  # that angle [rad]
    lean: Any  # theta_i - theta_o [rad]


def guided_coordinates(
    theta_i: Float[AnyArray, "*#shape"],
    theta_o: Float[AnyArray, "*#shape"],
    phi_o: Float[AnyArray, "*#shape"],
    theta_limit: Float[AnyArray, " 2"],
) -> Coordinates:
    """Return the guided method's coordinates of directions, whose angles broadcast.

    theta_h comes from atan2 of the tangential and the normal part of the sum of both
    directions: mirror samples have theta_h near 0.1 degrees, where arccos has no digits.

    Args:
        theta_i: Incident polar angle [rad].
        theta_o: Outgoing polar angle [rad].
        phi_o: Outgoing azimuth [rad]; the mirror direction is at pi.
        theta_limit: Largest theta_i and theta_o [rad]; angles beyond are clamped to it.
    """
    xp = array_module(theta_i, theta_o, phi_o, theta_limit)
    theta_i = xp.clip(theta_i, 0.0, theta_limit[0])
    theta_o = xp.clip(theta_o, 0.0, theta_limit[1])
    azimuth = fold_azimuth(phi_o)
    sin_i, sin_o = xp.sin(theta_i), xp.sin(theta_o)
    # |tangential part|^2 as a sum of squares that vanishes exactly at the mirror direction
    tangential2 = (sin_i - sin_o) ** 2 + 4 * sin_i * sin_o * xp.cos(azimuth / 2) ** 2
    normal = xp.cos(theta_i) + xp.cos(theta_o)
    theta_h = xp.arctan2(xp.sqrt(tangential2 + 1e-24), normal)
    twice_cos_difference = xp.sqrt(tangential2 + normal**2)
    apart2 = (sin_i - sin_o) ** 2 + 4 * sin_i * sin_o * xp.sin(azimuth / 2) ** 2
    apart2 = apart2 + (xp.cos(theta_i) - xp.cos(theta_o)) ** 2
    blend = sin_i * sin_o / (sin_i * sin_o + POLE_BLEND)
    return Coordinates(
        half=xp.log1p(xp.rad2deg(theta_h)),
        azimuth=np.pi / 2 + (azimuth - np.pi / 2) * blend,
        theta_i=theta_i,
        theta_o=theta_o,
        tan2_half=tangential2 / xp.maximum(normal, 1e-3) ** 2,
        cos_difference=xp.clip(twice_cos_difference / 2, 0.0, 1.0),
        difference=xp.arctan2(xp.sqrt(apart2 + 1e-24), twice_cos_difference),
        lean=theta_i - theta_o,
    )


def coordinates_on_axes(
    theta_i: Float[AnyArray, ""], theta_o: Float[AnyArray, " o"], phi_o: Float[AnyArray, " p"], theta_limit
):
    """`guided_coordinates` [o, p] of all combinations of two axes, at one incident angle, [1, 1]; theta_o [o, 1]."""
    return guided_coordinates(theta_i.reshape(1, 1), theta_o[:, None], phi_o[None, :], theta_limit)


def exchanged(at: Coordinates) -> Coordinates:
    """Return the coordinates of the same light the other way: half vector and azimuth do not change."""
    return dataclasses.replace(at, theta_i=at.theta_o, theta_o=at.theta_i, lean=-at.lean)


def floored_cos(theta: Float[AnyArray, "*shape"]) -> Float[AnyArray, "*shape"]:
    """Cosine of polar angles [rad], at least cos 85 degrees."""
    xp = array_module(theta)
    return xp.maximum(xp.cos(theta), COS_FLOOR)


def log_scale(at: Coordinates, floor: Float[AnyArray, ""] | float) -> Float[AnyArray, "*shape"]:
    """Factor (cos theta_i cos theta_o)^1/4 / floor [sr] on a value in the generalised logarithm.

    What an instrument cannot see grows towards grazing. The factor is the same for both
    directions of light, so that a field that is reciprocal in z is so in its values.
    """
    return (floored_cos(at.theta_i) * floored_cos(at.theta_o)) ** COS_POWER / floor


def to_log(
    value: Float[AnyArray, "*#shape wavelength"], scale: Float[AnyArray, "*#shape"]
) -> Float[AnyArray, "*shape wavelength"]:
    """Generalised logarithm z = log(1 + value scale): relative above the floor, absolute below.

    Values below 0 are counted as 0: they are at or below the noise.
    """
    xp = array_module(value, scale)
    return xp.log1p(xp.maximum(value, 0.0) * scale[..., None])


def from_log(
    z: Float[AnyArray, "*#shape wavelength"], scale: Float[AnyArray, "*#shape"]
) -> Float[AnyArray, "*shape wavelength"]:
    """Inverse of `to_log`; never negative, because a z below 0 counts as 0."""
    xp = array_module(z, scale)
    return xp.expm1(xp.clip(z, 0.0, LARGEST_Z)) / scale[..., None]


def slope(
    z: Float[AnyArray, "*#shape wavelength"], scale: Float[AnyArray, "*#shape"]
) -> Float[AnyArray, "*shape wavelength"]:
    """Derivative of `from_log` by z [1/sr]; where z is below 0, that at 0."""
    xp = array_module(z, scale)
    return xp.exp(xp.clip(z, 0.0, LARGEST_Z)) / scale[..., None]
