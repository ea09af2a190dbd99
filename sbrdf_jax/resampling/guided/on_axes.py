"""Functions of two axes of directions, called in blocks for those combinations that are needed."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

MOST_AT_A_TIME = 2304  # directions, 48 x 48 of the albedo's quadrature; more leave the processor's cache


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
    found = []
    for some in np.array_split(rows, -(-len(rows) * len(columns) // MOST_AT_A_TIME)):
        block = np.ix_(some, columns)
        parts = function(theta_o[some], phi_o[columns], *(a[block] for a in by_direction))
        found.append([np.asarray(part)[needed[block]] for part in parts])
    return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))
