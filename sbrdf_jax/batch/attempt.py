"""One material, whoever runs it: locked, looked at, computed where that is needed, its failure noted.

Every executor calls `attempt`, in a process of its own choice. Nothing heavy is imported before it is needed.
"""

import dataclasses
import threading
import time
import traceback
from collections.abc import Callable

from sbrdf_jax.batch.library import Material
from sbrdf_jax.batch.locks import hold
from sbrdf_jax.batch.memory import Memory
from sbrdf_jax.batch.states import (
    Outcome,
    State,
    look,
    remove_failure,
    remove_leftovers_of,
    write_failure,
)
from sbrdf_jax.errors import UserError

Compute = Callable[[Material], None]  # writes the result

_this_thread = threading.local()


def attempt(material: Material, compute: Compute, memory: Memory, *, retry_failed: bool = False) -> Outcome | None:
    """Bring one material to its result, unless that is done or failed already.

    Args:
        material: The material.
        compute: What computes and writes its result.
        memory: What this process has read so far.
        retry_failed: Whether one that failed before is tried again.

    Returns:
        Where it stands now; None where another process is at it.
    """
    with hold(material.result.parent, material.name) as held:
        if not held:
            return None
        remove_leftovers_of(material)
        outcome = look(material, memory)
        if outcome.state is not State.DONE and (outcome.state is not State.FAILED or retry_failed):
            outcome = _compute(material, compute, memory)
    result = memory.results.get(str(material.result))
    return dataclasses.replace(outcome, result=result, source=memory.sources.get(material.options.input.path))


def give_up(material: Material, reason: str, memory: Memory) -> Outcome:
    """Note that a material failed in a way that its own process could not note."""
    with hold(material.result.parent, material.name) as held:
        if held:
            remove_leftovers_of(material)
            write_failure(material, reason, memory)
    return Outcome(material.name, State.FAILED, reason, computed=True)


def compute_material(material: Material) -> None:
    """Write the result of a material as `sbrdf run` does, with its log beside it.

    What depends on angles alone is kept for the next material of this thread: a process of the local
    executor has one, a worker of dask may have several, and materials of two geometries at a time.
    """
    start = time.perf_counter()
    from sbrdf_jax.formats import read
    from sbrdf_jax.pipeline import prepare
    from sbrdf_jax.resampling.kept import Kept
    from sbrdf_jax.runtime import set_up_jax
    from sbrdf_jax.single_run import open_progress, run_to_file

    set_up_jax()
    if not hasattr(_this_thread, "kept"):
        _this_thread.kept = Kept()
    options = material.options
    with open_progress(material.result, quiet=True) as progress:
        try:
            raw = read(options.input.path, options.input)
            ready = prepare(raw, options, _this_thread.kept)
            run_to_file(raw, ready, options, progress, time.perf_counter() - start, _this_thread.kept)
        except Exception:
            for line in traceback.format_exc().splitlines():
                progress.log(line)
            raise


def _compute(material: Material, compute: Compute, memory: Memory) -> Outcome:
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        compute(material)
        remove_failure(material)
        outcome = look(material, memory)
        if outcome.state is not State.DONE:  # its source was changed meanwhile, or what was written cannot be read
            outcome = dataclasses.replace(outcome, state=State.FAILED)
    except UserError as error:
        outcome = _failed(material, str(error), memory)
    except Exception as error:  # one material's failure is its own: it is noted, and the others go on
        reason = " ".join(str(error).split())[:200]
        outcome = _failed(material, f"unexpected {type(error).__name__}: {reason}; see {material.result}.log", memory)
    return dataclasses.replace(
        outcome, computed=True, seconds=time.perf_counter() - wall, cpu_seconds=time.process_time() - cpu
    )


def _failed(material: Material, reason: str, memory: Memory) -> Outcome:
    write_failure(material, reason, memory)
    return Outcome(material.name, State.FAILED, reason)
