"""A worker process: it takes one material after the other from its parent, and ends with it."""

import dataclasses
import multiprocessing
import os
import signal
import threading
from multiprocessing.connection import Connection

from sbrdf_jax.batch.attempt import Compute, attempt
from sbrdf_jax.batch.memory import Memory
from sbrdf_jax.stopping import TERMINATED, do_last_acts


@dataclasses.dataclass(frozen=True)
class Work:
    """What every worker does with a material."""

    compute: Compute
    retry_failed: bool = False


def serve(connection: Connection, work: Work) -> None:
    """Say that this process is ready, then answer each material with its outcome, until there is None; end it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal sends it to the parent too, which decides
    signal.signal(signal.SIGTERM, lambda *_: _end())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    memory = Memory()
    try:
        connection.send(None)
        while (material := connection.recv()) is not None:
            connection.send(attempt(material, work.compute, memory, retry_failed=work.retry_failed))
    except (EOFError, BrokenPipeError):  # the parent is gone
        pass
    os._exit(0)  # all is written; JAX would take its time to end


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    _end()


def _end() -> None:
    do_last_acts("terminated")
    os._exit(TERMINATED)
