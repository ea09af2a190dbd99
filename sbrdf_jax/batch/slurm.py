"""The slurm executor: a job array, each task one shard of the library, and a last job that renews the index."""

import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from sbrdf_jax.batch.library import Library, Material, take_shard
from sbrdf_jax.errors import UserError
from sbrdf_jax.files import whole_file

PROGRAM = (sys.executable, "-m", "sbrdf_jax.batch")
TEMPLATE = Path(__file__).with_name("slurm_array.sh")
SCRIPT = "slurm_array.sh"


def submit(library: Library, pending: Sequence[Material], overrides: Sequence[str], *, retry_failed: bool) -> str:
    """Write the script of a job array into the folder of the results, and submit it.

    Args:
        library: The library.
        pending: Materials that are not done; shards without one get no task.
        overrides: Of the command line.
        retry_failed: Whether those that failed are tried again.

    Returns:
        What was submitted, in a line.

    Raises:
        UserError: There is no Slurm here, or it refuses the job.
    """
    options = library.executor.slurm
    shards = min(options.shards, len(library.materials))
    names = {material.name for material in pending}
    tasks = [k for k in range(1, shards + 1) if names & {m.name for m in take_shard(library.materials, k, shards)}]
    workers, threads = (
        1 if count == "auto" else count for count in (library.executor.workers, library.executor.threads)
    )
    sizes = ["executor.kind=local", f"executor.workers={workers}", f"executor.threads={threads}"]
    command = [*PROGRAM, os.path.abspath(library.path), *overrides, *sizes]
    script = library.folder / SCRIPT
    with whole_file(script) as temporary:
        temporary.write_text(
            TEMPLATE.read_text(encoding="utf-8").format(
                tasks=",".join(map(str, tasks)),
                cores=workers * threads,
                directory=shlex.quote(os.getcwd()),
                output=shlex.quote(str(library.folder.absolute() / "slurm-%A_%a.out")),
                options="\n".join(f"#SBATCH {option}" for option in options.options),
                set_up="\n".join(options.set_up),
                command=shlex.join([*command, *(["--retry-failed"] if retry_failed else [])]),
                shards=shards,
            ),
            encoding="utf-8",
        )
    job = _sbatch([str(script)])
    log = str(library.folder.absolute() / "slurm-index.out")
    last = ["--job-name=sbrdf-index", f"--dependency=afterany:{job}", f"--output={log}", *options.options]
    status = "\n".join([*options.set_up, shlex.join([*command, "--status"])])
    _sbatch([*last, f"--wrap={status}"])
    return (
        f"submitted job {job}: {len(tasks)} tasks for {len(pending)} materials, see {library.folder}/slurm-{job}_*.out"
    )


def _sbatch(words: Sequence[str]) -> str:
    """Submit a job and return its number."""
    try:
        done = subprocess.run(["sbatch", "--parsable", *words], capture_output=True, text=True)
    except FileNotFoundError:
        raise UserError(
            "executor.kind: found slurm, but no sbatch on PATH; expected a node of a Slurm cluster"
        ) from None
    if done.returncode:
        reason = " ".join(done.stderr.split())
        raise UserError(
            f"executor.kind: found slurm, but sbatch refuses the job ({reason}); expected options that it takes"
        )
    return done.stdout.strip().split(";")[0]
