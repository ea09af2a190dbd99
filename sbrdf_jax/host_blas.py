"""How many threads the host's BLAS may take."""

import contextlib
import functools

from threadpoolctl import ThreadpoolController


def one_blas_thread() -> contextlib.AbstractContextManager:
    """Hold the host's BLAS to one thread for a while.

    Two that wait for a core that another process holds take ten to forty times longer than one
    that works, and the host's matrices are too small for a second thread to matter.
    """
    return _controller().limit(limits=1, user_api="blas")


@functools.cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()
