"""How many threads the host's BLAS may take, and the half of a matrix that it leaves out."""

import contextlib
import functools

import numpy as np
from jaxtyping import Float
from threadpoolctl import ThreadpoolController

TILE = 128  # of a matrix that is mirrored: both sides of it stay in the processor's cache


def one_blas_thread() -> contextlib.AbstractContextManager:
    """Hold the host's BLAS to one thread for a while.

    Two that wait for a core that another process holds take ten to forty times longer than one
    that works, and the host's matrices are too small for a second thread to matter.
    """
    return _controller().limit(limits=1, user_api="blas")


@functools.cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


def mirrored(lower: Float[np.ndarray, "row row"]) -> Float[np.ndarray, "row row"]:
    """Return a symmetric matrix of which the lower triangle is given, in place."""
    for start in range(0, len(lower), TILE):
        end = start + TILE
        lower[start:end, end:] = lower[end:, start:end].T
        tile = lower[start:end, start:end]
        tile[:] = np.tril(tile) + np.tril(tile, -1).T
    return lower
