"""Error against time of solvers of the bounded least squares problem: python -m benchmarks.error_time [NAME ...].

NAME as in `benchmarks.solver`. A few wavelengths, evenly spread, so that the slow ones end too. Each point is a solver
at a tolerance or number of steps: warm seconds, relative KKT residual in float64 of what it
returned, and the relative L2 distance of that from the own solver's answer at 1e-10. The own solver's
set-up, which one geometry shares, is a row of its own. Draws results/error_time_NAME.png.
"""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.solver import NAMES, load, repeat

TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8)
STEPS = (10, 100, 1000)
FINE = 1e-10
Point = tuple[str, str, float, np.ndarray]  # solver, setting, seconds, answer [unknown, lane]


def own_points(operator, rhs, known) -> Iterator[Point]:
    """Yield points of the own solver, with the geometry's inverse and from nothing, in float64 and float32."""
    import jax
    import jax.numpy as jnp

    from sbrdf_jax.nnls import ProjectedNewton, solve_nnls
    from sbrdf_jax.resampling.paper import solve_normal

    solve = jax.jit(solve_nnls, static_argnames="method")
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), operator)
    for tolerance in TOLERANCES:
        found, _, warm = repeat(lambda tolerance=tolerance: solve_normal(operator, rhs, tolerance, known), 3)
        yield "own", f"{tolerance:.0e}", min(warm), np.asarray(found.value)
        method = ProjectedNewton(tolerance=tolerance)
        found, _, warm = repeat(lambda method=method: solve(operator, rhs, method), 1)
        yield "own, without set-up", f"{tolerance:.0e}", min(warm), np.asarray(found.value)
        if tolerance >= 1e-4:  # float32 holds no better answer
            found, _, warm = repeat(lambda method=method: solve(single, rhs.astype(jnp.float32), method), 1)
            yield "own, float32", f"{tolerance:.0e}", min(warm), np.asarray(found.value, np.float64)


def jaxopt_points(operator, rhs) -> Iterator[Point]:
    """Yield points of jaxopt.ProjectedGradient."""
    import jax

    from sbrdf_jax.nnls import JaxoptProjectedGradient, solve_nnls

    solve = jax.jit(solve_nnls, static_argnames="method")
    for steps in STEPS:
        method = JaxoptProjectedGradient(tolerance=0.0, max_steps=steps)
        found, _, warm = repeat(lambda method=method: solve(operator, rhs, method), 1)
        yield "jaxopt.ProjectedGradient", str(steps), min(warm), np.asarray(found.value)


def scipy_points(matrix: np.ndarray, rhs: np.ndarray) -> Iterator[Point]:
    """Yield points of SciPy's NNLS and L-BFGS-B, lane after lane."""
    import scipy.linalg
    import scipy.optimize

    triangle = scipy.linalg.cholesky(matrix)
    target = scipy.linalg.solve_triangular(triangle, rhs, trans=1)

    def exact() -> np.ndarray:
        columns = [scipy.optimize.nnls(triangle, column, maxiter=30 * len(matrix))[0] for column in target.T]
        return np.stack(columns, axis=1)

    def quasi_newton(steps: int) -> np.ndarray:
        options = {"maxiter": steps, "maxfun": 10 * steps, "ftol": 0.0, "gtol": 0.0}
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

    settings: list[tuple[str, str, Callable[[], np.ndarray]]] = [("scipy.optimize.nnls", "", exact)]
    settings += [("scipy L-BFGS-B", str(steps), lambda steps=steps: quasi_newton(steps)) for steps in STEPS]
    for solver, setting, work in settings:
        answer, first, _ = repeat(work, 0)
        yield solver, setting, first, answer


def compare(name: str, lanes: int) -> None:
    """Print the points of one case and draw them."""
    import jax
    import jax.numpy as jnp

    from sbrdf_jax.multipliers import invert_normal
    from sbrdf_jax.nnls import kkt_residual
    from sbrdf_jax.resampling.normal import normal_equations
    from sbrdf_jax.resampling.paper import solve_normal

    case = load(name)
    if case is None:
        print(f"{name}: absent")
        return
    operator, rhs = normal_equations(*case, 1.0)
    rhs = rhs[:, np.linspace(0, rhs.shape[1] - 1, lanes).round().astype(int)]
    (known, seconds, _) = repeat(lambda: invert_normal(operator), 0)
    print(f"{name}: {rhs.shape[0]} unknowns, {lanes} wavelengths; own set-up {seconds:.2f} s")
    print(f"{'solver':<26} {'setting':>8} {'seconds':>9} {'KKT':>9} {'distance':>9}")
    truth = np.asarray(solve_normal(operator, rhs, FINE, known).value)
    matrix = np.asarray(jax.jit(operator.multiply)(jnp.eye(rhs.shape[0])))
    points = [*own_points(operator, rhs, known), *jaxopt_points(operator, rhs), *scipy_points(matrix, np.asarray(rhs))]
    drawn: dict[str, list[tuple[float, float]]] = {}
    for solver, setting, seconds, answer in points:
        residual = float(np.max(kkt_residual(operator, rhs, jnp.asarray(answer))))
        distance = float(np.linalg.norm(answer - truth) / np.linalg.norm(truth))
        print(f"{solver:<26} {setting:>8} {seconds:>9.3f} {residual:>9.1e} {distance:>9.1e}", flush=True)
        drawn.setdefault(solver, []).append((seconds, residual))
    draw(name, lanes, drawn)


def draw(name: str, lanes: int, points: dict[str, list[tuple[float, float]]]) -> None:
    """Draw KKT residual against seconds."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
    for (solver, line), marker in zip(points.items(), "os^Dvx", strict=False):
        axes.loglog(*zip(*line, strict=True), marker=marker, label=solver)
    axes.set_xlabel(f"seconds, {lanes} wavelengths, warm")
    axes.set_ylabel("relative KKT residual")
    axes.set_title(f"Bounded least squares of method paper: {name}")
    axes.grid(True, which="major", alpha=0.3)
    axes.legend()
    path = Path("results") / f"error_time_{name}.png"
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=120)
    print(f"drawn: {path}\n")


def main() -> None:
    """Compare the solvers on every case that is there."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=["cayman"], help=f"of {', '.join(NAMES)}")
    parser.add_argument("--lanes", type=int, default=4, help="wavelengths")
    args = parser.parse_args()
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    for name in args.names:
        compare(name, args.lanes)


if __name__ == "__main__":
    main()
