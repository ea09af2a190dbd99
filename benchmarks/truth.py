"""Both resampling methods against the truth of the embedded samples: python -m benchmarks.truth [MATERIAL ...].

Prints errors at random directions up to 80 degrees, and the seconds of a second, warm fit.
"""

import sys
import time

import numpy as np

NUM_DIRECTIONS = 3000
HIGHEST_DEG = 80.0
SMALLEST = 1e-3  # 1/sr; relative errors are taken of larger values only


def main(materials: list[str]) -> None:
    """Print a line for each material and method."""
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    from sbrdf_jax.builtin import true_brdf
    from sbrdf_jax.config import parse_config, resolve
    from sbrdf_jax.evaluation import evaluate_in_chunks
    from sbrdf_jax.formats import read
    from sbrdf_jax.pipeline import prepare
    from sbrdf_jax.resampling import resample

    rng = np.random.default_rng(5)
    theta_i, theta_o = np.deg2rad(rng.uniform(0, HIGHEST_DEG, (2, NUM_DIRECTIONS)))
    angles = theta_i, theta_o, rng.uniform(0, 2 * np.pi, NUM_DIRECTIONS)
    print(f"{'material':<20} {'method':<8} {'median %':>9} {'90th %':>9} {'L2 %':>9} {'first s':>9} {'warm s':>9}")
    for material in materials:
        for method in ("guided", "paper"):
            options = resolve(parse_config(f"input: {{path: builtin:{material}}}\nresample: {{method: {method}}}"))
            raw = read(options.input.path, options.input)
            ready = prepare(raw, options)
            seconds = []
            for _ in range(2):
                start = time.perf_counter()
                gridded = resample(ready.cleaned.samples, ready.grid, options.resample)
                np.asarray(gridded.brdf)
                seconds.append(time.perf_counter() - start)
            found, truth = evaluate_in_chunks(gridded, *angles), true_brdf(material, *angles, raw.wavelength_nm)
            big = truth > SMALLEST
            relative = 100 * np.abs(found - truth)[big] / truth[big]
            total = 100 * np.sqrt(((found - truth) ** 2).sum() / (truth**2).sum())
            row = (np.median(relative), np.quantile(relative, 0.9), total, *seconds)
            print(f"{material:<20} {method:<8}" + "".join(f" {x:>9.3f}" for x in row), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:] or ["amber_glass", "amber_glass_sharp", "amber_glass_broad"])
