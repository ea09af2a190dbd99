"""Cubic B-splines on uniform knots, for NumPy and JAX arrays alike."""

import numpy as np

from sbrdf_jax.array_module import array_module

DEGREE = 3


def spline_weights(position, count: int):
    """Return the values of all B-splines of a clamped, uniform knot vector on [0, 1].

    De Boor's recursion over all functions at once: they are few, and on the first axis until the end, so that
    NumPy runs along the places. The weights are not negative and sum to 1; the first and the last function are 1
    at the ends.

    Args:
        position: Where [...], 0 to 1; what lies beyond is clamped.
        count: Number of functions, 1 or more; below 4 the degree is count - 1.

    Returns:
        Weights [..., count].
    """
    xp, degree = array_module(position), min(DEGREE, count - 1)
    knots = np.concatenate([np.zeros(degree), np.linspace(0, 1, count - degree + 1), np.ones(degree)])
    x = xp.clip(position, 0.0, 1.0)[None]
    shape = (-1,) + (1,) * (x.ndim - 1)
    lower, upper = knots[:-1].copy(), knots[1:].copy()
    upper[count - 1] = 2.0  # the last interval holds its end; those after it are empty
    inside = (knots[1:] > knots[:-1]).reshape(shape)
    dtype = x.dtype
    lower, upper = (np.asarray(a, dtype).reshape(shape) for a in (lower, upper))
    weight = xp.where((x >= lower) & (x < upper) & inside, np.ones((), dtype), np.zeros((), dtype))
    for k in range(1, degree + 1):
        width = knots[k:] - knots[:-k]
        slope = np.divide(1.0, width, out=np.zeros_like(width), where=width > 0)
        rising, falling = (np.asarray(a, dtype).reshape(shape) for a in (slope[:-1], slope[1:]))
        start, end = (np.asarray(a, dtype).reshape(shape) for a in (knots[: -k - 1], knots[k + 1 :]))
        weight = (x - start) * rising * weight[:-1] + (end - x) * falling * weight[1:]
    return xp.moveaxis(weight, 0, -1).copy()  # in NumPy's usual order, which decides how products with it round
