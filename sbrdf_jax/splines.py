"""Cubic B-splines on uniform knots, for NumPy and JAX arrays alike."""

import functools

import numpy as np

from sbrdf_jax.array_module import array_module

DEGREE = 3


def spline_weights(position, count: int):
    """Return the values of all B-splines of a clamped, uniform knot vector on [0, 1].

    De Boor's recursion over the few functions that are not 0 in the interval of each place. The weights are not
    negative and sum to 1; the first and the last function are 1 at the ends.

    Args:
        position: Where [...], 0 to 1; what lies beyond is clamped.
        count: Number of functions, 1 or more; below 4 the degree is count - 1.

    Returns:
        Weights [..., count].
    """
    xp, degree = array_module(position), min(DEGREE, count - 1)
    starts, around, slopes = _tables(count)
    x = xp.clip(position, 0.0, 1.0)
    interval = xp.clip(xp.searchsorted(np.asarray(starts, x.dtype), x, side="right") - 1, 0, len(starts) - 1)
    knots = xp.take(np.asarray(around, x.dtype), interval, axis=1)
    weight = xp.ones((1, *x.shape), x.dtype)
    for k, slope in enumerate(slopes, 1):
        share = xp.take(np.asarray(slope, x.dtype), interval, axis=1)
        rising = (x[None] - knots[degree - k : degree]) * share * weight
        falling = (knots[degree : degree + k] - x[None]) * share * weight
        weight = xp.concatenate([falling[:1], rising[:-1] + falling[1:], rising[-1:]])
    if xp is np:
        found = np.zeros(x.size * count, x.dtype)
        first = np.arange(x.size) * count + interval.reshape(-1)
        for k, values in enumerate(weight):
            found[first + k] = values.reshape(-1)
        return found.reshape(*x.shape, count)
    functions = np.arange(count, dtype=np.int32) - np.arange(degree + 1, dtype=np.int32)[:, None]
    return sum(
        xp.where(interval[..., None] == functions[k].reshape((1,) * x.ndim + (-1,)), weight[k][..., None], 0.0)
        for k in range(degree + 1)
    )


@functools.cache
def _tables(count: int) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Starts of the intervals; the knots up to each start and after it [2 degree, interval]; 1 over their distances."""
    degree = min(DEGREE, count - 1)
    knots = np.concatenate([np.zeros(degree), np.linspace(0, 1, count - degree + 1), np.ones(degree)])
    start = np.arange(degree, count)
    around = knots[start + np.arange(1 - degree, degree + 1)[:, None]]
    slopes = [1 / (around[degree : degree + k] - around[degree - k : degree]) for k in range(1, degree + 1)]
    return knots[start], around, slopes
