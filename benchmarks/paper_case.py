"""The paper's own case: L = 1 and 4, each lobe kind, every incident angle, beside its numbers.

    python -m benchmarks.paper_case [MATERIAL ...]     # amber_glass unless given

Prints eta of eq. (18) in percent for each incident angle, with the share that the truncation
of the spectrum alone makes, and the seconds of a second, warm fit.
"""

import sys
import time

import numpy as np

PAPER = {
    1: {"angle_squared": "14.3", "tan_squared": "14.3", "tan": "11.5"},
    4: {"angle_squared": "< 4.5", "tan_squared": "< 4.5", "tan": "< 4.5"},
}


def main(materials: list[str]) -> None:
    """Print a table for each material."""
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    from sbrdf_jax.colour import colour_matching
    from sbrdf_jax.config import parse_config, resolve
    from sbrdf_jax.encoding import encode_field, make_basis
    from sbrdf_jax.formats import read
    from sbrdf_jax.lobes import LOBE_KINDS
    from sbrdf_jax.metrics import error_at_nodes, error_split
    from sbrdf_jax.options import RepresentOptions
    from sbrdf_jax.pipeline import prepare
    from sbrdf_jax.representation import represent
    from sbrdf_jax.resampling import resample

    for material in materials:
        blocks = "resample: {method: paper}\nrepresent: {method: paper}\n"
        options = resolve(parse_config(f"input: {{path: builtin:{material}}}\n{blocks}"))
        raw = read(options.input.path, options.input)
        ready = prepare(raw, options)
        gridded = resample(ready.cleaned.samples, ready.grid, options.resample)
        field = encode_field(gridded, make_basis(raw.wavelength_nm, options.encode.basis, options.encode.coefficients))
        matching = colour_matching(np.asarray(gridded.wavelength_nm))
        angles = np.rad2deg(np.asarray(gridded.theta_i))
        print(f"{material}: eta [%] by incident angle; last two columns: seconds warm, the paper's value at 0 degrees")
        print(f"{'L':>2} {'lobe':<14}" + "".join(f"{a:>7.4g}" for a in angles) + f"{'s':>7}{'paper':>8}")
        for degree in (1, 4):
            for kind in LOBE_KINDS[1:]:
                setting = RepresentOptions(method="paper", max_degree=degree, lobe=kind)  # type: ignore[arg-type]
                represent(field, setting)
                start = time.perf_counter()
                compact = represent(field, setting)
                np.asarray(compact.background)
                seconds = time.perf_counter() - start
                eta = 100 * error_at_nodes(compact, gridded, matching)["relative_error"]
                row = "".join(f"{e:>7.2f}" for e in eta)
                print(f"{degree:>2} {kind:<14}{row}{seconds:>7.2f}{PAPER[degree][kind]:>8}", flush=True)
        spectral = 100 * error_split(compact, field, gridded)["error_spectral"]
        print(f"   {'truncation':<14}" + "".join(f"{e:>7.2f}" for e in spectral) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:] or ["amber_glass"])
