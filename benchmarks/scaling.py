"""Time, memory and error of resampling against samples and nodes: python -m benchmarks.scaling [--method paper].

Each point is a process of its own, so that its peak memory is its own; the second, warm run is
timed, on the amber glass at 31 wavelengths. Exponents are fitted to the last three points of
a sweep.
"""

import argparse
import json
import resource
import subprocess
import sys
import time

import numpy as np

from benchmarks.solver import thinned

SAMPLES = (1_000, 10_000, 100_000, 1_000_000)
STEPS_DEG = (15.0, 7.5, 5.0, 3.0, 2.0, 1.0)
NUM_SAMPLES, STEP_DEG = 1_500, 7.5  # where the other is swept
NUM_WAVELENGTHS = 31
NUM_INCIDENCES = 13  # of the amber glass
NUM_DIRECTIONS = 3000
HIGHEST_DEG = 80.0


def measure_point(method: str, count: int, step_deg: float) -> dict[str, float]:
    """Return seconds, error and peak memory of one size."""
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    from sbrdf_jax.builtin import measure, true_brdf
    from sbrdf_jax.cleaning import clean
    from sbrdf_jax.config import parse_config, resolve
    from sbrdf_jax.evaluation import evaluate_in_chunks
    from sbrdf_jax.grid import make_grid
    from sbrdf_jax.resampling import resample

    grid = f"{{theta_i_step_deg: {step_deg}, theta_o_step_deg: {step_deg}, phi_o_step_deg: {step_deg}}}"
    lines = f"input: {{path: builtin:amber_glass}}\ngrid: {grid}\nresample: {{method: {method}}}"
    options = resolve(parse_config(lines))
    raw = measure("amber_glass", count=-(-count // NUM_INCIDENCES))
    raw = thinned(raw, NUM_WAVELENGTHS)
    start = time.perf_counter()
    cleaned = clean(raw, bilateral="auto", method=method)
    clean_seconds = time.perf_counter() - start
    nodes = make_grid(cleaned.samples, options.grid, bilateral=cleaned.report.bilateral)
    seconds: list[float] = []
    for _ in range(2):
        start = time.perf_counter()
        gridded = resample(cleaned.samples, nodes, options.resample)
        np.asarray(gridded.brdf)
        seconds.append(time.perf_counter() - start)
    rng = np.random.default_rng(5)
    theta_i, theta_o = np.deg2rad(rng.uniform(0, HIGHEST_DEG, (2, NUM_DIRECTIONS)))
    angles = theta_i, theta_o, rng.uniform(0, 2 * np.pi, NUM_DIRECTIONS)
    found = evaluate_in_chunks(gridded, *angles)
    truth = true_brdf("amber_glass", *angles, raw.wavelength_nm)
    return {
        "samples": cleaned.samples.num_samples,
        "nodes": len(nodes.theta_i) * nodes.num_directions,
        "clean": clean_seconds,
        "first": seconds[0],
        "warm": seconds[1],
        "steps": int(np.max(np.asarray(gridded.num_steps))),
        "median": 100 * float(np.median(np.abs(found / truth - 1))),
        "gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def sweep(method: str, what: str, sizes: list[tuple[int, float]]) -> None:
    """Print a line for each size, and the exponent of the warm time."""
    columns = ("samples", "nodes", "clean s", "first s", "warm s", "steps", "median %", "GiB")
    print("".join(f"{name:>10}" for name in columns))
    size, seconds = [], []
    for count, step_deg in sizes:
        words = [sys.executable, "-m", "benchmarks.scaling", "--method", method, "--point", str(count), str(step_deg)]
        done = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            print(f"{count:>9} at {step_deg} degrees: ended with {done.returncode}")
            continue
        row = json.loads(done.stdout.splitlines()[-1])
        timed = "".join(f"{row[name]:>10.2f}" for name in ("clean", "first", "warm"))
        rest = f"{row['steps']:>10}{row['median']:>10.3f}{row['gib']:>10.2f}"
        print(f"{row['samples']:>10}{row['nodes']:>10}{timed}{rest}", flush=True)
        size.append(row[what])
        seconds.append(row["warm"])
    if len(size) >= 3:
        exponent = np.polyfit(np.log(size[-3:]), np.log(seconds[-3:]), 1)[0]
        print(f"exponent of the warm time over {what}: {exponent:.2f}\n")


def main() -> None:
    """Sweep over samples, then over nodes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", default="guided", choices=("guided", "paper"))
    parser.add_argument("--samples", nargs="*", type=int, default=SAMPLES)
    parser.add_argument("--steps-deg", nargs="*", type=float, default=STEPS_DEG)
    parser.add_argument("--point", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.point:
        print(json.dumps(measure_point(args.method, int(args.point[0]), float(args.point[1]))))
        return
    if args.samples:
        sweep(args.method, "samples", [(count, STEP_DEG) for count in args.samples])
    if args.steps_deg:
        sweep(args.method, "nodes", [(NUM_SAMPLES, step) for step in args.steps_deg])


if __name__ == "__main__":
    main()
