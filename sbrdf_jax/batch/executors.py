"""Who runs the materials: each executor takes those that wait, the work, and a watcher to report to."""

import os
from collections.abc import Sequence

from sbrdf_jax.batch.attempt import compute_material
from sbrdf_jax.batch.library import Material
from sbrdf_jax.batch.local import Watcher, run_local
from sbrdf_jax.batch.options import ExecutorOptions
from sbrdf_jax.batch.worker import Work
from sbrdf_jax.runtime import usable_cores, worker_environment


def execute(options: ExecutorOptions, materials: Sequence[Material], watcher: Watcher, retry_failed: bool) -> None:
    """Bring every material to its result or its failure, by processes of this machine or by dask.

    Raises:
        UserError: The executor is not installed or does not answer.
    """
    if not materials:
        return
    work = Work(compute_material, retry_failed)
    workers, threads = divide_cores(options, len(materials))
    environment = worker_environment(threads, options.compile_cache)
    if options.kind == "dask":
        from sbrdf_jax.batch.dask_cluster import run_dask

        run_dask(materials, work, workers, environment, options, watcher)
    else:
        os.environ.update(environment)  # which workers inherit
        run_local(materials, work, workers, options.tries, watcher)


def divide_cores(options: ExecutorOptions, materials: int) -> tuple[int, int]:
    """Return how many workers, and threads of each, fill the cores that this process may use, and no more."""
    cores = usable_cores()
    threads = 1 if options.threads == "auto" else options.threads
    workers = max(1, cores // threads) if options.workers == "auto" else options.workers
    workers = min(workers, materials)
    return workers, max(1, cores // workers) if options.threads == "auto" else threads
