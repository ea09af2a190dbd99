"""Error against time of solvers of the bounded least squares problem: python -m benchmarks.error_time [NAME ...].

NAME as in `benchmarks.solver`. A few wavelengths, evenly spread, so that the slow ones end too. Each record is a solver
at a tolerance or number of steps: warm seconds, relative KKT residual in float64 of what it returned, and its error:
against the truth at the nodes for an embedded sample, else the distance from the own solver's answer at 1e-10, which
is beside it in any case. The own solver's set-up, which one geometry shares, is apart. Draws
results/error_time/benchmark_resampling.png.
"""

import argparse
import dataclasses
import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from benchmarks.peers import optax_solver, osqp_solver
from benchmarks.records import Record, Timing, record_of, timed
from benchmarks.solver import AMBER, NAMES, load

TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8)
STEPS = (10, 100, 1000)
FINE = 1e-10
HIGHEST_DEG = 75.0  # of the nodes where the truth is compared
OSQP_UNKNOWNS = 1000  # up to these it is tried at every tolerance
FLOAT32_TOLERANCE = 1e-4  # float32 holds no better answer


class Point(NamedTuple):
    """What one solver made of the problem at one setting."""

    method: str
    setting: str
    timing: Timing
    answer: np.ndarray  # [unknown, lane]
    set_up_seconds: float = 0.0
    precision: str = "float64"  # or float32; mixed: float32 first, float64 to the end


def own_points(operator, rhs, known, set_up_seconds: float, repeats: int) -> Iterator[Point]:
    """Yield points of the own solver, with the geometry's inverse and from nothing, in float64 and float32."""
    import jax
    import jax.numpy as jnp

    from sbrdf_jax.nnls import ProjectedNewton, solve_in_rounds
    from sbrdf_jax.resampling.paper import solve_normal

    single, rhs_single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (operator, rhs))
    for tolerance in TOLERANCES:
        found, timing = timed(lambda tolerance=tolerance: solve_normal(operator, rhs, tolerance, known), repeats)
        yield Point("own", f"{tolerance:.0e}", timing, np.asarray(found.value), set_up_seconds)
        method = ProjectedNewton(tolerance=tolerance)
        found, timing = timed(lambda method=method: solve_in_rounds(operator, rhs, method), repeats)
        yield Point("own, without set-up", f"{tolerance:.0e}", timing, np.asarray(found.value))
        mixed = dataclasses.replace(method, precision="float32")
        found, timing = timed(lambda method=mixed: solve_in_rounds(operator, rhs, method), repeats)
        yield Point("own, without set-up", f"{tolerance:.0e}", timing, np.asarray(found.value), precision="mixed")
        if tolerance >= FLOAT32_TOLERANCE:
            found, timing = timed(lambda method=method: solve_in_rounds(single, rhs_single, method), repeats)
            answer = np.asarray(found.value, np.float64)
            yield Point("own, without set-up", f"{tolerance:.0e}", timing, answer, precision="float32")


def jaxopt_points(operator, rhs, steps: tuple[int, ...]) -> Iterator[Point]:
    """Yield points of jaxopt.ProjectedGradient."""
    import jax

    from sbrdf_jax.nnls import JaxoptProjectedGradient, solve_nnls

    solve = jax.jit(solve_nnls, static_argnames="method")
    for count in steps:
        method = JaxoptProjectedGradient(tolerance=0.0, max_steps=count)
        found, timing = timed(lambda method=method: solve(operator, rhs, method), 1)
        yield Point("jaxopt.ProjectedGradient", str(count), timing, np.asarray(found.value))


def dense_points(matrix: np.ndarray, rhs: np.ndarray, steps: tuple[int, ...]) -> Iterator[Point]:
    """Yield points of SciPy's NNLS and L-BFGS-B, lane after lane, and of the peers that are installed.

    Their Cholesky factor of A'A is not timed.
    """
    import scipy.linalg
    import scipy.optimize

    triangle = scipy.linalg.cholesky(matrix)
    target = scipy.linalg.solve_triangular(triangle, rhs, trans=1)

    def exact() -> np.ndarray:
        columns = [scipy.optimize.nnls(triangle, column, maxiter=30 * len(matrix))[0] for column in target.T]
        return np.stack(columns, axis=1)

    def quasi_newton(count: int) -> np.ndarray:
        options = {"maxiter": count, "maxfun": 10 * count, "ftol": 0.0, "gtol": 0.0}
        bounds = scipy.optimize.Bounds(0.0, np.inf)
        columns = []
        for column in rhs.T:

            def objective(x, column=column):
                image = matrix @ x
                return x @ (image / 2 - column), image - column

            start = np.zeros(len(matrix))
            found = scipy.optimize.minimize(
                objective, start, jac=True, bounds=bounds, method="L-BFGS-B", options=options
            )
            columns.append(found.x)
        return np.stack(columns, axis=1)

    settings: list[tuple[str, str, Callable[[], np.ndarray], int]] = [("scipy.optimize.nnls", "", exact, 0)]
    settings += [("scipy L-BFGS-B", str(count), lambda count=count: quasi_newton(count), 0) for count in steps]
    if optax := optax_solver(triangle, target):
        settings += [("optax.nnls", str(count), lambda count=count: optax(count), 1) for count in steps]
    if osqp := osqp_solver(matrix, rhs):
        tolerances = TOLERANCES[1:] if len(matrix) <= OSQP_UNKNOWNS else TOLERANCES[2:3]  # its factor alone takes long
        settings += [("OSQP", f"{tolerance:.0e}", lambda t=tolerance: osqp(t), 0) for tolerance in tolerances]
    for method, setting, work, repeats in settings:
        answer, timing = timed(work, repeats)
        yield Point(method, setting, timing, np.maximum(answer, 0.0))


def records(
    name: str, *, lanes: int, step_deg: float = 7.5, steps: tuple[int, ...] = STEPS, repeats: int = 3
) -> Iterator[Record]:
    """Yield the records of one case; none where its file is absent."""
    import jax
    import jax.numpy as jnp

    from sbrdf_jax.multipliers import invert_normal
    from sbrdf_jax.nnls import kkt_residual
    from sbrdf_jax.resampling.normal import normal_equations
    from sbrdf_jax.resampling.paper import solve_normal

    case = load(name, step_deg)
    if case is None:
        return
    samples, grid = case
    operator, rhs = normal_equations(samples, grid, 1.0)
    some = np.linspace(0, rhs.shape[1] - 1, lanes).round().astype(int)
    rhs = rhs[:, some]
    known, set_up = timed(lambda: invert_normal(operator), 1)
    fine = np.asarray(solve_normal(operator, rhs, FINE, known).value)
    truth, kind = fine, "relative distance from the answer at 1e-10"
    weigh: Callable[[np.ndarray], np.ndarray] = lambda answer: answer  # noqa: E731
    if name in AMBER:
        truth, weigh = truth_at_nodes(name.removesuffix("_paper"), grid, samples.wavelength_nm[some])
        kind = f"relative L2 error against the truth, nodes to {HIGHEST_DEG:g} degrees"
    matrix = np.asarray(jax.jit(operator.multiply)(jnp.eye(rhs.shape[0])))
    size = {"samples": samples.num_samples, "unknowns": rhs.shape[0], "wavelengths": lanes}
    own = own_points(operator, rhs, known, min(set_up.runs), repeats)
    others = jaxopt_points(operator, rhs, steps), dense_points(matrix, np.asarray(rhs), steps)
    for point in itertools.chain(own, *others):
        far = np.linalg.norm(point.answer - fine) / np.linalg.norm(fine)
        yield record_of(
            point.timing,
            set_up_seconds=point.set_up_seconds,
            group="resampling",
            problem=f"{name}, {step_deg:g} degrees",
            method=point.method if point.precision == "float64" else f"{point.method}, {point.precision}",
            setting=point.setting,
            precision=point.precision,
            size=size,
            error=float(np.linalg.norm(weigh(point.answer) - truth) / np.linalg.norm(truth)),
            error_kind=kind,
            kkt_residual=float(np.max(kkt_residual(operator, rhs, jnp.asarray(point.answer)))),
            more={"distance": float(far)},
        )


def truth_at_nodes(material: str, grid, wavelength_nm):
    """Return the truth at the grid's inner nodes, and the function that takes an answer [unknown, lane] there."""
    from sbrdf_jax.builtin import true_brdf

    inner_i, inner_o = (axis <= np.deg2rad(HIGHEST_DEG) + 1e-9 for axis in (grid.theta_i, grid.theta_o))
    mesh = np.meshgrid(grid.theta_i[inner_i], grid.theta_o[inner_o], grid.phi_o, indexing="ij")

    def at_nodes(answer: np.ndarray) -> np.ndarray:
        return grid.scatter(answer)[inner_i][:, inner_o]

    return np.asarray(true_brdf(material, *mesh, wavelength_nm)), at_nodes


def main() -> None:
    """Compare the solvers on every case that is there."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=["cayman"], help=f"of {', '.join(NAMES)}")
    parser.add_argument("--lanes", type=int, default=4, help="wavelengths")
    args = parser.parse_args()
    from benchmarks.plots import draw
    from benchmarks.tables import print_tables
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    found = [record for name in args.names for record in records(name, lanes=args.lanes)]
    print_tables(found)
    print(*draw(found, "results/error_time").values(), sep="\n")


if __name__ == "__main__":
    main()
