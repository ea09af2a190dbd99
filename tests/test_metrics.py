"""Scores against plain NumPy, and on fields whose scores are known."""

import dataclasses

import numpy as np
import pytest
from small_results import UNIFORM_NM, constant_compact, small_compact, small_field, small_grid
from tolerances import ROUNDING, tolerance

from sbrdf_jax import metrics
from sbrdf_jax.encoding import decode, encode
from sbrdf_jax.evaluation import evaluate_in_chunks
from sbrdf_jax.records import Status

ROUND = tolerance(ROUNDING, np.float64)


@pytest.fixture(autouse=True)
def few_random_directions(monkeypatch):
    monkeypatch.setattr(metrics, "NUM_RANDOM_DIRECTIONS", 512)
    monkeypatch.setattr(metrics, "CHUNK_SIZE", 128)


def eta(reconstructed, original):
    """Eq. (18) as printed, one incident angle."""
    return np.sqrt(((reconstructed - original) ** 2).sum() / (original**2).sum())


def grid_of(compact, rng):
    """A grid whose nodes are a compact form's values."""
    grid = small_grid(rng, wavelength_nm=np.asarray(compact.basis.wavelength_nm))
    mesh = np.meshgrid(grid.theta_i, grid.theta_o, grid.phi_o, indexing="ij")
    return dataclasses.replace(grid, brdf=evaluate_in_chunks(compact, *mesh, chunk_size=128))


def test_relative_error_is_zero_over_zero_and_infinite_over_zero():
    found = metrics.relative_error([0.0, 1.0, 4.0], [0.0, 0.0, 16.0])
    np.testing.assert_array_equal(found, [0.0, np.inf, 0.5])
    deviation = metrics.relative_deviation(np.array([0.0, 1.0, 3.0]), np.array([0.0, 0.0, 2.0]))
    np.testing.assert_array_equal(deviation, [0.0, np.inf, 0.5])


def test_errors_at_and_between_nodes_are_eq_18(rng):
    compact = small_compact(rng)
    grid = small_grid(rng, wavelength_nm=UNIFORM_NM)
    found = metrics.measure(grid, None, compact).value
    middle = {axis: metrics.midpoints(getattr(grid, axis)) for axis in ("theta_i", "theta_o", "phi_o")}

    def both(theta_i, theta_o, phi_o):
        mesh = np.meshgrid(theta_i, theta_o, phi_o, indexing="ij")
        return [evaluate_in_chunks(result, *mesh, chunk_size=128) for result in (compact, grid)]

    reconstructed, original = both(grid.theta_i, grid.theta_o, grid.phi_o)
    np.testing.assert_allclose(found["relative_error"], list(map(eta, reconstructed, original)), rtol=1e3 * ROUND)
    np.testing.assert_allclose(found["relative_error_overall"], eta(reconstructed, original), rtol=1e3 * ROUND)
    share = abs(reconstructed / original - 1)
    np.testing.assert_allclose(found["median_relative_error"], np.median(share, axis=(1, 2, 3)), rtol=1e3 * ROUND)
    np.testing.assert_allclose(found["median_relative_error_overall"], np.median(share), rtol=1e3 * ROUND)
    pairs = both(grid.theta_i, middle["theta_o"], middle["phi_o"])
    np.testing.assert_allclose(found["relative_error_between"], list(map(eta, *pairs)), rtol=1e3 * ROUND)
    pairs = both(*middle.values())
    assert found["relative_error_between_theta_i"].shape == (4,)
    np.testing.assert_allclose(found["relative_error_between_theta_i"], list(map(eta, *pairs)), rtol=1e3 * ROUND)


def test_a_perfect_compact_form_has_no_error_and_no_colour_difference(rng):
    compact = small_compact(rng)
    grid = grid_of(compact, rng)
    found = metrics.measure(grid, small_field(grid), compact).value
    for name in ("relative_error", "median_relative_error", "error_spectral", "error_background", "error_lobe"):
        np.testing.assert_allclose(found[name], 0, atol=1e3 * ROUND)
    np.testing.assert_allclose(found["delta_e_max"], 0, atol=1e-6)


def test_the_split_puts_each_error_where_it_was_made(rng):
    compact = small_compact(rng)
    compact = dataclasses.replace(compact, lobe_kind=np.full((5, 5), 1), critical_angle=np.full((5, 5), 0.5))
    grid = grid_of(compact, rng)
    field = small_field(grid)

    ripple = 0.1 * np.cos(2 * np.pi * 4 * np.linspace(0, 1, 11)) * np.sin(np.linspace(0, np.pi, 11))
    beyond = ripple - np.asarray(decode(encode(ripple, field.basis), field.basis))  # what 5 coefficients cannot carry
    spectral = metrics.error_split(compact, field, dataclasses.replace(grid, brdf=grid.brdf + beyond))
    assert (spectral["error_spectral"] > 1e-3).all()
    np.testing.assert_allclose(spectral["error_lobe"], 0, atol=1e3 * ROUND)
    np.testing.assert_allclose(spectral["error_background"], 0, atol=1e3 * ROUND)

    higher = dataclasses.replace(compact, lobe_height=1.1 * compact.lobe_height, lobe_width=np.full((5, 5), 0.01))
    grid = grid_of(dataclasses.replace(higher, lobe_height=compact.lobe_height), rng)
    lobe = metrics.error_split(higher, small_field(grid), grid)
    assert (lobe["error_lobe"][1:] > 100 * lobe["error_background"][1:]).all()

    lifted = dataclasses.replace(compact, background=compact.background * 1.1, lobe_kind=np.zeros((5, 5), int))
    lifted = dataclasses.replace(lifted, critical_angle=np.full((5, 5), np.nan))
    grid = grid_of(dataclasses.replace(lifted, background=compact.background), rng)
    background = metrics.error_split(lifted, small_field(grid), grid)
    np.testing.assert_array_equal(background["error_lobe"], 0)
    np.testing.assert_allclose(background["error_background"], 0.1, rtol=1e-6)


def test_compression_as_the_paper_counts_and_as_it_is():
    wavelength_nm = np.linspace(380, 780, 101)
    rng = np.random.default_rng(1)
    compact = small_compact(
        rng, theta_i=np.linspace(0, np.pi / 2, 13), coefficients=19, max_degree=4, wavelength_nm=wavelength_nm
    )
    found = metrics.compression(compact)
    assert found["compression_ratio_paper"] == 13 * 49 * 101 / ((25 + 2) * 19)
    assert round(found["compression_ratio_paper"]) == 125
    numbers = 13 * (19 * (25 + 5) + 2) + 101 + 19 + 25
    assert metrics.stored_numbers(compact) == numbers
    assert found["compression_ratio"] == 13 * 13 * 49 * 101 / numbers


def test_negative_values_are_counted_and_measured():
    value = np.where(np.arange(11) < 4, -0.25, 1.0)
    share, depth, _ = metrics.off_node_scores(constant_compact(value))
    np.testing.assert_allclose([share, depth], [4 / 11, 0.25], rtol=1e-12)
    assert metrics.off_node_scores(constant_compact(np.ones(11)))[:2] == (0.0, 0.0)


def test_albedo_of_a_diffuser_is_its_reflectance():
    reflectance = np.linspace(0.1, 1.2, 11)
    compact = constant_compact(reflectance / np.pi)
    found = metrics.albedo(compact)
    np.testing.assert_allclose(found, np.broadcast_to(reflectance, (5, 11)), rtol=1e-12)
    warnings = metrics.albedo_warnings(found, compact, "compact")
    assert len(warnings) == 5
    assert warnings[1] == (
        "compact stage, theta_i 22.5 degrees: albedo up to 1.2 at 780 nm, above 1 at 2 of 11 wavelengths: "
        "it creates energy"
    )


def test_albedo_of_the_grid_is_that_of_a_dense_quadrature(rng):
    grid = small_grid(rng)
    theta_o, phi_o = (np.arange(400) + 0.5) * np.pi / 800, (np.arange(180) + 0.5) * np.pi / 90
    mesh = np.meshgrid(theta_o, phi_o, indexing="ij")
    value = evaluate_in_chunks(grid, grid.theta_i[2], *mesh, chunk_size=8192)
    weight = np.sin(theta_o) * np.cos(theta_o) * np.pi / 800 * np.pi / 90
    expected = np.einsum("a,abw->w", weight, value)
    np.testing.assert_allclose(metrics.albedo(grid)[2], expected, rtol=1e-3)  # noise on steps of 30 degrees


def test_reciprocity_error_sees_what_is_not_reciprocal(rng):
    assert metrics.off_node_scores(constant_compact(np.ones(11)))[2] < 1e3 * ROUND
    grid = small_grid(rng, window="none")
    symmetric = (grid.brdf + np.swapaxes(grid.brdf[:, :, ::-1], 0, 1)) / 2  # f(i, o, phi) and f(o, i, -phi)
    assert metrics.off_node_scores(dataclasses.replace(grid, brdf=symmetric))[2] < 1e3 * ROUND
    assert metrics.off_node_scores(grid)[2] > 0.1
    assert np.isnan(metrics.off_node_scores(small_grid(rng, interpolate_theta_i=False))[2])


def test_few_incident_angles_have_no_error_midway(rng):
    grid = small_grid(rng, interpolate_theta_i=False, wavelength_nm=UNIFORM_NM)
    compact = small_compact(rng, theta_i=grid.theta_i, interpolate_theta_i=False)
    found = metrics.measure(grid, small_field(grid), compact).value
    np.testing.assert_array_equal(np.isnan(found["relative_error_between_theta_i"]), [True])
    assert np.isfinite(found["relative_error_between"]).all()


def test_a_lane_that_failed_does_not_spoil_the_scores(rng):
    compact = small_compact(rng, kind="identity", wavelength_nm=np.delete(UNIFORM_NM, 3))
    grid = small_grid(rng, wavelength_nm=UNIFORM_NM)
    brdf, status = grid.brdf.copy(), grid.status.copy()
    brdf[..., 3], status[3] = np.nan, Status.NONFINITE
    failed = dataclasses.replace(grid, brdf=brdf, status=status)
    found = metrics.measure(failed, None, compact)
    for name in ("relative_error", "relative_error_between", "delta_e_median", "negative_share_grid"):
        assert np.isfinite(found.value[name]).all(), name
    only = np.arange(11) != 3
    reconstructed = evaluate_in_chunks(compact, *np.meshgrid(grid.theta_i, grid.theta_o, grid.phi_o, indexing="ij"))
    expected = [eta(r, o[..., only]) for r, o in zip(reconstructed, grid.brdf, strict=True)]
    np.testing.assert_allclose(found.value["relative_error"], expected, rtol=1e3 * ROUND)


def test_what_is_relative_only_warns_of_no_energy(rng):
    grid = small_grid(rng, wavelength_nm=UNIFORM_NM)
    bright = dataclasses.replace(grid, brdf=grid.brdf * 10)
    assert any("creates energy" in text for text in metrics.measure(bright).warnings)
    assert not metrics.measure(bright, absolute=False).warnings


def test_every_metric_is_named_in_the_shape_that_the_result_file_expects(rng):
    grid = small_grid(rng, wavelength_nm=UNIFORM_NM)
    found = metrics.measure(grid, small_field(grid), small_compact(rng)).value
    size = {"theta_i": 5, "theta_i_between": 4, "wavelength": 11}
    for name, value in found.items():
        axes = metrics.METRIC_AXES.get(name, ("theta_i",) * value.ndim)
        assert value.shape == tuple(size[axis] for axis in axes), name
    assert set(metrics.METRIC_AXES) <= set(found)
