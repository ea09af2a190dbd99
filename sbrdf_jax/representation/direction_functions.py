"""The functions of a pair of directions that a lobe tensor combines: of the half angle, the azimuth, and Fresnel's."""

import numpy as np

from sbrdf_jax.array_module import array_module
from sbrdf_jax.splines import spline_weights

AZIMUTH_FUNCTIONS = 3
OTHER_FUNCTIONS = AZIMUTH_FUNCTIONS + 1
PAPER_STEP = np.radians(7.5)
PAPER_FLOOR = 1e-4  # sin^2 of the half angle below which a grid of the paper's step tells nothing apart
SPLINE_SPACING = 0.71  # of the logarithm, where a field between its nodes is guessed
FINE_SPACING = 0.5  # where it is known
OPPOSITE = 1e-12  # keeps 0 / 0 finite where both directions graze and mirror each other: the half angle is 0


def half_angle_floor(step: float) -> float:
    """Return the sin^2 of the half angle that a grid of this step [rad] can tell from 0."""
    return float(max(PAPER_FLOOR * (step / PAPER_STEP) ** 2, 1e-8))


def num_direction_functions(floor: float, *, is_field: bool) -> int:
    """Return how many functions a tensor takes; `is_field`: it is fitted between the nodes too, to what is known."""
    spacing = FINE_SPACING if is_field else SPLINE_SPACING
    return round(np.log1p(1 / floor) / spacing) + 3 + OTHER_FUNCTIONS


def direction_functions(theta_i, theta_o, phi_o, floor: float, count: int):
    """Evaluate all functions at directions [..., function].

    Cubic B-splines, even in log(sin^2 theta_h + floor) with theta_h the half angle: lobes of all
    widths, wherever their peak is. Then (sin theta_i sin theta_o)^k cos(k phi_o), k from 1, and
    (1 - cos theta_d)^5 with theta_d the difference angle, by which Schlick's Fresnel factor rises.
    All are even in phi_o, finite at 90 degrees, and independent of phi_o at both poles.

    Args:
        theta_i: Polar angle of incidence [rad]; the three have one shape.
        theta_o: Polar angle of exitance [rad].
        phi_o: Azimuth of exitance [rad].
        floor: From `half_angle_floor`.
        count: How many functions there are.
    """
    xp = array_module(theta_i, theta_o, phi_o)
    sin_i, sin_o, cos_phi = xp.sin(theta_i), xp.sin(theta_o), xp.cos(phi_o)
    across = sin_i**2 + sin_o**2 + 2 * sin_i * sin_o * cos_phi  # of the half vector, squared
    along = (xp.cos(theta_i) + xp.cos(theta_o)) ** 2
    sin_squared = xp.maximum(across, 0.0) / (xp.maximum(across, 0.0) + along + OPPOSITE)
    low, high = np.log(floor), np.log1p(floor)
    splines = spline_weights((xp.log(sin_squared + floor) - low) / (high - low), count - OTHER_FUNCTIONS)
    waves = [(sin_i * sin_o) ** k * xp.cos(k * phi_o) for k in range(1, AZIMUTH_FUNCTIONS + 1)]
    fresnel = (1 - xp.sqrt((xp.maximum(across, 0.0) + along + OPPOSITE) / 4)) ** 5
    return xp.concatenate([splines, xp.stack([*waves, fresnel], axis=-1)], axis=-1)
