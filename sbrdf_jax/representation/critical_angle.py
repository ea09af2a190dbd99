"""Candidates for the critical angle of section 4.2, from the data alone."""

import numpy as np
from jaxtyping import Float

CANDIDATES = 21
FALLEN = 0.05  # of the far median: a coefficient this close to it has no lobe left
HALVINGS = 36  # after which a lobe is 1e-11 of its height
ROUNDING = 1e-9  # rad


def critical_candidates(
    value: Float[np.ndarray, "pair direction"],
    alpha: Float[np.ndarray, "pair direction"],
    exponent: Float[np.ndarray, "pair kind direction"],
    num_functions: int,
) -> Float[np.ndarray, "pair candidate"]:
    """Return uniform candidates for the critical angle [rad] of each pair (incident angle, coefficient).

    From the half-width of the lobe (three directions inside, at least) to the angle where the
    coefficient has fallen to its far median, within 5 % of that: the median of the farther half
    of the directions. Where a lobe of that half-width reaches further, by any kind that is
    tried, the range ends where it has vanished: only then is the background outside free of
    it. As many directions as the background has functions stay outside.

    Args:
        value: The coefficient.
        alpha: Angle from the lobe's peak [rad].
        exponent: s(alpha) of each kind of lobe.
        num_functions: Of the background.
    """
    order = np.argsort(alpha, axis=1)
    value, alpha = (np.take_along_axis(array, order, 1) for array in (value, alpha))
    exponent = np.take_along_axis(exponent, order[:, None], 2)
    far = np.median(value[:, value.shape[1] // 2 :], axis=1, keepdims=True)
    above = np.abs(value - far)
    half = _first(above <= above[:, :3].max(axis=1, keepdims=True) / 2)
    fallen = _first(above <= FALLEN * np.abs(far))
    vanished = _first(np.all(exponent >= HALVINGS * np.take_along_axis(exponent, half[:, None], 2), axis=1))
    most = np.minimum(alpha[:, [max(alpha.shape[1] - num_functions - 1, 0)]], np.pi / 2)
    lower = np.minimum(np.take_along_axis(alpha, np.maximum(half, 2), 1) + ROUNDING, most)
    upper = np.clip(np.take_along_axis(alpha, np.maximum(fallen, vanished), 1), lower, most)
    return np.linspace(lower[:, 0], upper[:, 0], CANDIDATES, axis=1)


def _first(condition):
    """Return, for each pair, the place of the first direction that meets a condition; the last one if none does."""
    first = np.where(condition.any(axis=1), condition.argmax(axis=1), condition.shape[1] - 1)
    return first[:, None]
