"""The start from the multipliers: exact where the set at the bound is found, harmless where it is not."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from tolerances import KKT, tolerance

from sbrdf_jax.multipliers import MAX_UNKNOWNS, invert_normal, minimise_on_host, start_from_multipliers
from sbrdf_jax.nnls import DenseNormal, ProjectedNewton, kkt_residual, solve_in_rounds, solve_nnls
from sbrdf_jax.records import Status


def smooth_problem(rng, unknowns=90, lanes=20):
    """Few noisy values of a field with a zero part, and second differences: most lanes have neighbours alike."""
    places = np.linspace(0, 1, unknowns)
    rows = np.exp(-(((rng.uniform(0, 1, 60)[:, None] - places) / 0.03) ** 2))
    wave = np.linspace(0, 2, lanes)
    field = np.maximum(np.sin(9 * places[:, None] + wave), 0) * (1 + wave)
    matrix = np.concatenate([rows, 0.3 * np.diff(np.eye(unknowns), 2, axis=0), 0.02 * np.eye(unknowns)])
    target = np.concatenate([rows @ field, np.zeros((len(matrix) - 60, lanes))])
    target[:60] += 0.05 * rng.standard_normal((60, lanes))
    return matrix, target


def normal(matrix, target):
    return DenseNormal(jnp.asarray(matrix.T @ matrix)), jnp.asarray(matrix.T @ target)


def test_start_is_the_answer_and_scipys(rng):
    matrix, target = smooth_problem(rng)
    operator, rhs = normal(matrix, target)
    start, steps = start_from_multipliers(operator, rhs, invert_normal(operator), 1e-8)
    assert (np.asarray(start) >= 0).all() and (np.asarray(start) == 0).any()
    assert (np.asarray(kkt_residual(operator, rhs, start)) <= tolerance(KKT, float)).all()
    assert steps.max() < 500
    for lane in (0, 7, 19):
        best, _ = scipy.optimize.nnls(matrix, target[:, lane])
        np.testing.assert_allclose(start[:, lane], best, rtol=0, atol=1e-5 * best.max())  # KKT 1e-8 times the condition


@pytest.mark.parametrize("lanes", [1, 2, 9])
def test_zero_positive_and_broken_lanes(rng, lanes):
    matrix, target = smooth_problem(rng, lanes=lanes)
    operator, rhs = normal(matrix, target)
    rhs = jnp.concatenate(
        [rhs, jnp.zeros_like(rhs[:, :1]), jnp.full_like(rhs[:, :1], jnp.nan), -jnp.abs(rhs[:, :1])], 1
    )
    start, _ = start_from_multipliers(operator, rhs, invert_normal(operator), 1e-8)
    assert np.isfinite(start).all() and (start[:, lanes] == 0).all()
    found = solve_in_rounds(operator, rhs, ProjectedNewton(), start=start)
    assert list(np.asarray(found.status)) == [Status.OK] * (lanes + 1) + [Status.NONFINITE, Status.OK]
    assert (np.asarray(found.value)[:, -1] == 0).all()


def test_inverse_is_of_the_scaled_matrix_and_refused_where_there_is_none(rng):
    matrix, target = smooth_problem(rng, unknowns=600)
    operator, _ = normal(matrix, target)
    known = invert_normal(operator)
    scaled = np.asarray(operator.matrix) / np.asarray(known.scale)[:, None] / np.asarray(known.scale)
    np.testing.assert_allclose(scaled @ known.inverse, np.eye(600), rtol=0, atol=1e-8)
    assert invert_normal(DenseNormal(jnp.ones((4, 4)))) is None
    assert invert_normal(DenseNormal(jnp.full((4, 4), jnp.nan))) is None
    assert MAX_UNKNOWNS < 91 * 91 * 181


def test_any_start_leads_to_the_same_answer(rng):
    operator, rhs = normal(*smooth_problem(rng))
    plain = solve_in_rounds(operator, rhs, ProjectedNewton(tolerance=1e-11))
    wild = jnp.asarray(rng.uniform(-1, 1, rhs.shape)).at[0, 0].set(jnp.nan)
    found = solve_in_rounds(operator, rhs, ProjectedNewton(tolerance=1e-11), start=wild)
    np.testing.assert_allclose(found.value, plain.value, rtol=0, atol=1e-7 * float(jnp.max(plain.value)))


def test_host_and_jax_take_the_same_steps(rng):
    operator, rhs = normal(*smooth_problem(rng))
    by_jax = solve_nnls(operator, rhs, ProjectedNewton(tolerance=1e-10))
    by_host, steps = minimise_on_host(np.asarray(operator.matrix), np.asarray(rhs), np.zeros(rhs.shape), 1e-10)
    np.testing.assert_allclose(by_host, by_jax.value, rtol=0, atol=1e-7 * by_host.max())  # 1e-10 times the condition
    assert (np.abs(steps - np.asarray(by_jax.num_steps)) <= 5).all()  # rounding moves the last ones
