"""How the pipeline ends on hostile measurements: python -m benchmarks.stability [--method ...] [--output FILE.jsonl].

For every problem of `tests/stress/hostile.py`: the condition number of the matrix that all wavelengths share, the
worst relative KKT residual, the forward error where the truth is known, and the statuses; then the solver alone on
problems of growing condition number, whose solution was planted. `python -m benchmarks.pages` makes a table of a file.
"""

import argparse
import itertools
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.records import machine
from tests.problems import singular_problem
from tests.stress.hostile import METHODS, hostile_problems

COLUMNS = ("problem", "method", "condition", "KKT", "error", "median error", "limit", "status", "honest", "seconds")
CONDITIONS = (1e2, 1e4, 1e6, 1e8, 1e10, 1e12, 1e14)
SOLVER_TOLERANCE = 1e-8

Row = dict[str, Any]


def rows(methods: tuple[str, ...], many_wavelengths: int, only: list[str]) -> Iterator[Row]:
    """Yield the rows of the measurements."""
    from sbrdf_jax.errors import UserError
    from tests.stress.outcomes import TOLERANCE, condition_number, forward_errors, solve

    for problem in hostile_problems(many_wavelengths=many_wavelengths):
        if only and not any(part in problem.name for part in only):
            continue
        for method in methods:
            row: Row = {"problem": problem.name, "method": method}
            start = time.perf_counter()
            try:
                gridded = solve(problem, method).gridded
            except UserError as error:
                expected = problem.refused is not None and problem.refused in str(error)
                yield row | {"status": f"refused: {error}", "honest": expected}
                continue
            seconds = time.perf_counter() - start
            error, median = forward_errors(problem, gridded)
            yield row | {
                "condition": condition_number(problem, method, gridded),
                "error": _known(error),
                "median error": _known(median),
                "limit": problem.max_error.get(method),
                "seconds": seconds,
                **certified(gridded.status, gridded.kkt_residual, TOLERANCE[method]),
            }


def solver_rows() -> Iterator[Row]:
    """Yield the solver's own rows: how far it is from a planted solution."""
    import jax.numpy as jnp

    from sbrdf_jax.nnls import DenseNormal, ProjectedNewton, solve_in_rounds

    for precision, condition in itertools.product(("float64", "float32"), CONDITIONS):
        method = ProjectedNewton(tolerance=SOLVER_TOLERANCE, precision=precision)
        problem = singular_problem(condition)
        matrix, rhs = problem.matrix.T @ problem.matrix, problem.matrix.T @ problem.target
        start = time.perf_counter()
        found = solve_in_rounds(DenseNormal(jnp.asarray(matrix)), jnp.asarray(rhs), method)
        seconds = time.perf_counter() - start
        error = np.linalg.norm(found.value - problem.solution) / np.linalg.norm(problem.solution)
        yield {
            "problem": "planted solution",
            "method": "solver alone" if precision == "float64" else "solver alone, float32 first",
            "condition": float(np.linalg.cond(matrix)),
            "error": float(error),
            "seconds": seconds,
            **certified(found.status, found.residual, SOLVER_TOLERANCE),
        }


def certified(status, residual, tolerance: float) -> Row:
    """The worst residual and the statuses; honest where every status says what its residual says."""
    from sbrdf_jax.records import Status

    status, residual = np.asarray(status), np.asarray(residual)
    honest = np.array_equal(residual <= tolerance, status == Status.OK)
    return {
        "KKT": float(np.max(residual[np.isfinite(residual)], initial=0.0)),
        "status": counted(status),
        "honest": honest,
    }


def counted(status) -> str:
    """Statuses by name, and how many wavelengths ended so."""
    from sbrdf_jax.records import Status

    return ", ".join(
        f"{Status(k).name.lower()} {n}" for k, n in zip(*np.unique(status, return_counts=True), strict=True)
    )


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def main() -> None:
    """Print the table, and write its rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", nargs="*", default=METHODS, choices=METHODS)
    parser.add_argument("--wavelengths", type=int, default=2000, help="of the longest spectrum")
    parser.add_argument("--only", nargs="*", default=[], help="parts of names of problems")
    parser.add_argument("--output", type=Path, help="JSON lines, a row each")
    args = parser.parse_args()
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    found = []
    print(" | ".join(COLUMNS))
    for row in itertools.chain(rows(tuple(args.method), args.wavelengths, args.only), solver_rows()):
        found.append(row)
        cells = (row.get(name) for name in COLUMNS)
        print(" | ".join(f"{cell:.2g}" if isinstance(cell, float) else str(cell or "") for cell in cells), flush=True)
    if args.output:
        shared = {"table": "stability"} | machine()
        args.output.parent.mkdir(parents=True, exist_ok=True)
        args.output.write_text("".join(json.dumps(row | shared) + "\n" for row in found))


if __name__ == "__main__":
    main()
