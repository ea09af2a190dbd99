"""The solver where the problem is nearly or wholly singular: a true certificate, and an error that it bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import singular_problem

from sbrdf_jax.nnls import DenseNormal, ProjectedNewton, solve_nnls
from sbrdf_jax.records import Status

EPSILON = np.finfo(float).eps
METHOD = ProjectedNewton(tolerance=1e-8)
MIXED = ProjectedNewton(tolerance=1e-8, precision="float32")
CONDITIONS = (1e2, 1e5, 1e8, 1e11, 1e14)


solve = jax.jit(solve_nnls, static_argnames="method")


def plain_residual(matrix, rhs, x) -> np.ndarray:
    """The definition, in NumPy from A'A and A'b."""
    scale = np.sqrt(np.diag(matrix))[:, None]
    gradient = matrix @ x - rhs
    projected = np.where(x > 0, gradient, np.minimum(gradient, 0))
    return np.abs(projected / scale).max(axis=0) / np.abs(rhs / scale).max(axis=0)


@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("method", [METHOD, MIXED], ids=["float64", "mixed"])
def test_the_certificate_is_true_and_bounds_the_error(condition, size, method):
    problem = singular_problem(condition)
    matrix, rhs = problem.matrix.T @ problem.matrix, problem.matrix.T @ problem.target * size
    found = solve(DenseNormal(jnp.asarray(matrix)), jnp.asarray(rhs), method)
    x, residual = np.asarray(found.value), np.asarray(found.residual)
    assert np.isfinite(x).all() and (x >= 0).all()
    np.testing.assert_array_equal(found.status, np.where(residual <= 1e-8, Status.OK, Status.MAX_STEPS))
    rounding = 100 * EPSILON * np.abs(matrix).sum() * np.abs(x).max() / np.abs(rhs).max()
    np.testing.assert_allclose(residual, plain_residual(matrix, rhs, x), rtol=1e-3, atol=rounding)
    # strong monotonicity: |x - x*| <= (1 + L) / mu |p|, for the rounded b as well
    eigenvalues = np.linalg.eigvalsh(matrix)
    unmet = np.sqrt(len(x)) * np.abs(rhs).max(axis=0) * (residual + 100 * EPSILON)
    bound = (1 + eigenvalues[-1]) / max(eigenvalues[0], 1e-300) * unmet
    assert (np.linalg.norm(x - problem.solution * size, axis=0) <= bound).all()


def test_a_hundred_times_more_unknowns_than_rows():
    rng = np.random.default_rng(14)
    wide = rng.standard_normal((4, 400))
    solution = np.where(rng.random((400, 3)) < 0.9, 0.0, rng.uniform(1, 2, (400, 3)))
    found = solve(DenseNormal(jnp.asarray(wide.T @ wide)), jnp.asarray(wide.T @ (wide @ solution)), METHOD)
    assert (np.asarray(found.status) == Status.OK).all() and (np.asarray(found.value) >= 0).all()
    np.testing.assert_allclose(wide @ np.asarray(found.value), wide @ solution, rtol=0, atol=1e-5)


def test_a_singular_matrix_and_columns_of_zeros_end_honestly():
    rng = np.random.default_rng(15)
    thin = rng.uniform(0, 1, (30, 3))
    matrix = np.concatenate([thin, thin, thin + 1e-9 * rng.standard_normal(thin.shape), np.zeros((30, 2))], axis=1)
    target = matrix @ np.ones((11, 2))
    found = solve(DenseNormal(jnp.asarray(matrix.T @ matrix)), jnp.asarray(matrix.T @ target), METHOD)
    assert (np.asarray(found.status) == Status.OK).all()
    np.testing.assert_array_equal(np.asarray(found.value)[9:], 0.0)
    np.testing.assert_allclose(matrix @ np.asarray(found.value), target, rtol=1e-6)
