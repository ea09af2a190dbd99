"""A library of amber glasses in batch: one worker, two workers, separate `run` processes.

    python -m benchmarks.library [--materials 64] [--samples 1439] [--wavelengths 31] [--separate 2] [key.path=value ..]

The materials differ in roughness and colour and share their directions, as one goniometer measures them. Each worker
has one thread. Seconds are wall-clock; CPU seconds of a material are beside them, because another process on the
machine stretches the former. Below 5 materials the second worker is not used: it would compile for too few. Separate
runs have the threads that `run` takes by itself; their time is that of a few, scaled.
Prints a table beside what is wanted of 64 materials, then one JSON line with all numbers. On a machine whose cores are
shared with other work, the ratio of the workers says more of that than of them: `load_before` tells.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

import h5py
import numpy as np

WANTED_TWO_OVER_ONE, WANTED_AFTER_FIRST, WANTED_OVER_SEPARATE = 1.7, 1.5, 8
BASE = "input: {bilateral: true}\noutput: {report: false}\n"


def write_materials(folder: Path, count: int, samples: int, wavelengths: int) -> None:
    """Write measurements of glasses of evenly spread roughness and depth of the red dip."""
    from benchmarks.solver import thinned
    from sbrdf_jax.builtin import MATERIALS, AmberGlass, measure
    from sbrdf_jax.formats import write_samples

    for number in range(count):
        share = number / max(count - 1, 1)
        MATERIALS["varied"] = AmberGlass(alpha=0.12 + 0.28 * share, red_dip=(0.61803 * number) % 1)
        raw = measure("varied")
        rows = np.linspace(0, raw.num_samples - 1, min(samples, raw.num_samples)).round().astype(int)
        write_samples(folder / f"glass_{number:03}.h5", thinned(raw.take(rows), wavelengths))


def batch(folder: Path, workers: int, overrides: list[str]) -> dict[str, float]:
    """Run the library into a new folder; seconds of the whole, and of its materials from the second of a worker on."""
    output = folder / f"results_{workers}"
    words = [f"output_folder={output}", f"executor.workers={workers}", "executor.threads=1", *overrides]
    start, load = time.perf_counter(), os.getloadavg()[0]
    subprocess.run([sys.executable, "-m", "sbrdf_jax.batch", str(folder / "library.yaml"), *words], check=True)
    seconds = time.perf_counter() - start
    with h5py.File(output / "index.h5") as file:
        each = np.sort(file["materials/seconds"][()])[:-workers]
        cpu = np.sort(file["materials/cpu_seconds"][()])[:-workers]
    return {
        "seconds": seconds,
        "median_after_first": float(np.median(each)),
        "slowest_after_first": float(each[-1]),
        "cpu_median_after_first": float(np.median(cpu)),
        "load_before": load,
    }


def separate(folder: Path, count: int, overrides: list[str]) -> float:
    """Mean seconds of a `run` process of its own."""
    start = time.perf_counter()
    for number in range(count):
        path = folder / "raw" / f"glass_{number:03}.h5"
        words = [f"input.path={path}", f"output.path={folder}/separate_{number}.h5", *overrides]
        command = [sys.executable, "-m", "sbrdf_jax.run", str(folder / "base.yaml"), *words]
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    return (time.perf_counter() - start) / count


def main() -> None:
    """Print a table, then a JSON line."""
    parser = argparse.ArgumentParser(description="Time a library beside separate runs.")
    parser.add_argument("overrides", nargs="*", metavar="key.path=value", help="of every material's config")
    parser.add_argument("--materials", type=int, default=64, help="how many")
    parser.add_argument("--samples", type=int, default=1439, help="of each")
    parser.add_argument("--wavelengths", type=int, default=31, help="of each")
    parser.add_argument("--separate", type=int, default=2, help="run processes to time")
    chosen = parser.parse_args()
    print(f"Python {platform.python_version()}, jax {version('jax')}, {os.cpu_count()} CPUs", flush=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "raw").mkdir()
        (folder / "base.yaml").write_text(BASE)
        (folder / "library.yaml").write_text("base: base.yaml\nmaterials: raw/*.h5\noutput_folder: results\n")
        write_materials(folder / "raw", chosen.materials, chosen.samples, chosen.wavelengths)
        record = {"overrides": chosen.overrides} | {k: v for k, v in vars(chosen).items() if k != "overrides"}
        for workers in (1, 2):
            record[f"workers_{workers}"] = batch(folder, workers, chosen.overrides)
            print(f"{workers} workers: {record[f'workers_{workers}']}", flush=True)
        each = separate(folder, chosen.separate, chosen.overrides)
    for line in summary(record, each):
        print(line)
    print(json.dumps(record))


def summary(record: dict, each: float) -> list[str]:
    """Add the ratios to a record, and return its table: what was measured beside what it should be."""
    count, few = record["materials"], record["separate"]
    one, two = record["workers_1"], record["workers_2"]
    all_separate = each * count
    record |= {
        "separate_each": each,
        "two_over_one": one["seconds"] / two["seconds"],
        "separate_over_one": all_separate / one["seconds"],
        "separate_over_two": all_separate / two["seconds"],
    }
    after, cpu = one["median_after_first"], one["cpu_median_after_first"]
    return [
        f"{count} materials of {record['samples']} samples x {record['wavelengths']} wavelengths",
        f"one worker, one thread    {one['seconds']:8.1f} s",
        f"two workers, one thread   {two['seconds']:8.1f} s    {record['two_over_one']:.2f} times as fast"
        f" (wanted: {WANTED_TWO_OVER_ONE})",
        f"each after the first      {after:8.2f} s    median of one worker, {cpu:.2f} s of CPU"
        f" (wanted: {WANTED_AFTER_FIRST} s)",
        f"separate `run` processes  {all_separate:8.1f} s    {each:.1f} s each, the mean of {few}, times {count}:"
        f" {record['separate_over_one']:.1f} times one worker, {record['separate_over_two']:.1f} times two"
        f" (wanted: {WANTED_OVER_SEPARATE})",
    ]


if __name__ == "__main__":
    main()
