"""The batched solver: certificates, planted answers, SciPy's answers, lanes, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from problems import LeastSquaresProblem, least_squares_problems
from tolerances import GRADIENT, KKT, LANE, OBJECTIVE, PLANTED, ROUNDING, tolerance

from sbrdf_jax import nnls
from sbrdf_jax.nnls import (
    DenseNormal,
    JaxoptProjectedGradient,
    ProjectedNewton,
    kkt_residual,
    solve_in_rounds,
)
from sbrdf_jax.records import Status

solve_nnls = jax.jit(nnls.solve_nnls, static_argnames="method")

TOLERANCE = 1e-11
METHODS = {
    "projected Newton": ProjectedNewton(tolerance=TOLERANCE, max_steps=50_000),
    "projected Newton, float32 first": ProjectedNewton(tolerance=TOLERANCE, max_steps=50_000, precision="float32"),
    "jaxopt": JaxoptProjectedGradient(tolerance=1e-14, max_steps=20_000),
}
PRECISIONS = pytest.mark.parametrize("precision", ["float64", "float32"])
PROBLEMS = least_squares_problems()


def normal(problem: LeastSquaresProblem):
    return DenseNormal(jnp.asarray(problem.matrix.T @ problem.matrix)), jnp.asarray(problem.matrix.T @ problem.target)


def objective(problem: LeastSquaresProblem, x: np.ndarray) -> np.ndarray:
    return 0.5 * ((problem.matrix @ x - problem.target) ** 2).sum(axis=0)


def plain_kkt_residual(problem: LeastSquaresProblem, x: np.ndarray) -> np.ndarray:
    """The definition, written from the matrix rather than the normal equations."""
    scale = np.linalg.norm(problem.matrix, axis=0)[:, None]
    gradient = problem.matrix.T @ (problem.matrix @ x - problem.target)
    projected = np.where(x > 0, gradient, np.minimum(gradient, 0))
    size = np.abs(problem.matrix.T @ problem.target / scale).max(axis=0)
    return np.abs(projected / scale).max(axis=0) / np.where(size > 0, size, 1.0)


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
def test_proves_its_answer_and_equals_scipy(problem, method):
    found = solve_nnls(*normal(problem), method)
    x = np.asarray(found.value)
    assert (x >= 0).all()
    np.testing.assert_allclose(found.residual, plain_kkt_residual(problem, x), rtol=1e-3, atol=1e-14)
    loosest = TOLERANCE if isinstance(method, ProjectedNewton) else 1e-6  # jaxopt has its own measure
    assert (np.asarray(found.residual) <= loosest).all()
    if isinstance(method, ProjectedNewton):
        assert (np.asarray(found.status) == Status.OK).all()
        assert (np.asarray(found.num_steps) < 20_000).all()
    reference = np.stack([scipy.optimize.nnls(problem.matrix, b)[0] for b in problem.target.T], axis=1)
    best, size = objective(problem, reference), 0.5 * (problem.target**2).sum(axis=0)
    assert (objective(problem, x) - best <= tolerance(OBJECTIVE, float) * np.maximum(best, size)).all()
    if problem.solution is not None and isinstance(method, ProjectedNewton):
        scale = np.linalg.norm(problem.matrix, axis=0)[:, None]  # the residual bounds the scaled unknowns
        error = np.abs(scale * (x - problem.solution)).max() / np.abs(scale).max()
        assert error <= tolerance(PLANTED, float) * (1e2 if "correlated" in problem.name else 1)  # by its condition


def test_residual_judges_what_it_is_given():
    problem = PROBLEMS[0]
    operator, rhs = normal(problem)
    x = np.abs(problem.solution) + 0.1
    np.testing.assert_allclose(kkt_residual(operator, rhs, jnp.asarray(x)), plain_kkt_residual(problem, x), rtol=1e-10)
    x[0, 0] = -1e-9
    assert np.asarray(kkt_residual(operator, rhs, jnp.asarray(x)))[0] == np.inf


def test_a_lane_alone_equals_the_lane_in_a_batch():
    operator, rhs = normal(PROBLEMS[5])
    method = ProjectedNewton(tolerance=1e-8)
    together = solve_nnls(operator, rhs, method)
    for lane in range(rhs.shape[1]):
        alone = solve_nnls(operator, rhs[:, lane : lane + 1], method)
        np.testing.assert_allclose(alone.value[:, 0], together.value[:, lane], rtol=0, atol=tolerance(LANE, float))
        assert alone.num_steps[0] == together.num_steps[lane]


def test_a_bad_lane_spoils_no_other():
    operator, rhs = normal(PROBLEMS[0])
    bad = rhs.at[3, 1].set(jnp.nan).at[0, 2].set(jnp.inf)
    good, found = solve_nnls(operator, rhs), solve_nnls(operator, bad)
    assert list(np.asarray(found.status)) == [Status.OK, Status.NONFINITE, Status.NONFINITE, Status.OK]
    assert np.isnan(found.value[:, 1]).all() and np.isnan(found.residual[1])
    np.testing.assert_allclose(found.value[:, [0, 3]], good.value[:, [0, 3]], rtol=0, atol=tolerance(LANE, float))


@PRECISIONS
@pytest.mark.parametrize("factor", [1e-60, 1e-12, 1e-6, 1e6, 1e12, 1e60])
def test_scaling_the_data_scales_the_answer(factor, precision):
    operator, rhs = normal(PROBLEMS[0])
    method = ProjectedNewton(precision=precision)
    plain, scaled = solve_nnls(operator, rhs, method), solve_nnls(operator, rhs * factor, method)
    assert (np.asarray(plain.status) == Status.OK).all()
    np.testing.assert_allclose(scaled.value / factor, plain.value, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(scaled.status, plain.status)


def test_step_limit_is_a_status_not_a_success():
    operator, rhs = normal(PROBLEMS[2])
    found = solve_nnls(operator, rhs, ProjectedNewton(tolerance=1e-12, max_steps=5))
    assert (np.asarray(found.status) == Status.MAX_STEPS).all()
    assert (np.asarray(found.residual) > 1e-12).all()


@PRECISIONS
def test_rounds_are_the_same_solver_and_report(precision):
    operator, rhs = normal(PROBLEMS[2])
    method, seen = ProjectedNewton(tolerance=1e-10, precision=precision), []
    rounds = solve_in_rounds(operator, rhs, method, lambda done, total: seen.append((done, total)))
    plain = solve_nnls(operator, rhs, method)
    np.testing.assert_allclose(rounds.value, plain.value, rtol=0, atol=tolerance(ROUNDING, float))
    np.testing.assert_array_equal(rounds.num_steps, plain.num_steps)
    assert seen[-1] == (3, 3) and all(total == 3 for _, total in seen)


def test_most_steps_are_in_float32_where_they_may_be():
    operator, rhs = normal(PROBLEMS[2])
    start = jnp.zeros_like(rhs)
    single, target, begun = nnls._in_float32(operator, rhs, start)
    assert single.matrix.dtype == target.dtype == begun.dtype == np.float32
    whole = solve_nnls(operator, rhs, ProjectedNewton())
    mixed = solve_nnls(operator, rhs, ProjectedNewton(precision="float32"))
    rest = solve_nnls(operator, rhs, ProjectedNewton(), mixed.value)
    assert mixed.value.dtype == np.float64 and not np.asarray(rest.num_steps).any()
    first = nnls.solve_nnls(single, target, ProjectedNewton(tolerance=nnls.FLOAT32_TOLERANCE), begun)
    assert (np.asarray(first.num_steps) > 0.3 * np.asarray(mixed.num_steps)).all()
    np.testing.assert_allclose(mixed.value, whole.value, rtol=0, atol=tolerance(KKT, float) * np.abs(whole.value).max())


@PRECISIONS
def test_rounds_stop_at_a_bad_lane_and_at_the_limit(precision):
    operator, rhs = normal(PROBLEMS[2])
    bad = solve_in_rounds(operator, rhs.at[0, 0].set(jnp.nan), ProjectedNewton(precision=precision))
    assert list(np.asarray(bad.status)) == [Status.NONFINITE, Status.OK, Status.OK]
    stopped = solve_in_rounds(operator, rhs, ProjectedNewton(tolerance=1e-15, max_steps=5))
    assert (np.asarray(stopped.num_steps) == 5).all() and (np.asarray(stopped.status) == Status.MAX_STEPS).all()


@PRECISIONS
def test_derivatives_are_those_of_the_solution(precision):
    matrix, target = jnp.asarray(PROBLEMS[0].matrix), jnp.asarray(PROBLEMS[0].target[:, :2])
    direction = jnp.asarray(np.random.default_rng(1).standard_normal(matrix.shape))

    def loss(t, b):
        moved = matrix + t * direction
        found = solve_nnls(DenseNormal(moved.T @ moved), moved.T @ b, ProjectedNewton(1e-13, precision=precision))
        return jnp.sum(jnp.sin(found.value))

    by_matrix, by_data = jax.grad(loss, argnums=(0, 1))(jnp.asarray(0.0), target)
    step = 1e-5
    difference = (loss(jnp.asarray(step), target) - loss(jnp.asarray(-step), target)) / (2 * step)
    np.testing.assert_allclose(by_matrix, difference, rtol=tolerance(GRADIENT, float))
    bump = jnp.zeros_like(target).at[4, 1].set(step)
    difference = (loss(jnp.asarray(0.0), target + bump) - loss(jnp.asarray(0.0), target - bump)) / (2 * step)
    np.testing.assert_allclose(by_data[4, 1], difference, rtol=tolerance(GRADIENT, float), atol=1e-9)


def test_vmap_over_problems():
    operator, rhs = normal(PROBLEMS[0])
    batched = jax.vmap(lambda b: solve_nnls(operator, b[:, None]).value[:, 0], in_axes=1, out_axes=1)(rhs)
    np.testing.assert_allclose(batched, solve_nnls(operator, rhs).value, rtol=0, atol=1e-9)
