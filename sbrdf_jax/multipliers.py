"""Non-negative least squares from the side of its multipliers; knows nothing of BRDFs.

At the answer A'A x = A'b + w with w >= 0 and x w = 0. Where A'A has an inverse K, shared by
all lanes and all right-hand sides of one geometry, x = K (A'b + w), and w minimises
1/2 w'K w + w'K A'b over w >= 0: the same kind of problem, but only in the unknowns that end
at their bound in some lane. Where these are few, it is a small dense one. What is found is
a start, as good as rounding allows; `nnls` certifies and finishes it.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg.lapack
from jaxtyping import Array, Bool, Float, Int

from sbrdf_jax.nnls import DenseNormal, NormalOperator, advance_newton, begin_newton, scale_of
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
SMALLEST_SIZE = 64  # of a round's problem; others are filled up to a few sizes, so that few programs are compiled
SMALLEST_BATCH = 8  # lanes of a round, likewise
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
        self.known, self.image, self.bound = known, image, bound
        self.multiplier = np.zeros(image.shape)
        self.value = image.copy()
        self.num_steps = np.zeros(image.shape[1], int)

    def run(self, lanes: np.ndarray, tolerance: float) -> np.ndarray:
        """Solve some lanes on the present set, then correct it; return those that it was too small for."""
        index = np.flatnonzero(self.bound)
        size = min(_next_size(len(index), SMALLEST_SIZE), len(self.bound))
        batch = min(_next_size(len(lanes), SMALLEST_BATCH), self.image.shape[1])
        place = np.concatenate([index, np.zeros(size - len(index), int)])
        spare = ((0, 0), (0, batch - len(lanes)))
        found, value, negative, steps = jax.device_get(
            _solve_multipliers(
                self.known,
                np.pad(self.image[:, lanes], spare),
                place,
                np.arange(size) < len(index),
                np.pad(self.multiplier[np.ix_(place, lanes)], spare),
                np.asarray(tolerance),
                dtype="float32" if tolerance >= SINGLE_PRECISION else "float64",
            )
        )
        found, negative = found[: len(index), : len(lanes)], negative[:, : len(lanes)]
        self.multiplier[:, lanes] = 0.0
        self.multiplier[np.ix_(index, lanes)] = found
        self.value[:, lanes] = value[:, : len(lanes)]
        self.num_steps[lanes] += steps[: len(lanes)]
        self.bound = negative.any(axis=1)
        self.bound[index] |= (found > 0).any(axis=1)
        return lanes[negative.any(axis=0)]


def _next_size(count: int, smallest: int) -> int:
    """The next of s, 1.5 s, 2 s, 3 s, 4 s, 6 s, ..."""
    power = smallest * 2 ** math.ceil(math.log2(max(count, smallest) / smallest))
    return 3 * power // 4 if count <= 3 * power // 4 and power > smallest else power


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


@functools.partial(jax.jit, static_argnames="dtype")
def _solve_multipliers(
    known: InverseNormal,
    image: Float[Array, "unknown lane"],
    place: Int[Array, " bound"],
    real: Bool[Array, " bound"],
    start: Float[Array, "bound lane"],
    tolerance: Float[Array, ""],
    *,
    dtype: str,
):
    """Minimise 1/2 w'K w + w'K A'b over w >= 0 in the unknowns `place`, those that are `real`."""
    rows = known.inverse[place] * real[:, None].astype(known.inverse.dtype)
    matrix = rows[:, place] * real[None, :].astype(rows.dtype) + jnp.diag(1 - real.astype(rows.dtype))
    operator, rhs = DenseNormal(matrix.astype(dtype)), (-image[place] * real[:, None].astype(rows.dtype)).astype(dtype)
    state = begin_newton(operator, rhs, (start * real[:, None].astype(rows.dtype)).astype(dtype))
    state = advance_newton(operator, rhs, state, tolerance.astype(dtype), jnp.asarray(MAX_DUAL_STEPS, jnp.int32))
    found = (jnp.maximum(state.point, 0.0) / scale_of(operator)[:, None]).astype(rows.dtype)
    value = image + rows.T @ found
    inside = jnp.zeros(value.shape[0], bool).at[place].max(real)
    return found, value, (value < -0.1 * tolerance) & ~inside[:, None], state.num_steps
