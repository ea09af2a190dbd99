"""Measurements that try to break the pipeline: the right answer, an honest status or one clear line."""

import numpy as np
import pytest

from sbrdf_jax.cleaning import clean
from sbrdf_jax.errors import UserError
from sbrdf_jax.evaluation import evaluate_in_chunks
from sbrdf_jax.records import Status
from tests.stress.hostile import METHODS, HostileProblem, hostile_problems
from tests.stress.outcomes import TOLERANCE, forward_errors, solve

PROBLEMS = hostile_problems()
SOLVED = [problem for problem in PROBLEMS if problem.refused is None]
REFUSED = [problem for problem in PROBLEMS if problem.refused is not None]
THETA, PHI = np.deg2rad([0.0, 40.0, 89.99, 90.0]), np.deg2rad([0.0, 90.0, 180.0])
EDGES = [angle.ravel() for angle in np.meshgrid(THETA, THETA, PHI)]


CASES = [
    pytest.param(
        problem, method, id=f"{problem.name}, {method}", marks=[pytest.mark.slow] * (method in problem.own_shape)
    )
    for problem in SOLVED
    for method in METHODS
]


@pytest.mark.parametrize(("problem", "method"), CASES)
def test_every_stage_ends_well_or_says_that_it_did_not(problem: HostileProblem, method):
    found = solve(problem, method)
    gridded, live = found.gridded, problem.expected_status() != Status.NONFINITE
    status, residual = np.asarray(gridded.status), np.asarray(gridded.kkt_residual)
    if problem.may_give_up:
        assert np.isin(status, (Status.OK, Status.MAX_STEPS)).all()
    else:
        np.testing.assert_array_equal(status, problem.expected_status())
    # a status says what its residual says, and a lane that failed is nan: it cannot be taken for an answer
    np.testing.assert_array_equal(residual[live] <= TOLERANCE[method], status[live] == Status.OK)
    brdf = np.asarray(gridded.brdf)
    assert np.isfinite(brdf[..., live]).all() and (brdf[..., live] >= 0).all()
    assert np.isnan(brdf[..., ~live]).all()
    assert np.isfinite(found.field.coefficient).all()
    for stage in (gridded, found.compact):  # at the edges, where nothing was measured, too
        value = evaluate_in_chunks(stage, *EDGES)[:, live if stage is gridded else slice(None)]
        assert np.isfinite(value).all()
        assert method == "paper" or (value >= 0).all()
    error, median = forward_errors(problem, gridded)
    assert not error > problem.max_error.get(method, np.inf)
    assert not median > problem.max_median.get(method, np.inf)


@pytest.mark.parametrize("problem", REFUSED, ids=lambda p: p.name)
def test_what_holds_nothing_is_refused_in_one_line(problem):
    with pytest.raises(UserError, match=problem.refused) as caught:
        clean(problem.samples)
    assert "\n" not in str(caught.value)
