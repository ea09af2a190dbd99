"""The whole pipeline, from samples to the compact form: time, memory and error against its sizes; cold and warm.

Each point is a process of its own, so that its peak memory and its compilation are its own. The error is that of the
compact form against the truth of the amber glass, in directions up to 75 degrees.
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.records import Record, Timing, record_of, timed
from benchmarks.solver import thinned
from benchmarks.tables import USUAL

NUM_DIRECTIONS = 1000
HIGHEST_DEG = 75.0
ERROR_KIND = "median relative error of the compact form against the truth"
ROOT = Path(__file__).resolve().parents[1]


@dataclasses.dataclass(frozen=True)
class Case:
    """A size of the problem; `sweep` names what is swept."""

    method: str = "guided"
    samples: int = 1500
    step_deg: float = 7.5
    wavelengths: int = 31
    incidences: int = 13
    threads: int = 1
    precision: str = "float64"
    sweep: str = USUAL


def sweeps(methods: tuple[str, ...], cores: int) -> Iterator[Case]:
    """Yield the cases of the full suite: the usual one, which every sweep shares, then the others of each sweep."""
    for method in methods:
        yield Case(method)
        yield from (Case(method, samples=count, sweep="samples") for count in (750, 6000, 24_000))
        steps_deg = (15.0, 5.0, 3.75) if method == "guided" else (15.0, 5.0)  # at 3.75 degrees paper takes minutes
        yield from (Case(method, step_deg=step, sweep="nodes") for step in steps_deg)
        yield from (Case(method, wavelengths=count, sweep="wavelengths") for count in (8, 101))
        yield from (Case(method, incidences=count, sweep="incident angles") for count in (4, 7))
        yield from (Case(method, threads=count, sweep="threads") for count in (2,) if count <= cores)
        yield Case(method, step_deg=5.0, precision="float32", sweep="float32 first, nodes")


def records(cases: Iterator[Case] | list[Case]) -> Iterator[Record]:
    """Yield a record for each case, a process each."""
    from sbrdf_jax.runtime import worker_environment

    for case in cases:
        words = [sys.executable, "-m", "benchmarks.pipeline", json.dumps(dataclasses.asdict(case))]
        environment = os.environ | worker_environment(case.threads)
        done = subprocess.run(words, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=True)
        found, swept = json.loads(done.stdout.splitlines()[-1]), case.sweep.split(", ")[-1]
        yield record_of(
            Timing(found["first"], tuple(found["warm"]), found["peak_bytes"]),
            group="pipeline",
            problem="amber_glass",
            method=f"{case.method}, {case.threads} thread{'s' * (case.threads > 1)}",
            setting=USUAL if case.sweep == USUAL else f"{case.sweep} {found['size'].get(swept, case.threads)}",
            precision="float64" if case.precision == "float64" else "mixed",
            size=found["size"],
            error=found["error"],
            error_kind=ERROR_KIND,
        )


def measure_case(case: Case) -> dict:
    """Return seconds, error and peak memory of one case, in this process."""
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    from sbrdf_jax.builtin import measure
    from sbrdf_jax.config import parse_config, resolve
    from sbrdf_jax.pipeline import prepare, process
    from sbrdf_jax.progress import Progress

    names = ("theta_i", "theta_o", "phi_o")
    grid = ", ".join(f"{name}_step_deg: {case.step_deg}" for name in names)
    represent = "represent: {method: paper}" if case.method == "paper" else ""
    lines = [
        "input: {path: 'builtin:amber_glass'}",
        f"grid: {{{grid}}}",
        f"resample: {{method: {case.method}}}",
        f"runtime: {{precision: {case.precision}}}",
        represent,
    ]
    options = resolve(parse_config("\n".join(lines)))
    raw = thinned(measure("amber_glass", count=-(-case.samples // case.incidences)), case.wavelengths)
    known = np.unique(raw.theta_i)
    kept = known[np.linspace(0, len(known) - 1, case.incidences).round().astype(int)]
    raw = raw.take(np.isin(raw.theta_i, kept))

    def work():
        ready = prepare(raw, options)
        return process(raw, ready, options, Progress(quiet=True)), ready

    (result, ready), timing = timed(work, 1)
    return {
        "first": timing.first,
        "warm": timing.warm,
        "peak_bytes": timing.peak_bytes,
        "error": error_of(result.compact),
        "size": {
            "samples": raw.num_samples,
            "nodes": len(ready.grid.theta_i) * ready.grid.num_directions,
            "wavelengths": len(raw.wavelength_nm),
            "incident angles": case.incidences,
        },
    }


def error_of(compact) -> float:
    """Median relative error of a compact form of the amber glass."""
    from sbrdf_jax.builtin import true_brdf
    from sbrdf_jax.evaluation import evaluate_in_chunks, measured_wavelengths

    rng = np.random.default_rng(5)
    theta_i, theta_o = np.deg2rad(rng.uniform(0, HIGHEST_DEG, (2, NUM_DIRECTIONS)))
    angles = theta_i, theta_o, rng.uniform(0, 2 * np.pi, NUM_DIRECTIONS)
    truth = true_brdf("amber_glass", *angles, np.asarray(measured_wavelengths(compact)))
    return float(np.median(np.abs(evaluate_in_chunks(compact, *angles) / truth - 1)))


def cold_records(repeats: int = 2) -> Iterator[Record]:
    """Yield records of the quickstart's process from nothing to result: without, with a new and with a filled cache."""
    from sbrdf_jax.runtime import CACHE_VARIABLE
    from sbrdf_jax.store import load_stage

    with tempfile.TemporaryDirectory() as name:
        output = Path(name) / "result.h5"
        overrides = [f"output.path={output}", "output.overwrite=true", "output.report=false"]
        words = [sys.executable, "-m", "sbrdf_jax.run", str(ROOT / "configs" / "quickstart.yaml"), *overrides]
        bare = {key: value for key, value in os.environ.items() if key != CACHE_VARIABLE}
        cached = bare | {CACHE_VARIABLE: str(Path(name) / "cache")}
        for setting, environment, count in (
            ("no cache", bare, repeats),
            ("new cache", cached, 1),
            ("cache", cached, repeats),
        ):
            seconds, peaks = zip(*(_run_to_end(words, environment) for _ in range(count)), strict=True)
            yield record_of(
                Timing(seconds[0], seconds, max(peaks)),
                group="cold start",
                problem="quickstart, a process from nothing to result",
                method=setting,
                setting="",
                size={"processes": count},
                error=error_of(load_stage(output, "compact")),
                error_kind=ERROR_KIND,
            )


def _run_to_end(words: list[str], environment: dict[str, str]) -> tuple[float, int]:
    """Seconds and peak memory [bytes] of a process that must succeed."""
    start = time.perf_counter()
    child = subprocess.Popen(words, cwd=ROOT, env=environment, stderr=subprocess.DEVNULL)
    _, status, used = os.wait4(child.pid, 0)  # the only way to the memory of this one child
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise subprocess.CalledProcessError(child.returncode, words)
    return time.perf_counter() - start, 1024 * used.ru_maxrss


if __name__ == "__main__":
    print(json.dumps(measure_case(Case(**json.loads(sys.argv[1])))))
