"""The bounded least squares problem of method paper: own solver beside scipy.optimize.nnls and jaxopt.

    python -m benchmarks.solver [--repeats N] [--scipy-lanes N] [--no-baselines] [NAME ...]

NAME: acryl_blue, cayman, garnet_red (the Cornell files, where ../shared has them), amber_glass
(at the three files' size) and amber_glass_paper (101 wavelengths, 10,000 samples); all unless given.
Every row holds time and error together: the relative KKT residual is of the stored solution, in
float64. "set-up" depends on angles only (inverse of the normal matrix) and serves every material
of a geometry; it, like compilation (first run less the fastest), is not part of the warm times.
SciPy solves the triangular square form, R of A'A = R'R (its factorisation is not timed), in a few
wavelengths, scaled to all of them. jaxopt takes 3000 steps in all wavelengths at once; the own
solver's time to jaxopt's final residual is beside it.
"""

import argparse
import os
import platform
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np

CORNELL = Path(__file__).resolve().parents[2] / "shared" / "data" / "cornell"
NAMES = ("acryl_blue", "cayman", "garnet_red", "amber_glass", "amber_glass_paper")
AMBER = {"amber_glass": (1439, 31), "amber_glass_paper": (10_000, 101)}  # samples, wavelengths
TOLERANCE = 1e-8
JAXOPT_STEPS = 3000


def load(name: str, step_deg: float = 7.5):
    """Return the cleaned samples and the grid of a case; None where the file is absent."""
    from sbrdf_jax.config import parse_config, resolve
    from sbrdf_jax.formats import read
    from sbrdf_jax.pipeline import prepare

    path = f"builtin:{name.split('_paper')[0]}" if name in AMBER else str(CORNELL / f"{name}.brdf")
    if name not in AMBER and not Path(path).exists():
        return None
    grid = f"{{theta_i_step_deg: {step_deg}, theta_o_step_deg: {step_deg}, phi_o_step_deg: {step_deg}}}"
    text = f"input: {{path: '{path}', bilateral: true}}\ngrid: {grid}\nresample: {{method: paper}}\n"
    options = resolve(parse_config(text))
    raw = read(path, options.input)
    if name in AMBER:
        count, lanes = AMBER[name]
        rows = np.linspace(0, raw.num_samples - 1, min(count, raw.num_samples)).round().astype(int)
        raw = thinned(raw.take(rows), lanes)
    ready = prepare(raw, options)
    return ready.cleaned.samples, ready.grid


def thinned(raw, lanes: int):
    """Keep evenly spaced wavelengths."""
    import dataclasses

    keep = np.linspace(0, len(raw.wavelength_nm) - 1, lanes).round().astype(int)
    return dataclasses.replace(raw, wavelength_nm=raw.wavelength_nm[keep], value=raw.value[:, keep])


def repeat(work, repeats: int):
    """Return the result of `work`, the first run's seconds and those of the warm runs."""
    import jax

    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        result = jax.block_until_ready(work())
        times.append(time.perf_counter() - start)
    return result, times[0], times[1:]


def scipy_seconds(operator, rhs, lanes: int) -> tuple[float, float]:
    """Seconds of scipy.optimize.nnls for all wavelengths, scaled from a few, and the worst KKT residual of these."""
    import jax
    import jax.numpy as jnp
    import scipy.linalg
    import scipy.optimize

    from sbrdf_jax.nnls import kkt_residual

    size = rhs.shape[0]
    triangle = scipy.linalg.cholesky(np.asarray(jax.jit(operator.multiply)(jnp.eye(size))))
    some = np.unique(np.linspace(0, rhs.shape[1] - 1, lanes).round().astype(int))
    target = scipy.linalg.solve_triangular(triangle, np.asarray(rhs[:, some]), trans=1)
    start = time.perf_counter()
    found = np.stack([scipy.optimize.nnls(triangle, column, maxiter=30 * size)[0] for column in target.T], axis=1)
    seconds = (time.perf_counter() - start) * rhs.shape[1] / len(some)
    return seconds, float(np.max(kkt_residual(operator, rhs[:, some], jnp.asarray(found))))


def row(name: str, what: str, seconds: float, spread: str, steps: str, residual: float, ratio: str) -> None:
    """Print a line of the table."""
    print(f"{name:<18} {what:<32} {seconds:>9.3f} {spread:>9} {steps:>7} {residual:>9.1e} {ratio:>9}", flush=True)


def compare(name: str, repeats: int, scipy_lanes: int, known: dict, baselines: bool) -> None:
    """Print the rows of one case; `known` keeps the set-up of a geometry for the next."""
    import jax

    from sbrdf_jax.multipliers import invert_normal
    from sbrdf_jax.nnls import JaxoptProjectedGradient, kkt_residual, solve_nnls
    from sbrdf_jax.resampling.normal import normal_equations
    from sbrdf_jax.resampling.paper import solve_normal

    case = load(name)
    if case is None:
        print(f"{name:<18} not measured: no such file below {CORNELL.parents[1].name}/")
        return
    operator, rhs = normal_equations(*case, 1.0)
    rhs = jax.block_until_ready(rhs)
    print(f"{name}: {case[0].num_samples} samples, {rhs.shape[0]} unknowns, {rhs.shape[1]} wavelengths")
    key = np.asarray(operator.block).tobytes()
    if key not in known:
        start = time.perf_counter()
        known[key] = invert_normal(operator)
        row(name, "set-up of the geometry", time.perf_counter() - start, "", "", 0.0, "")
    solve = jax.jit(kkt_residual)

    def own(tolerance: float) -> float:
        found, first, warm = repeat(lambda: solve_normal(operator, rhs, tolerance, known[key]), repeats)
        residual = float(np.max(solve(operator, rhs, found.value)))
        steps = str(int(np.max(found.num_steps)))
        row(name, f"own, to {tolerance:.1e}", min(warm), f"{np.median(warm):.3f}", steps, residual, "")
        row(name, "  of which compiled, once", max(first - min(warm), 0.0), "", "", residual, "")
        return min(warm)

    seconds = own(TOLERANCE)
    if not baselines:
        return
    method = JaxoptProjectedGradient(tolerance=0.0, max_steps=JAXOPT_STEPS)
    found, _, warm = repeat(lambda: jax.jit(solve_nnls, static_argnames="method")(operator, rhs, method), 1)
    reached = float(np.max(found.residual))
    own_loose = own(max(reached, TOLERANCE))
    row(
        name, f"jaxopt, {JAXOPT_STEPS} steps", min(warm), "", str(JAXOPT_STEPS), reached, f"{min(warm) / own_loose:.0f}"
    )
    if scipy_lanes:
        theirs, residual = scipy_seconds(operator, rhs, scipy_lanes)
        label = f"scipy, {scipy_lanes} lanes scaled to {rhs.shape[1]}"
        row(name, label, theirs, "", "", residual, f"{theirs / seconds:.0f}")


def main() -> None:
    """Print the machine and versions, then a table."""
    parser = argparse.ArgumentParser(description="Time the solver of method paper beside its baselines.")
    parser.add_argument("names", nargs="*", default=NAMES, help=f"of {', '.join(NAMES)}")
    parser.add_argument("--repeats", type=int, default=7, help="warm runs of the own solver")
    parser.add_argument("--scipy-lanes", type=int, default=2, help="wavelengths that SciPy solves; 0: none")
    parser.add_argument("--no-baselines", action="store_true", help="the own solver only")
    chosen = parser.parse_args()
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    packages = ", ".join(f"{name} {version(name)}" for name in ("jax", "jaxlib", "numpy", "scipy", "jaxopt"))
    load_average = os.getloadavg()[0]
    print(
        f"Python {platform.python_version()}, {packages}; {os.cpu_count()} CPUs, load {load_average:.1f} at the start"
    )
    print(f"{'case':<18} {'what':<32} {'seconds':>9} {'median':>9} {'steps':>7} {'KKT':>9} {'ratio':>9}")
    known: dict = {}
    for name in chosen.names:
        compare(name, chosen.repeats, chosen.scipy_lanes, known, not chosen.no_baselines)


if __name__ == "__main__":
    main()
