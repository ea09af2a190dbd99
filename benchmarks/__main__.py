"""Run time against error, all in one: python -m benchmarks --suite quick|full [--only GROUP ...] [--output FILE.jsonl].

Each record holds a finite warm time and a finite error; the file has a record a line, written as soon as it is
measured, with versions, processor, device, threads and commit. quick ends within 3 minutes on two cores and needs the
base install only; full takes up to an hour and the extra `bench`. `python -m benchmarks.pages FILE.jsonl ...` makes the
pages of the documentation of such files.
"""

import argparse
import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.peers import missing
from benchmarks.records import Record, as_line, machine
from benchmarks.tables import print_tables

Suite = dict[str, Callable[[], Iterator[Record]]]


def quick() -> Suite:
    """The groups of the quick suite: small, on the embedded sample."""
    from benchmarks import compact, error_time, interpolation, lobe_fits, pipeline, roofline

    name, step_deg = "amber_glass", 15.0
    case = pipeline.Case("paper", samples=750, step_deg=step_deg, wavelengths=8)
    size = {"sizes": (107,), "repeats": 1, "with_paper": False}
    return {
        "resampling": lambda: error_time.records(name, lanes=2, step_deg=step_deg, steps=(300,), repeats=2),
        "interpolation": lambda: interpolation.records(name, samples=700, wavelengths=8, folds=1, step_deg=step_deg),
        "lobes": lambda: lobe_fits.records(2000, loop_lanes=100),
        "representation": lambda: compact.records(name, step_deg=step_deg, **size),
        "pipeline": lambda: pipeline.records([case]),
        "roofline": lambda: roofline.records((7.5,), (1, 31), ("float64",), repeats=3),
    }


def full() -> Suite:
    """The groups of the full suite."""
    from benchmarks import compact, error_time, interpolation, lobe_fits, pipeline, roofline
    from benchmarks.compact import GLASSES
    from benchmarks.solver import NAMES

    measured = [name for name in NAMES if not name.startswith("amber")]

    def resampling():
        yield from error_time.records("amber_glass", lanes=4, step_deg=15.0)
        for name in ("amber_glass", *measured[:1]):
            yield from error_time.records(name, lanes=2)

    def interpolations():
        for name in ("amber_glass", *measured):
            yield from interpolation.records(name, samples=1439, wavelengths=31, folds=3)

    return {
        "resampling": resampling,
        "interpolation": interpolations,
        "lobes": lambda: lobe_fits.records(20_000, loop_lanes=1000),
        "representation": lambda: (record for name in GLASSES for record in compact.records(name)),
        "pipeline": lambda: pipeline.records(pipeline.sweeps(("guided", "paper"), len(os.sched_getaffinity(0)))),
        "cold start": pipeline.cold_records,
        "roofline": roofline.records,
    }


def main() -> None:
    """Run a suite, print its tables and write its records."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", choices=("quick", "full"), default="quick")
    parser.add_argument("--only", nargs="*", help="names of groups")
    parser.add_argument("--output", type=Path, help="JSON lines, a record each")
    args = parser.parse_args()
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    shared = machine() | {"suite": args.suite}
    versions = ", ".join(f"{name} {found}" for name, found in shared["versions"].items())
    print(f"Python {shared['python']}, {versions}; {shared['cpu']}, {shared['threads']} threads, load {shared['load']}")
    for package in missing():
        print(f"missing: {package} (pip install -e '.[bench]'): its rows are left out")
    groups = quick() if args.suite == "quick" else full()
    unknown = set(args.only or ()) - set(groups)
    if unknown:
        parser.error(f"found group {', '.join(sorted(unknown))}, expected some of {', '.join(groups)}")
    start = time.perf_counter()
    with contextlib.ExitStack() as stack:
        if args.output:
            args.output.parent.mkdir(parents=True, exist_ok=True)
            lines = stack.enter_context(args.output.open("w"))
        for name, work in groups.items():
            if args.only and name not in args.only:
                continue
            some = []
            for record in work():
                some.append(record)
                if args.output:
                    print(as_line(record, shared), file=lines, flush=True)
            print_tables(some)
            print(f"{name}: {len(some)} records after {time.perf_counter() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
