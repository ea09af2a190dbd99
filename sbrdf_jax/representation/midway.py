"""What a field may be midway between two incident angles that its grid knows: the best guess from the rows around.

SciPy's interpolation and images take half a second to import, and few runs need them: functions import them.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sbrdf_jax.angles import GRAZING, SAME_ANGLE
from sbrdf_jax.grid import midpoints
from sbrdf_jax.representation.target import azimuth_twins, node_errors

EARLIER = 0.2  # of what a row adds midway may the next one add, though it happens to add less
SMOOTH = 1e-3  # of a logarithm: what is as even as that is even
DOUBT = 2.0  # squares of what contradicts reciprocity count so much, of what it would mend
NEIGHBOURS = 3  # azimuths over which the two are compared


class Rows(NamedTuple):
    """A field at incident angles."""

    theta_i: Float[np.ndarray, " i"]  # rad, equidistant
    theta_o: Float[np.ndarray, " o"]  # rad, 0 to pi / 2
    phi_o: Float[np.ndarray, " p"]  # rad, 0 to pi
    logarithm: Float[np.ndarray, "i o p wavelength"]  # log(1/sr)
    usable: Bool[np.ndarray, " i"]  # which incident angles hold values; the first and the last do


def between_incident_angles(
    known: Rows,
) -> tuple[Float[np.ndarray, " at_o"], Float[np.ndarray, " at_p"], Float[np.ndarray, "middle at_o at_p wavelength"]]:
    """Return theta_o and phi_o [rad], and the field there [1/sr] midway between incident angles.

    On one path theta_o stays, as does what is broad: a cubic spline through logarithms. On the other it moves with
    theta_i, so that a peak that moves with its mirror direction stays one peak: polynomials through up to six
    logarithms. Of the two, the one that is smoother around a direction counts most. By Helmholtz reciprocity a row
    tells the value at its own angle of all others too: it mends the guess, as far as the rows agree on it.
    """
    from scipy.interpolate import CubicSpline, PchipInterpolator

    theta_i, theta_o, phi_o, logarithm, usable = known
    step, middle, number = np.diff(theta_i).mean(), midpoints(theta_i), len(theta_i)
    rows = _on_nodes(theta_i[usable], theta_o)
    inner = theta_o[theta_o + step <= theta_o[-1] + SAME_ANGLE] + step / 2  # both paths meet nodes there
    told = np.isin(_on_nodes(middle, theta_o), theta_o)  # elsewhere a row is interpolated, and tells less
    more = rows if told.any() else theta_o[[0, -1]]
    at_o = np.unique(_on_nodes(np.concatenate([inner, theta_o[[0, -1]], more]), theta_o))
    if theta_i[0] < SAME_ANGLE:  # beyond the normal is the other side, seen from behind
        logarithm = np.concatenate([logarithm[2:0:-1, :, ::-1], logarithm])
        usable = np.concatenate([usable[2:0:-1], usable])
    along = PchipInterpolator(theta_o, logarithm, axis=1)
    value = _smoother_path(along, usable, number, at_o, step)

    def at(angle: np.ndarray) -> np.ndarray:
        return along(angle)[-number:][usable[-number:]]

    if told.any():
        value[told] += _reciprocal_offset(rows, middle[told], at_o, at(rows), at(middle[told]), value[told])
    at_phi = np.sort(np.concatenate([phi_o, midpoints(phi_o)]))
    value = CubicSpline(phi_o, value, axis=2, bc_type="clamped")(at_phi)  # even on both sides
    most = logarithm[-number:].max(axis=(1, 2), keepdims=True)
    value = np.minimum(value, np.maximum(most[:-1], most[1:]))  # splines overshoot where a field falls to 0
    return at_o, at_phi, np.exp(value)


def left_out_error(known: Rows) -> Float[np.ndarray, " i"]:
    """Return how far off every second incident angle is, guessed from the others alone: eta of eq. (18); nan else.

    The step is twice as wide there as that of `between_incident_angles`, so that it is an upper limit.
    """
    theta_i, theta_o, phi_o, logarithm, usable = known
    error = np.full(len(theta_i), np.nan)
    if len(theta_i) < 5 or not usable[::2].all():
        return error
    every_second = known._replace(theta_i=theta_i[::2], logarithm=logarithm[::2], usable=usable[::2])
    at_o, _, guess = between_incident_angles(every_second)
    _, nodes, places = np.intersect1d(theta_o, at_o, return_indices=True)
    left = np.arange(1, 2 * len(guess), 2)
    found, wanted = guess[:, places][:, :, ::2], np.exp(logarithm[left][:, nodes])  # midpoints of phi_o lie between
    error[left] = node_errors(found, wanted, azimuth_twins(phi_o))
    error[~usable] = np.nan
    return error


def _smoother_path(along, usable, number: int, theta_o, step: float) -> Float[np.ndarray, "middle o p wavelength"]:
    """Return logarithms midway between the last `number` rows, 0 beside one that is not usable, where none counts.

    Args:
        along: Rows by theta_o.
        usable: Which rows hold values.
        number: How many of them are on this side of the normal.
        theta_o: Where to.
        step: Between incident angles [rad].
    """
    from scipy.interpolate import CubicSpline
    from scipy.ndimage import maximum_filter1d

    above = np.arange(len(usable) - number + 1, len(usable))  # the row after each midway one
    stay = CubicSpline(np.flatnonzero(usable), along(theta_o)[usable])(above - 0.5)
    _, rough = _along_path(along, usable, above, theta_o, 0.0, along.x[-1])
    move, uneven = _along_path(along, usable, above, theta_o, step, GRAZING)
    size = 1 + 2 * round(step / np.diff(along.x).mean())
    rough, uneven = (maximum_filter1d(np.nan_to_num(error), size, axis=1) + SMOOTH for error in (rough, uneven))
    share = np.where(np.isfinite(move), 1 / (1 + (uneven / rough) ** 4), 0.0)
    return np.nan_to_num(stay + share * (np.nan_to_num(move) - stay))


def _reciprocal_offset(rows, middle, theta_o, at_rows, told, guess) -> Float[np.ndarray, "middle o p wavelength"]:
    """Return what is to be added to a guess so that it agrees with reciprocity, as far as the rows do.

    Args:
        rows: Incident angles that are known; all of them are in `theta_o`.
        middle: Those of the guess.
        theta_o: Outgoing angles of the guess.
        at_rows: [row, theta_o of a row, ...] logarithms.
        told: [row, theta_o of the middle, ...] logarithms, which are those of exchanged angles too.
        guess: [middle, theta_o, ...] logarithms.
    """
    from scipy.ndimage import uniform_filter1d

    offset = np.swapaxes(told, 0, 1) - guess[:, np.searchsorted(theta_o, rows)]
    broken = np.square(at_rows - np.swapaxes(at_rows, 0, 1)).mean(axis=-1)
    itself = np.eye(len(rows), dtype=bool)  # which breaks nothing, and says nothing
    beside = np.searchsorted(rows, middle)[:, None] - np.arange(len(rows))
    counts = ((beside == 0) | (beside == 1))[:, :, None] & ~itself  # [middle, row next to it, row that tells]
    broken = np.einsum("mko,kop->mop", counts / counts.sum(axis=1, keepdims=True), broken)
    broken, wrong = (
        uniform_filter1d(square, NEIGHBOURS, axis=2, mode="nearest") for square in (broken, np.square(offset).mean(-1))
    )
    share = np.maximum(1 - DOUBT * broken / np.where(wrong > 0, wrong, 1.0), 0.0)
    hats = np.stack([np.interp(theta_o, rows, hat, left=0.0, right=0.0) for hat in itself.astype(float)], axis=1)
    trust = np.einsum("or,mrp->mop", hats, share)
    trust[:, np.isin(theta_o, rows)] = 1.0  # told; elsewhere guessed from what is told on both sides, and doubted again
    return trust[..., None] * np.einsum("or,mrpw->mopw", hats, share[..., None] * offset)


def _on_nodes(angle: Float[np.ndarray, " angle"], nodes: Float[np.ndarray, " node"]) -> Float[np.ndarray, " angle"]:
    """Return angles, each that is a node's but for rounding as the node's."""
    nearest = nodes[np.abs(angle[:, None] - nodes).argmin(axis=1)]
    return np.where(np.abs(angle - nearest) < SAME_ANGLE, nearest, angle)


def _along_path(along, usable, above, theta_o, step: float, last: float) -> tuple[np.ndarray, np.ndarray]:
    """Return values midway between rows and how far they may be off: what the last of six rows adds, or a share of
    what the rows before it added; nan where none is.

    Args:
        along: Rows by theta_o.
        usable: Which rows hold values.
        above: The row after each midway one.
        theta_o: Where the path is midway.
        step: By how much theta_o moves from row to row.
        last: Of theta_o on a path.
    """
    six = []
    for number in range(-3, 3):
        at, row = theta_o + (number + 0.5) * step, above + number
        held = np.clip(row, 0, len(usable) - 1)
        value = along(np.clip(at, 0.0, last))[held]
        value[:, (at < -SAME_ANGLE) | (at > last + SAME_ANGLE)] = np.nan
        value[(row != held) | ~usable[held]] = np.nan
        six.append(value)
    values = np.stack(six)
    exists, filled = np.isfinite(values), np.nan_to_num(values)
    value, error = (values[2] + values[3]) / 2, np.abs(values[3] - values[2])
    for first, end in ((2, 5), (1, 4), (1, 5), (0, 4), (2, 6), (0, 5), (1, 6), (0, 6)):  # the last that exist are best
        more = exists[first:end].all(axis=0)
        better = np.tensordot(_midway_weights(first, end), filled[first:end], 1)
        error = np.where(more, np.maximum(np.abs(better - value), EARLIER * error), error)
        value = np.where(more, better, value)
    return value, error.mean(axis=-1, keepdims=True)


@functools.cache
def _midway_weights(first: int, end: int) -> np.ndarray:
    """Return the weights by which a polynomial through those of six equidistant values is read midway of the six."""
    position = np.arange(first, end) - 2.5
    return np.linalg.solve(np.vander(position, increasing=True).T, np.eye(len(position))[0])
