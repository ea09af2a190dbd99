"""Functions of two axes of directions, called in blocks of few shapes for those combinations that are needed."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

BLOCK = 16  # both axes are padded to a multiple; so many rows of theta_o at a time


def on_axes(
    function: Callable[..., tuple[Any, ...]],
    theta_o: Float[np.ndarray, " o"],
    phi_o: Float[np.ndarray, " p"],
    needed: Bool[np.ndarray, "o p"],
    *by_direction: Float[np.ndarray, "o p"],
) -> tuple[np.ndarray, ...]:
    """Return what a function says of the directions that are needed, [direction, ...] each, in the order of the mask.

    Args:
        function: Of theta_o [o], phi_o [p] and arrays [o, p], to a tuple of arrays [o, p, ...].
        theta_o: Polar angles of exitance [rad].
        phi_o: Azimuths of exitance [rad].
        needed: Which combinations; at least one. The function is called for the axes around them.
        by_direction: More arguments, of each direction.
    """
    columns = np.flatnonzero(needed.any(axis=0))
    rows = np.flatnonzero(needed.any(axis=1))
    phi_o = _padded(phi_o[columns])
    blocks = []
    for start in range(0, len(rows), BLOCK):
        some = rows[start : start + BLOCK]
        arrays = (_padded(_padded(a[np.ix_(some, columns)]).T).T for a in by_direction)
        found = function(_padded(theta_o[some]), phi_o, *arrays)
        inside = needed[np.ix_(some, columns)]
        blocks.append([np.asarray(a)[: len(some), : len(columns)][inside] for a in found])
    return tuple(np.concatenate(parts) for parts in zip(*blocks, strict=True))


def _padded(array: np.ndarray) -> np.ndarray:
    """Repeat the last entry of the first axis up to a multiple of the block: few shapes, few compilations."""
    return np.concatenate([array, np.repeat(array[-1:], -len(array) % BLOCK, axis=0)])
