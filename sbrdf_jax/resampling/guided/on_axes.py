"""Functions of two axes of directions, called in blocks of few shapes for those combinations that are needed."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

ROWS, COLUMNS = 16, 32  # of theta_o and of phi_o in one call: one shape, one compilation


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
    rows, columns = np.flatnonzero(needed.any(axis=1)), np.flatnonzero(needed.any(axis=0))
    found = None
    for some in _blocks(rows, ROWS):
        for others in _blocks(columns, COLUMNS):
            block = np.ix_(some, others)
            parts = function(theta_o[some], phi_o[others], *(a[block] for a in by_direction))
            if found is None:
                found = tuple(np.empty((*needed.shape, *np.shape(part)[2:])) for part in parts)
            for whole, part in zip(found, parts, strict=True):
                whole[block] = np.asarray(part)
    assert found is not None
    return tuple(whole[needed] for whole in found)


def _blocks(index: np.ndarray, size: int) -> np.ndarray:
    """Return indices as rows of one size; the last one is filled by its last index."""
    return np.pad(index, (0, -len(index) % size), mode="edge").reshape(-1, size)
