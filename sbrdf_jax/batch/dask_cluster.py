"""The dask executor: tasks of a dask.distributed scheduler, one that runs or one that is started for this batch.

The only importer of dask, distributed and dask-jobqueue, which are the extra `cluster`. The
scheduler gives a dead worker's material to another; the locks keep what it may start twice apart.
"""

import contextlib
import importlib
from collections.abc import Sequence
from typing import Any

from sbrdf_jax.batch.attempt import attempt, give_up
from sbrdf_jax.batch.library import Material
from sbrdf_jax.batch.local import SECONDS_BETWEEN_TRIES, Watcher
from sbrdf_jax.batch.memory import Memory
from sbrdf_jax.batch.options import ExecutorOptions
from sbrdf_jax.batch.states import Outcome
from sbrdf_jax.batch.worker import Work
from sbrdf_jax.errors import UserError

SECONDS_TO_ANSWER = SECONDS_TO_RESTART = 10
JOBQUEUE = {
    "slurm": "SLURMCluster",
    "pbs": "PBSCluster",
    "lsf": "LSFCluster",
    "sge": "SGECluster",
    "moab": "MoabCluster",
    "oar": "OARCluster",
    "htcondor": "HTCondorCluster",
}


def run_dask(
    materials: Sequence[Material],
    work: Work,
    workers: int,
    environment: dict[str, str],
    options: ExecutorOptions,
    watcher: Watcher,
) -> None:
    """Bring every material to its result or its failure.

    Args:
        materials: Those that are not done.
        work: What a worker does.
        workers: At most so many, where they are started for this batch.
        environment: Of such workers.
        options: Of the executor.
        watcher: Told of every end.

    Raises:
        UserError: dask is not installed, or no scheduler answers.
    """
    distributed = _import("distributed")
    dask = _import("dask")
    with dask.config.set({"distributed.scheduler.allowed-failures": options.tries - 1}):
        cluster = None if options.dask.address else _start_cluster(workers, environment, options)
        try:
            client = _connect(distributed, cluster or options.dask.address)
            with client:
                _run(distributed, client, materials, work, watcher)
                if cluster is not None and options.dask.cluster == "local":
                    _wait_for_restarts(client, workers)
        finally:
            if cluster is not None:
                cluster.close()


def _wait_for_restarts(client: Any, workers: int) -> None:
    """Wait until workers that died are there again: dask cannot close one that is just being started."""
    with contextlib.suppress(TimeoutError):  # then one does not start at all
        client.wait_for_workers(workers, timeout=SECONDS_TO_RESTART)


def _run(distributed: Any, client: Any, materials: Sequence[Material], work: Work, watcher: Watcher) -> None:
    """Run all side by side; then those whose workers died, one by one.

    The scheduler blames a death on all that waits at the worker: alone, a material is to blame for its own.
    """
    futures = {client.submit(attempt_at_worker, material, work, pure=False): material for material in materials}
    queue, suspects = distributed.as_completed(futures), []
    for future in queue:
        material = futures.pop(future)
        try:
            outcome = future.result()
        except distributed.KilledWorker:
            suspects.append(material)
            continue
        if outcome is None:  # another batch is at it
            again = client.submit(attempt_at_worker, material, work, SECONDS_BETWEEN_TRIES, pure=False)
            futures[again] = material
            queue.add(again)
        else:
            watcher.ended(outcome)
    for material in suspects:
        watcher.ended(_run_alone(distributed, client, material, work))


def _run_alone(distributed: Any, client: Any, material: Material, work: Work) -> Outcome:
    outcome, delay = None, 0.0
    while outcome is None:
        try:
            outcome = client.submit(attempt_at_worker, material, work, delay, pure=False).result()
        except distributed.KilledWorker as error:
            outcome = give_up(material, f"its worker died: {' '.join(str(error).split())[:120]}", Memory())
        delay = SECONDS_BETWEEN_TRIES
    return outcome


def attempt_at_worker(material: Material, work: Work, delay: float = 0.0) -> Outcome | None:
    """What a worker of dask does; in a thread of it."""
    import time

    time.sleep(delay)
    return attempt(material, work.compute, Memory(), retry_failed=work.retry_failed)


def _start_cluster(workers: int, environment: dict[str, str], options: ExecutorOptions) -> Any:
    """Start a scheduler here, and workers of one core for each thread."""
    wanted = options.dask
    threads = int(environment["NPROC"])
    if wanted.cluster == "local":
        cluster = _import("distributed").LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=wanted.memory,
            env=environment,
            dashboard_address=None,
        )
        return cluster
    make = getattr(_import("dask_jobqueue"), JOBQUEUE[wanted.cluster])
    settings = {"queue": wanted.queue, "walltime": wanted.walltime}
    exports = [f"export {name}={value}" for name, value in environment.items()]
    cluster = make(
        cores=threads,
        processes=1,
        worker_extra_args=["--nthreads", "1"],  # one material at a time, in so many threads
        memory=wanted.memory,
        job_script_prologue=[*wanted.set_up, *exports],
        job_extra_directives=list(wanted.options),
        scheduler_options={"dashboard_address": None},
        **{name: value for name, value in settings.items() if value is not None},
    )
    cluster.adapt(minimum_jobs=1, maximum_jobs=workers)
    return cluster


def _connect(distributed: Any, where: Any) -> Any:
    try:
        return distributed.Client(where, timeout=SECONDS_TO_ANSWER)
    except (OSError, ValueError) as error:
        found = f"executor.dask.address: found {where!r}, which does not answer ({' '.join(str(error).split())[:120]})"
        raise UserError(f"{found}; expected the address of a scheduler") from None


def _import(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        raise UserError(
            f"executor.kind: found dask, but the package {name} is not installed; expected the extra `cluster`"
        ) from None
