"""How the pipeline ends on hostile measurements: python -m benchmarks.stability [--method ...] [--output FILE.md].

For every problem of `tests/stress/hostile.py`: the condition number of the matrix that all wavelengths share, the
worst relative KKT residual, the forward error where the truth is known, and the statuses; then the solver alone on
problems of growing condition number, whose solution was planted.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tests.problems import singular_problem
from tests.stress.hostile import METHODS, hostile_problems

COLUMNS = ("problem", "method", "condition", "KKT", "forward error", "median error", "status", "seconds")
HEAD = f"| {' | '.join(COLUMNS)} |\n" + "|---" * len(COLUMNS) + "|"
CONDITIONS = (1e2, 1e4, 1e6, 1e8, 1e10, 1e12, 1e14)


def rows(methods: tuple[str, ...], many_wavelengths: int, only: list[str]) -> Iterator[str]:
    """Yield the lines of the table of measurements."""
    from sbrdf_jax.errors import UserError
    from tests.stress.outcomes import condition_number, forward_errors, solve

    for problem in hostile_problems(many_wavelengths=many_wavelengths):
        if only and not any(part in problem.name for part in only):
            continue
        for method in methods:
            start = time.perf_counter()
            try:
                gridded = solve(problem, method).gridded
            except UserError as error:
                yield f"| {problem.name} | {method} | | | | | refused: {error} | |"
                continue
            seconds = time.perf_counter() - start
            condition = condition_number(problem, method, gridded)
            error, median = forward_errors(problem, gridded)
            residual = np.nanmax(np.asarray(gridded.kkt_residual))
            numbers = f"{condition:.1e} | {residual:.1e} | {_number(error)} | {_number(median)}"
            yield f"| {problem.name} | {method} | {numbers} | {counted(gridded.status)} | {seconds:.1f} |"


def solver_rows() -> Iterator[str]:
    """Yield the lines of the solver's own table."""
    import jax.numpy as jnp

    from sbrdf_jax.nnls import DenseNormal, ProjectedNewton, solve_in_rounds

    for condition in CONDITIONS:
        problem = singular_problem(condition)
        matrix, rhs = problem.matrix.T @ problem.matrix, problem.matrix.T @ problem.target
        start = time.perf_counter()
        found = solve_in_rounds(DenseNormal(jnp.asarray(matrix)), jnp.asarray(rhs), ProjectedNewton(tolerance=1e-8))
        seconds = time.perf_counter() - start
        error = np.linalg.norm(found.value - problem.solution) / np.linalg.norm(problem.solution)
        residual = np.max(np.asarray(found.residual))
        yield (
            f"| planted solution | solver alone | {np.linalg.cond(matrix):.1e} | {residual:.1e} | {error:.2g} | "
            f"| {counted(found.status)} | {seconds:.1f} |"
        )


def counted(status) -> str:
    """Statuses by name, and how many wavelengths ended so."""
    from sbrdf_jax.records import Status

    return ", ".join(
        f"{Status(k).name.lower()} {n}" for k, n in zip(*np.unique(status, return_counts=True), strict=True)
    )


def _number(value: float) -> str:
    return f"{value:.2g}" if np.isfinite(value) else ""


def main() -> None:
    """Print the table, and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", nargs="*", default=METHODS, choices=METHODS)
    parser.add_argument("--wavelengths", type=int, default=2000, help="of the longest spectrum")
    parser.add_argument("--only", nargs="*", default=[], help="parts of names of problems")
    parser.add_argument("--output", type=Path, help="a Markdown file")
    args = parser.parse_args()
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    lines = [HEAD]
    print(HEAD)
    for line in (*rows(tuple(args.method), args.wavelengths, args.only), *solver_rows()):
        lines.append(line)
        print(line, flush=True)
    if args.output:
        args.output.parent.mkdir(parents=True, exist_ok=True)
        args.output.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
