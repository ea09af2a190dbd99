"""Non-negative least squares from the side of its multipliers; knows nothing of BRDFs.

At the answer A'A x = A'b + w with w >= 0 and x w = 0. Where A'A has an inverse K, shared by
all lanes and all right-hand sides of one geometry, x = K (A'b + w), and w minimises
1/2 w'K w + w'K A'b over w >= 0: the same kind of problem, but only in the unknowns that end
at their bound in some lane. Where these are few, it is a small dense one. What is found is
a start, as good as rounding allows; `nnls` certifies and finishes it.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg.lapack
from jaxtyping import Array, Float, Int

from sbrdf_jax.nnls import FACE_ACCURACY, NormalOperator, scale_of
from sbrdf_jax.records import pytree

MAX_UNKNOWNS = 6_000  # the inverse takes 8 bytes for each pair of unknowns: 290 MB
SMALLEST_RCOND = 1e-10  # below this the inverse is mostly rounding
COLUMNS = 512  # of the matrix, made at once
SEARCH_TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4)  # while the set of unknowns at their bound is sought, in a few lanes
FIRST_TOLERANCE = 1e-6  # of the first round in all lanes
SINGLE_PRECISION = 1e-6  # rounds to this or a looser tolerance run in float32
SEARCH_SPACING = 8  # lanes from one that takes part in the search to the next
MAX_ROUNDS = 10
MAX_DUAL_STEPS = 500
LAST_SHARE = 0.5  # of the tolerance, for the multipliers: x moves a little when it is set to 0 at its bound


@pytree(static=())
class InverseNormal:
    """The inverse of the diagonally scaled A'A: depends on A alone, so it may be kept for every other b."""

    scale: Any  # [unknown] d = sqrt(diag A'A)
    inverse: Any  # [unknown, unknown] of A'A / (d d')


def invert_normal(operator: NormalOperator) -> InverseNormal | None:
    """Invert the diagonally scaled A'A by Cholesky's factors, on the host, in float64.

    Returns:
        The inverse, or None where there are more than `MAX_UNKNOWNS` unknowns or A'A is
        too nearly singular for it: the solver then does without.
    """
    scale = np.asarray(scale_of(operator), np.float64)
    size = len(scale)
    if size > MAX_UNKNOWNS:
        return None
    matrix = np.empty((size, size), order="F")
    for first in range(0, size, COLUMNS):
        start = min(first, max(size - COLUMNS, 0))  # the last block overlaps, so that all are of one shape
        matrix[:, start : start + COLUMNS] = np.asarray(_columns(operator, start, count=min(COLUMNS, size)))
    matrix /= scale[:, None] * scale
    if not np.isfinite(matrix).all():
        return None
    norm = np.abs(matrix).sum(axis=0).max()
    factor, failed = scipy.linalg.lapack.dpotrf(matrix, lower=1, overwrite_a=1)
    if failed or scipy.linalg.lapack.dpocon(factor, norm, uplo="L")[0] < SMALLEST_RCOND:
        return None
    lower, _ = scipy.linalg.lapack.dpotri(factor, lower=1, overwrite_c=1)
    return InverseNormal(jnp.asarray(scale), _symmetric(jnp.asarray(lower)))


@jax.jit
def _symmetric(lower: Float[Array, "unknown unknown"]) -> Float[Array, "unknown unknown"]:
    return jnp.tril(lower) + jnp.tril(lower, -1).T


@functools.partial(jax.jit, static_argnames="count")
def _columns(operator, first, *, count: int):
    diagonal = operator.diagonal()
    place = jnp.arange(len(diagonal))[:, None] == first + jnp.arange(count)[None, :]
    return operator.multiply(place.astype(diagonal.dtype))


def start_from_multipliers(
    operator: NormalOperator,
    rhs: Float[Array, "unknown lane"],
    known: InverseNormal,
    tolerance: float,
) -> tuple[Float[Array, "unknown lane"], Int[np.ndarray, " lane"]]:
    """Solve for the multipliers w, in rounds over a growing exactness and a changing set of unknowns.

    The first set holds the unknowns that the unconstrained answer makes negative and the
    gradient of its positive part holds there; after each round those with w > 0 in some
    lane stay, and those that came out negative join. A few lanes find the set; w of the
    lanes between them starts from theirs, because neighbouring spectra are alike.

    Args:
        operator: A'A, the one that `known` was made of.
        rhs: A'b, a column per lane; a lane that is not finite is taken as 0.
        known: Inverse of A'A.
        tolerance: Relative KKT residual that the start should have.

    Returns:
        x >= 0 with exact zeros where w > 0, and the steps that each lane took.
    """
    image, size, candidate = jax.device_get(_unconstrained(operator, jnp.asarray(rhs), known))
    lanes = image.shape[1]
    few = np.unique(np.linspace(0, lanes - 1, -(-lanes // SEARCH_SPACING) + 1).round().astype(int))
    search = _Search(known, image, candidate[:, few].any(axis=1))
    if len(few) < lanes:
        for aim in SEARCH_TOLERANCES:
            search.run(few, aim)
        search.multiplier = _between(search.multiplier[:, few], few, lanes)
    search.run(np.arange(lanes), FIRST_TOLERANCE)
    left = np.arange(lanes)
    for _ in range(MAX_ROUNDS):
        left = search.run(left, LAST_SHARE * tolerance)
        if not len(left):
            break
    value = np.where(search.multiplier > 0, 0.0, np.maximum(search.value, 0.0))
    return jnp.asarray(value * size / np.asarray(known.scale)[:, None]), search.num_steps


def _between(multiplier: np.ndarray, lanes_known: np.ndarray, lanes: int) -> np.ndarray:
    """Linear interpolation of [unknown, known lane] over the index of the lane."""
    after = np.clip(np.searchsorted(lanes_known, np.arange(lanes)), 1, max(len(lanes_known) - 1, 1))
    width = lanes_known[after] - lanes_known[after - 1]
    share = (np.arange(lanes) - lanes_known[after - 1]) / width
    return multiplier[:, after - 1] * (1 - share) + multiplier[:, after] * share


class _Search:
    """Multipliers and values of all lanes (scaled), and the unknowns that may be at their bound."""

    def __init__(self, known: InverseNormal, image: np.ndarray, bound: np.ndarray):
        self.inverse, self.image, self.bound = np.asarray(known.inverse), image, bound
        self.multiplier = np.zeros(image.shape)
        self.value = image.copy()
        self.num_steps = np.zeros(image.shape[1], int)

    def run(self, lanes: np.ndarray, tolerance: float) -> np.ndarray:
        """Solve some lanes on the present set, then correct it; return those that it was too small for."""
        index = np.flatnonzero(self.bound)
        rows = self.inverse[index]
        dtype = np.float32 if tolerance >= SINGLE_PRECISION else np.float64
        image, start = self.image[np.ix_(index, lanes)], self.multiplier[np.ix_(index, lanes)]
        matrix = np.take(rows, index, axis=1).astype(dtype)
        found, steps = minimise_on_host(matrix, -image.astype(dtype), start.astype(dtype), tolerance)
        value = self.image[:, lanes] + rows.T @ found.astype(float)
        negative = value < -0.1 * tolerance
        negative[index] = False
        self.multiplier[:, lanes] = 0.0
        self.multiplier[np.ix_(index, lanes)] = found
        self.value[:, lanes] = value
        self.num_steps[lanes] += steps
        self.bound = negative.any(axis=1)
        self.bound[index] |= (found > 0).any(axis=1)
        return lanes[negative.any(axis=0)]


def minimise_on_host(
    matrix: np.ndarray, rhs: np.ndarray, start: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Minimise 1/2 w'M w - w'b over w >= 0 by the steps of `nnls.advance_newton`, in NumPy.

    On the host, because sizes change from round to round, and each would be compiled anew;
    a lane that has converged leaves the batch.

    Args:
        matrix: M [unknown, unknown], positive definite.
        rhs: b [unknown, lane].
        start: w [unknown, lane].
        tolerance: Relative KKT residual.

    Returns:
        w, and the steps of each lane.
    """
    answer, num_steps = start.copy(), np.zeros(rhs.shape[1], int)
    scale = np.sqrt(np.diag(matrix))[:, None]
    matrix, rhs = matrix / scale / scale.T, rhs / scale
    size = np.abs(rhs).max(axis=0, initial=0.0)
    lanes = np.flatnonzero((size > 0) & (rhs > 0).any(axis=0))
    answer[:, np.setdiff1d(np.arange(rhs.shape[1]), lanes)] = 0.0
    rhs, size, point = rhs[:, lanes], size[lanes], start[:, lanes] * scale
    gradient = matrix @ point - rhs
    free = (point > 0) | (gradient < 0)
    direction, descent = np.zeros_like(point), np.zeros_like(size)
    returning = np.zeros(len(lanes), bool)
    for _ in range(MAX_DUAL_STEPS):
        inside = np.where(free, gradient, 0)
        worst = np.abs(inside).max(axis=0, initial=0.0)
        below = np.maximum(-point.min(axis=0, initial=0.0), 0)
        pulled = np.maximum(-(gradient - inside).min(axis=0, initial=0.0), 0)
        done = (below <= 0) & (np.maximum(worst, pulled) <= tolerance * size)
        if done.any():
            answer[:, lanes[done]] = point[:, done] / scale
            keep = ~done
            lanes, size, worst, below, pulled = (v[keep] for v in (lanes, size, worst, below, pulled))
            descent, returning = descent[keep], returning[keep]
            point, gradient, direction, free = (v[:, keep] for v in (point, gradient, direction, free))
        if not len(lanes):
            break
        num_steps[lanes] += 1
        enough = (worst <= FACE_ACCURACY * np.maximum(below, pulled)) | (worst <= 0.5 * tolerance * size)
        stop = ~returning & enough
        anew = returning | (stop & (below <= 0))
        returning = stop & (below > 0)
        if anew.any():
            free[:, anew] = (point[:, anew] > 0) | (gradient[:, anew] < 0)
        fresh = np.where(free, -gradient, 0)
        before, descent = descent, np.einsum("ij,ij->j", fresh, fresh)
        weight = np.where(anew | (before <= 0), 0, descent / np.where(before > 0, before, 1)).astype(point.dtype)
        direction *= weight
        direction += fresh
        if returning.any():
            direction[:, returning] = np.maximum(point[:, returning], 0) - point[:, returning]
        image = matrix @ direction
        curvature = np.einsum("ij,ij->j", direction, image)
        length = np.where(returning, 1, descent / np.where(curvature > 0, curvature, np.inf)).astype(point.dtype)
        point += length * direction
        gradient += length * image
        if returning.any():
            point[:, returning] = np.maximum(point[:, returning], 0)
    answer[:, lanes] = np.maximum(point, 0) / scale
    return answer, num_steps


@jax.jit
def _unconstrained(operator, rhs, known: InverseNormal):
    """Return K A'b scaled, for lanes of size 1, the sizes, and which unknowns may have a multiplier."""
    scaled = jnp.where(jnp.all(jnp.isfinite(rhs), axis=0, keepdims=True), rhs, 0.0) / known.scale[:, None]
    size = jnp.max(jnp.abs(scaled), axis=0)
    target = scaled / jnp.where(size > 0, size, 1.0)[None, :]
    image = known.inverse @ target
    clipped = jnp.maximum(image, 0.0)
    gradient = operator.multiply(clipped / known.scale[:, None]) / known.scale[:, None] - target
    return image, size, (image < 0) & (gradient > 0)
