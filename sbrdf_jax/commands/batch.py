"""`sbrdf batch LIBRARY.yaml`: many materials, each to its own result; what is done is never computed again."""

import argparse
import os
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sbrdf_jax.cli import SOME_LANES_FAILED

if TYPE_CHECKING:
    from sbrdf_jax.batch.library import Library, Material
    from sbrdf_jax.batch.memory import Memory
    from sbrdf_jax.batch.states import Outcome
    from sbrdf_jax.progress import Progress

SUMMARY = "Many materials, each to its own result, as a library file says; done ones are skipped."
EXAMPLE = """example:
  sbrdf batch configs/library.yaml --workers 2 resample.method=paper

key.path=value sets a key of the library (base, materials, output_folder, executor) or of every
material's config. The same command goes on where the last one was stopped. The results are
OUTPUT_FOLDER/NAME.h5; index.h5 beside them is a table of all and opens them as one.
Exit codes: 0 done, 2 the library is wrong, 3 some materials or lanes failed (listed)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("library", metavar="LIBRARY.yaml", help="the library file")
    parser.add_argument(
        "overrides", metavar="key.path=value", nargs="*", help="overrides of the library or its configs"
    )
    parser.add_argument("--executor", choices=("local", "slurm", "dask"), help="executor.kind")
    parser.add_argument("--workers", metavar="N", help="executor.workers")
    parser.add_argument("--shard", metavar="K/N", type=parse_shard, help="part K, from 1, of N equal parts only")
    parser.add_argument("--retry-failed", action="store_true", help="try those again that failed")
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--plan", action="store_true", help="print what would be computed, and compute nothing")
    only.add_argument("--status", action="store_true", help="print where each material stands, and renew index.h5")


def parse_shard(text: str) -> tuple[int, int]:
    """Parse K/N, 1 <= K <= N."""
    match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
    if not match or not 1 <= int(match[1]) <= int(match[2]):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected K/N with K from 1 to N")
    return int(match[1]), int(match[2])


def run(args: argparse.Namespace) -> int:
    """Run a library and return the exit code."""
    from sbrdf_jax.runtime import worker_environment

    os.environ.update(worker_environment(1))  # of this process; workers have their own
    from sbrdf_jax.batch.index import read_memory, write_index
    from sbrdf_jax.batch.library import load_library, take_shard
    from sbrdf_jax.batch.locks import is_held
    from sbrdf_jax.batch.states import look
    from sbrdf_jax.batch.watch import plan_table, table

    overrides = list(args.overrides)
    overrides += [
        f"executor.{key}={value}" for key, value in (("kind", args.executor), ("workers", args.workers)) if value
    ]
    library = load_library(args.library, overrides)
    materials = take_shard(library.materials, *args.shard) if args.shard else library.materials
    memory = read_memory(library.folder)
    outcomes = [look(material, memory) for material in materials]
    if args.plan:
        print(plan_table(materials, outcomes, args.retry_failed))
        return 0
    if args.status:
        print(table(outcomes, [material.name for material in materials if is_held(library.folder, material.name)]))
        if library.folder.is_dir() and not args.shard:
            write_index(library.folder, materials, outcomes, memory)
        return exit_code(outcomes)
    return _run(args, overrides, library, materials, outcomes, memory)


def exit_code(outcomes: Sequence["Outcome"]) -> int:
    """3 where a material or some of its lanes failed."""
    from sbrdf_jax.batch.states import State

    failed = any(outcome.state is State.FAILED or outcome.failed_lanes for outcome in outcomes)
    return SOME_LANES_FAILED if failed else 0


def open_folder(library: "Library", shard: tuple[int, int] | None) -> "Progress":
    """Make the folder of the results, clear away what dead batches left in it, and open the log.

    Raises:
        UserError: It cannot be written.
    """
    from sbrdf_jax.batch.locks import has_locks, remove_dead
    from sbrdf_jax.errors import UserError
    from sbrdf_jax.progress import Progress

    name = "batch.log" if shard is None else f"batch-{shard[0]}-of-{shard[1]}.log"
    try:
        library.folder.mkdir(parents=True, exist_ok=True)
        remove_dead(library.folder)
        progress = Progress(library.folder / name)
        if not has_locks(library.folder):
            progress.say("this file system has no locks: two batches at once may compute a material twice")
        return progress
    except OSError as error:
        found = f"output_folder: found {str(library.folder)!r}, which cannot be written ({error.strerror})"
        raise UserError(f"{found}; expected a folder to write to") from None


def _run(
    args: argparse.Namespace,
    overrides: Sequence[str],
    library: "Library",
    materials: Sequence["Material"],
    outcomes: Sequence["Outcome"],
    memory: "Memory",
) -> int:
    from sbrdf_jax.batch.executors import execute
    from sbrdf_jax.batch.index import write_index
    from sbrdf_jax.batch.slurm import submit
    from sbrdf_jax.batch.watch import Watch, count_states, needs_work, table
    from sbrdf_jax.stopping import before_stopping

    pending = [m for m, o in zip(materials, outcomes, strict=True) if needs_work(o, args.retry_failed)]
    with open_folder(library, args.shard) as progress, before_stopping(lambda word: progress.log(f"stopped: {word}")):
        progress.say(f"{count_states(outcomes)}; {len(pending)} to compute")
        if library.executor.kind == "slurm" and not args.shard and pending:
            progress.say(submit(library, pending, overrides, retry_failed=args.retry_failed))
            return 0
        watch = Watch(outcomes, progress)
        with progress.stage("batch"):
            execute(library.executor, pending, watch, args.retry_failed)
        outcomes = [watch.outcomes[material.name] for material in materials]
        for material, outcome in zip(materials, outcomes, strict=True):
            if outcome.result is not None:
                memory.results[str(material.result)] = outcome.result
            if outcome.source is not None:
                memory.sources[material.options.input.path] = outcome.source
        if not args.shard:
            write_index(library.folder, materials, outcomes, memory)
        progress.say("\n" + table(outcomes))
    return exit_code(outcomes)
