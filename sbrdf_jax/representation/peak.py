"""Where the lobe of each incident angle points: in the plane of incidence, from logarithms."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sbrdf_jax.angles import MIRROR_AZIMUTH, SAME_ANGLE, fold_azimuth
from sbrdf_jax.lobes import LOBE_KINDS
from sbrdf_jax.representation.critical_angle import CANDIDATES
from sbrdf_jax.representation.directions import DirectionSet
from sbrdf_jax.representation.lane_search import (
    Functions,
    LobeKinds,
    Pairs,
    fit_lanes,
    least,
    lobe_geometry,
    search_lanes,
)

BISECTIONS = 52
ROUNDING = 1e-6  # rad, by which a bracket is widened: a peak may lie half-way between two nodes
NEAR_EXPONENT = {"angle_squared": np.square, "tan_squared": lambda angle: np.tan(angle) ** 2, "tan": np.tan}


class PlaneOfIncidence(NamedTuple):
    """The directions in the plane of incidence, from phi_o = 0 over the normal to the mirror azimuth."""

    direction: Int[np.ndarray, " node"]  # place in the `DirectionSet`
    signed_theta: Float[np.ndarray, " node"]  # rad, negative at phi_o = 0, increasing


def plane_of_incidence(theta_o: np.ndarray, phi_o: np.ndarray, directions: DirectionSet) -> PlaneOfIncidence:
    """Return the plane of incidence of a grid."""
    off_pole = theta_o >= SAME_ANGLE
    front = directions.index[:, np.argmin(np.abs(phi_o - MIRROR_AZIMUTH))]
    back = directions.index[off_pole, np.argmin(fold_azimuth(phi_o))]
    signed_theta = np.concatenate([-theta_o[off_pole][::-1], theta_o])
    return PlaneOfIncidence(np.concatenate([back[::-1], front]), signed_theta)


def lobe_peaks(
    plane: PlaneOfIncidence,
    value: Float[np.ndarray, "lane direction"],
    theta_i: Float[np.ndarray, " lane"],
    kind: str = "angle_squared",
) -> Float[np.ndarray, " lane"]:
    """Return the polar angles of lobes' peaks [rad], 0 to pi/2, at the mirror azimuth.

    The peak of the lobe through three nodes round the highest one: of a parabola through their
    logarithms for "angle_squared", of its like for another kind.

    Args:
        plane: The plane of incidence.
        value: Coefficients, or what backgrounds leave of them, at each direction [1/sr].
        theta_i: Angle of incidence [rad].
        kind: Of the lobes; a key of `NEAR_EXPONENT`.

    Numerics:
        0 at normal incidence, by symmetry. The highest node itself where a logarithm does not
        exist or no such lobe with a peak near that node passes through the three; the mirror
        direction where nothing is positive.
    """
    signed, lane = plane.signed_theta, np.arange(len(value))
    last = len(signed) - 1
    curve = value[:, plane.direction]
    ahead = np.where((signed >= 0) & np.isfinite(curve), curve, -np.inf)
    top = ahead.argmax(axis=1)
    # the highest node is the one nearest to the peak; the last one has no neighbour beyond it
    near = np.clip(top, 1, last - 1)[:, None] + np.array([-1, 0, 1])
    theta, three = signed[near], curve[lane[:, None], near]
    lower = (signed[np.maximum(top - 1, 0)] + signed[top]) / 2 - ROUNDING
    upper = (signed[top] + signed[np.minimum(top + 1, last)]) / 2 + ROUNDING
    has_three = np.all(three > 0, axis=1)
    log = np.log(np.where(has_three[:, None], three, 1.0))

    def mismatch(peak):  # 0 where all three lie on log(height) - s(theta - peak) / width
        s = NEAR_EXPONENT[kind](np.abs(theta - peak[:, None]))
        return (log[:, 1] - log[:, 0]) * (s[:, 2] - s[:, 0]) - (log[:, 2] - log[:, 0]) * (s[:, 1] - s[:, 0])

    sign = np.sign(mismatch(lower))
    is_bracket = has_three & (sign * mismatch(upper) < 0)
    for _ in range(BISECTIONS):
        middle = (lower + upper) / 2
        is_left = sign * mismatch(middle) > 0
        lower, upper = np.where(is_left, middle, lower), np.where(is_left, upper, middle)
    peak = np.clip(np.where(is_bracket, (lower + upper) / 2, signed[top]), 0, np.pi / 2)
    return np.where((theta_i < SAME_ANGLE) | ~(ahead[lane, top] > 0), theta_i, peak)


def refine_peaks(
    mean: Float[np.ndarray, "theta_i direction"],
    theta_i: Float[np.ndarray, " theta_i"],
    plane: PlaneOfIncidence,
    directions: DirectionSet,
    kinds: LobeKinds,
    functions: Functions,
) -> Float[np.ndarray, " theta_i"]:
    """Return where the lobe of each incident angle points: theta_o of its peak [rad], at the mirror azimuth.

    First by the mean of the spectra, a parabola through its logarithms. Then every candidate
    background of a search on that mean is taken off, and the peak sought again on the rest: a
    sloping background displaces the maximum of the sum. The least error wins.
    """
    largest = np.abs(mean).max(axis=1, keepdims=True)
    mean = mean / np.where(largest > 0, largest, 1.0)
    first = lobe_peaks(plane, mean, theta_i)
    alpha, exponent = lobe_geometry(first, directions)
    lanes = search_lanes(Pairs(mean, np.zeros_like(mean), alpha, exponent[:, kinds.index]), kinds, functions)

    shape = lanes.lobe.height.shape
    rest, angle = lanes.target.reshape(-1, mean.shape[1]), np.repeat(theta_i, CANDIDATES)
    moved = np.stack([lobe_peaks(plane, rest, angle, LOBE_KINDS[k]) for k in kinds.index], axis=-1)
    _, exponent = lobe_geometry(moved.ravel(), directions)
    exponent = exponent[np.arange(moved.size), np.tile(kinds.index, len(rest))].reshape(*shape, -1)
    again = fit_lanes(lanes.target, lanes.inside, exponent, lanes.lobe[:2], kinds, functions.weight)

    peaks = np.stack([np.broadcast_to(first[:, None, None], shape), moved.reshape(shape)], axis=1)
    best = least(np.stack([lanes.lobe.error, again.error], axis=1))
    return peaks.reshape(len(first), -1)[np.arange(len(first)), best]
