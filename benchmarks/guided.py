"""Seconds of guided resampling by step, first and next material of a geometry: python -m benchmarks.guided [FILE ...].

Without files, the Cornell files of ../shared, or the embedded sample where they are absent.
"""

import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.solver import CORNELL


def main(files: list[str]) -> None:
    """Print a line for each file: new process, warm, and sharing the geometry."""
    from sbrdf_jax.runtime import compile_clock, set_up_jax

    set_up_jax()
    from sbrdf_jax.config import parse_config, resolve
    from sbrdf_jax.formats import read
    from sbrdf_jax.pipeline import prepare
    from sbrdf_jax.resampling.guided import fit_field, place_centres, read_nodes

    print(f"{'file':<28} {'fit of':<22} {'fit s':>8} {'nodes s':>8} {'compile s':>10} {'KKT':>9} {'steps':>6}")
    for file in files:
        options = resolve(parse_config(f"input: {{path: '{file}'}}\nresample: {{method: guided}}"))
        ready = prepare(read(options.input.path, options.input), options)
        samples = ready.cleaned.samples
        shared = place_centres(samples)
        for name, centres in (("first", None), ("warm", None), ("shares, first", shared), ("shares geometry", shared)):
            with compile_clock() as clock:
                start = time.perf_counter()
                fit = fit_field(samples, options.resample, centres=centres)
                middle = time.perf_counter()
                read_nodes(fit.field, ready.grid, fit.whiten)
                end = time.perf_counter()
            row = f"{middle - start:>8.2f} {end - middle:>8.2f} {clock.seconds:>10.2f}"
            print(f"{Path(file).name:<28} {name:<22} {row} {np.max(fit.kkt_residual):>9.1e} {np.max(fit.num_steps):>6}")


if __name__ == "__main__":
    found = sorted(map(str, CORNELL.glob("*.brdf")))
    main(sys.argv[1:] or found or ["builtin:amber_glass"])
