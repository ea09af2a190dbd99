"""Method paper: its normal equations, field and flags against plain NumPy and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from problems import scattered_samples
from test_grid import grid_of
from tolerances import KKT, OBJECTIVE, ROUNDING, tolerance

from sbrdf_jax import multipliers
from sbrdf_jax.angles import fold_azimuth
from sbrdf_jax.formats import read
from sbrdf_jax.grid import Grid, make_grid, second_difference_rows
from sbrdf_jax.options import GridOptions, InputOptions, ResampleOptions
from sbrdf_jax.records import RawSamples, Status
from sbrdf_jax.resampling import resample
from sbrdf_jax.resampling.extrapolation import extrapolated_nodes
from sbrdf_jax.resampling.normal import normal_equations

PAPER = ResampleOptions(method="paper", smoothness_weight=1.0, tolerance=1e-8)


def plain_rows(samples: RawSamples, grid: Grid) -> np.ndarray:
    """Eq. (6) as printed, node by node, columns merged by eq. (9)."""
    rows = np.zeros((samples.num_samples, grid.num_unknowns))
    step_i, step_o, step_phi = grid.steps
    for m, theta_i in enumerate(grid.theta_i):
        if grid.interpolate_theta_i:
            weight_i = np.sinc((samples.theta_i - theta_i) / step_i)
        else:
            weight_i = (np.abs(samples.theta_i[:, None] - grid.theta_i).argmin(axis=1) == m).astype(float)
        for n, theta_o in enumerate(grid.theta_o):
            weight_o = np.sinc((samples.theta_o - theta_o) / step_o)
            for k in range(grid.num_phi_o):
                distance = (samples.phi_o - k * step_phi + np.pi) % (2 * np.pi) - np.pi
                weight = weight_i * weight_o * np.sinc(distance / step_phi)
                rows[:, grid.unknown_index[m, n, k]] += weight
    return rows


CASES = {
    "few incidences, folded": ([0.0, 20.0, 50.0, 80.0], True, None),
    "few incidences, whole circle": ([5.0, 20.0, 50.0, 80.0], False, None),
    "scattered incidences": (list(np.linspace(1, 84, 40)), True, None),
    "two measured incidences, nothing between": ([0.0, 40.0], True, np.deg2rad([0.0, 40.0])),
}


@pytest.mark.parametrize("case", CASES)
def test_normal_equations_equal_the_plain_matrix(case, rng):
    theta_i_deg, bilateral, axis = CASES[case]
    samples = scattered_samples(rng, theta_i_deg, 9, 3)
    grid = grid_of(5, 12, bilateral=bilateral, theta_i=axis)
    operator, rhs = normal_equations(samples, grid, 0.7)
    rows, smooth = plain_rows(samples, grid), 0.7 * second_difference_rows(grid).toarray()
    expected = rows.T @ rows + smooth.T @ smooth
    x = rng.standard_normal((grid.num_unknowns, 2))
    limit = tolerance(ROUNDING, float) * np.abs(expected).max() * 10
    np.testing.assert_allclose(operator.multiply(jnp.asarray(x)), expected @ x, rtol=0, atol=limit)
    np.testing.assert_allclose(operator.diagonal(), np.diag(expected), rtol=0, atol=limit)
    np.testing.assert_allclose(rhs, rows.T @ samples.value, rtol=0, atol=limit)


def test_field_is_scipys_non_negative_least_squares(rng):
    samples = scattered_samples(rng, [0.0, 30.0, 60.0], 40, 2)
    grid = make_grid(samples, GridOptions(30.0, 22.5, 45.0), bilateral=True)
    found = resample(samples, grid, PAPER)
    matrix = np.concatenate([plain_rows(samples, grid), second_difference_rows(grid).toarray()])
    target = np.concatenate([samples.value, np.zeros((len(matrix) - samples.num_samples, 2))])
    for lane in range(2):
        best, norm = scipy.optimize.nnls(matrix, target[:, lane])
        np.testing.assert_allclose(found.brdf[..., lane], grid.scatter(best), atol=1e-6)
        x = np.zeros(grid.num_unknowns)
        x[grid.unknown_index] = np.asarray(found.brdf[:, :, :-1, lane])
        objective = np.sum((matrix @ x - target[:, lane]) ** 2)
        assert objective - norm**2 <= tolerance(OBJECTIVE, float) * norm**2
    assert (np.asarray(found.brdf) >= 0).all()


@pytest.mark.parametrize("most_unknowns", [0, 6000], ids=["steps from 0", "from the multipliers"])
def test_float32_first_ends_at_the_same_certificate(rng, monkeypatch, most_unknowns):
    monkeypatch.setattr(multipliers, "MAX_UNKNOWNS", most_unknowns)
    samples = scattered_samples(rng, [0.0, 30.0, 60.0], 40, 2)
    grid = make_grid(samples, GridOptions(30.0, 22.5, 45.0), bilateral=True)
    whole, mixed = resample(samples, grid, PAPER), resample(samples, grid, PAPER, precision="float32")
    assert (np.asarray(mixed.kkt_residual) <= tolerance(KKT, float)).all() and (np.asarray(mixed.brdf) >= 0).all()
    np.testing.assert_allclose(mixed.brdf, whole.brdf, rtol=0, atol=1e-5 * np.max(whole.brdf))
    assert np.asarray(mixed.brdf).dtype == np.float64


def test_a_dead_wavelength_fails_alone(rng):
    samples = scattered_samples(rng, [0.0, 30.0, 60.0], 40, 3)
    samples.value[:, 1] = np.nan
    grid = make_grid(samples, GridOptions(30.0, 30.0, 45.0), bilateral=True)
    found = resample(samples, grid, PAPER)
    assert list(np.asarray(found.status)) == [Status.OK, Status.NONFINITE, Status.OK]
    assert np.isfinite(found.brdf[..., [0, 2]]).all() and np.isnan(found.brdf[..., 1]).all()


def test_a_second_measurement_of_equal_geometry_compiles_nothing(rng):
    samples = scattered_samples(rng, [0.0, 30.0, 60.0], 40, 3)
    grid = make_grid(samples, GridOptions(30.0, 30.0, 45.0), bilateral=True)
    resample(samples, grid, PAPER)
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(lambda event, _s, **_kw: compiled.append(event))
    samples.value[:] *= 2.0
    resample(samples, grid, PAPER)
    assert not [event for event in compiled if "compile" in event]


@pytest.mark.parametrize("name", ["acryl_blue", "cayman", "garnet_red"])
def test_cornell_every_wavelength_is_certified(name, shared):
    path = shared(f"data/cornell/{name}.brdf")
    samples = read(str(path), InputOptions(path=str(path)))
    grid = make_grid(samples, GridOptions(), bilateral=True)
    found = resample(samples, grid, PAPER)
    assert found.brdf.shape == (13, 13, 49, 31)
    assert (np.asarray(found.kkt_residual) <= tolerance(KKT, float)).all()
    assert (np.asarray(found.status) == Status.OK).all()
    assert (np.asarray(found.num_steps) < 5_000).all()
    assert (np.asarray(found.brdf) >= 0).all()


def test_flags_say_where_the_data_stand(rng):
    samples = scattered_samples(rng, [10.0, 30.0, 60.0], 600, 1, half=True)
    grid = make_grid(samples, GridOptions(15.0, 15.0, 15.0), bilateral=False)
    flags = extrapolated_nodes(samples, grid)
    theta_i = np.rad2deg(grid.theta_i)
    assert flags.shape == (7, 7, 25) and flags.dtype == np.uint8
    assert (flags[theta_i > 60] == 2).all() and (flags[theta_i < 10] == 2).all()
    assert (flags[2][1:, 4:9] == 2).all()  # phi_o 60 to 120 degrees: the half plane that was not measured
    assert (flags[2][1:6, 16:21] == 0).all()
    folded = extrapolated_nodes(samples, make_grid(samples, GridOptions(15.0, 15.0, 15.0), bilateral=True))
    assert (folded[2][1:6, 4:9] == 0).all()  # a sample stands for its mirror twin
    assert fold_azimuth(samples.phi_o).max() <= np.pi
