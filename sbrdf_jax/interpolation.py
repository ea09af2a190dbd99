"""Interpolation over wavelengths: a C1 cubic through uneven nodes, as a matrix of weights."""

import numpy as np
from jaxtyping import Bool, Float, Int

from sbrdf_jax.array_module import AnyArray, array_module


def spectral_weights(
    wavelength_nm: Float[AnyArray, " query"], nodes_nm: Float[AnyArray, " wavelength"]
) -> Float[AnyArray, "query wavelength"]:
    """Weights of C1 cubic (Hermite) interpolation over increasing, possibly uneven, wavelengths.

    Slopes are those of the parabola through three neighbouring nodes, so each interval uses
    four nodes, the nodes are met exactly and parabolas are reproduced. Two nodes give a
    straight line, one node a constant. Weights beyond the ends continue the last cubic.
    """
    xp, count = array_module(wavelength_nm, nodes_nm), nodes_nm.shape[0]
    if count == 1:
        return xp.ones((wavelength_nm.shape[0], 1), nodes_nm.dtype)
    lower = xp.clip(xp.searchsorted(nodes_nm, wavelength_nm, side="right") - 1, 0, count - 2)
    width = nodes_nm[lower + 1] - nodes_nm[lower]
    x = (wavelength_nm - nodes_nm[lower]) / width
    unit, slope = xp.eye(count, dtype=nodes_nm.dtype), slope_matrix(nodes_nm)
    value_low, value_high = (1 + 2 * x) * (1 - x) ** 2, x**2 * (3 - 2 * x)
    slope_low, slope_high = width * x * (1 - x) ** 2, width * x**2 * (x - 1)
    return (
        value_low[:, None] * unit[lower]
        + value_high[:, None] * unit[lower + 1]
        + slope_low[:, None] * slope[lower]
        + slope_high[:, None] * slope[lower + 1]
    )


def neighbours(
    wavelength_nm: Float[np.ndarray, " query"], nodes_nm: Float[np.ndarray, " wavelength"]
) -> Int[np.ndarray, " neighbour"]:
    """Indices, increasing, of the nodes that `spectral_weights` needs: two on each side, as far as there are.

    At these wavelengths alone the weights of the queries are the same as among all nodes; at
    other wavelengths they need not be, because the neighbours of two queries are joined.
    """
    count = len(nodes_nm)
    lower = np.clip(np.searchsorted(nodes_nm, wavelength_nm, side="right") - 1, 0, max(count - 2, 0))
    around = np.unique(lower[:, None] + np.arange(-1, 3))
    return around[(around >= 0) & (around < count)]


def outside_range(
    wavelength_nm: Float[AnyArray, " query"], measured_nm: Float[AnyArray, " wavelength"]
) -> Bool[AnyArray, " query"]:
    """True where a wavelength lies outside the measured range, but for rounding, or is NaN."""
    slack = 1e-9 * measured_nm[-1]
    return ~((wavelength_nm >= measured_nm[0] - slack) & (wavelength_nm <= measured_nm[-1] + slack))


def slope_matrix(nodes: Float[AnyArray, " node"]) -> Float[AnyArray, "node node"]:
    """Matrix from values at uneven nodes to slopes there, by the parabola through three neighbouring nodes."""
    xp, count = array_module(nodes), nodes.shape[0]
    if count == 2:
        row = xp.stack([-1.0 / (nodes[1] - nodes[0]), 1.0 / (nodes[1] - nodes[0])])
        return xp.stack([row, row])
    first = np.clip(np.arange(count) - 1, 0, count - 3)
    at, (a, b, c) = nodes, (nodes[first + k] for k in range(3))
    unit = xp.eye(count, dtype=nodes.dtype)
    weight_a = (2 * at - b - c) / ((a - b) * (a - c))
    weight_b = (2 * at - a - c) / ((b - a) * (b - c))
    weight_c = (2 * at - a - b) / ((c - a) * (c - b))
    return weight_a[:, None] * unit[first] + weight_b[:, None] * unit[first + 1] + weight_c[:, None] * unit[first + 2]
