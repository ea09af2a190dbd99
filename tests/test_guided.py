"""The guided method: its closed forms against refits, its promises at the edges, and held-out measured samples."""

import csv
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.records import RawSamples
from sbrdf_jax.resampling.guided import evaluate_guided, evaluate_standard_error, fit_guided
from sbrdf_jax.resampling.guided.coordinates import from_log, guided_coordinates, to_log
from sbrdf_jax.resampling.guided.error_model import estimate_floor, noise_factors
from sbrdf_jax.resampling.guided.kernel import (
    MEASURED_KERNELS,
    covariance,
    factorise,
    invert,
    leave_one_out,
    solve_dual,
)
from sbrdf_jax.resampling.guided.lobe_model import LobeModel, fit_lobe_model, lobe_log_value, lobe_terms
from sbrdf_jax.resampling.guided.merging import merge_samples
from sbrdf_jax.resampling.guided.smoothing import leave_group_out

LIMIT = jnp.asarray(np.deg2rad([85.0, 85.0]))


def glossy(theta_i, theta_o, phi_o):
    """A smooth gloss on a diffuse base, two wavelengths [1/sr]."""
    cos_beta = np.cos(theta_i) * np.cos(theta_o) - np.sin(theta_i) * np.sin(theta_o) * np.cos(phi_o)
    lobe = np.exp((cos_beta - 1) / 0.05)
    return np.stack([0.1 + 0.5 * lobe, 0.03 + 0.5 * lobe], axis=-1)


def measurement(rng, num=300, noise=0.005, scale=1.0) -> RawSamples:
    """A simulated run of six incident angles."""
    theta_i = np.deg2rad(rng.choice([10.0, 20.0, 30.0, 40.0, 55.0, 70.0], num))
    theta_o, phi_o = np.deg2rad(75.0) * np.sqrt(rng.random(num)), 2 * np.pi * rng.random(num)
    value = scale * glossy(theta_i, theta_o, phi_o) * (1 + noise * rng.standard_normal((num, 2)))
    return RawSamples(
        theta_i, theta_o, phi_o, np.array([500.0, 600.0]), value, np.arange(num), "brdf", "simulated", "builtin", "0"
    )


@pytest.fixture(scope="module")
def fitted():
    samples = measurement(np.random.default_rng(7))
    return samples, *fit_guided(samples, ResampleOptions(method="guided"))


def random_problem(rng, num=40):
    at = guided_coordinates(*(jnp.asarray(rng.uniform(0.05, 1.3, num)) for _ in range(3)), LIMIT)
    return at, jnp.asarray(rng.standard_normal((num, 3))), jnp.asarray(rng.uniform(1e-3, 1e-1, num))


def test_half_angle_is_accurate_at_the_mirror():
    theta = np.deg2rad(50.0)
    offset = 1e-6
    at = guided_coordinates(jnp.asarray(theta), jnp.asarray(theta + offset), jnp.asarray(np.pi), LIMIT)
    assert np.expm1(float(at.half)) == pytest.approx(np.rad2deg(offset / 2), rel=1e-4)
    assert float(at.cos_difference) == pytest.approx(np.cos(theta), abs=1e-5)


def test_generalised_logarithm_inverts(rng):
    value, theta = jnp.asarray(10 ** rng.uniform(-6, 2, (50, 2))), jnp.asarray(rng.uniform(0, np.pi / 2, 50))
    floor = jnp.asarray(5e-4)
    np.testing.assert_allclose(from_log(to_log(value, theta, floor), theta, floor), value, rtol=1e-9)
    assert float(from_log(jnp.full((1, 1), -3.0), theta[:1], floor)[0, 0]) == 0.0


def test_leave_one_out_equals_refits(rng):
    at, residual, noise = random_problem(rng)
    kernel = MEASURED_KERNELS["wide"]
    factor = factorise(kernel, at, noise)
    out, variance = leave_one_out(factor, solve_dual(factor, residual))
    matrix, noise_np, y = np.asarray(covariance(kernel, at, at)), np.asarray(noise), np.asarray(residual)
    for i in (0, 17):
        keep = np.arange(len(y)) != i
        weights = np.linalg.solve(matrix[np.ix_(keep, keep)] + np.diag(noise_np[keep]), matrix[keep, i])
        np.testing.assert_allclose(out[i], y[i] - weights @ y[keep], rtol=1e-8)
        assert float(variance[i]) == pytest.approx(matrix[i, i] + noise_np[i] - weights @ matrix[keep, i], rel=1e-8)


def test_leave_group_out_equals_refits(rng):
    at, residual, noise = random_problem(rng)
    kernel = MEASURED_KERNELS["wide"]
    factor = factorise(kernel, at, noise)
    dual = np.asarray(solve_dual(factor, residual))
    group = np.repeat([0, 1, 2, -1], 10)
    out, _ = leave_group_out(np.asarray(invert(factor)), dual, group)
    matrix, y, held = np.asarray(covariance(kernel, at, at)), np.asarray(residual), group == 1
    system = matrix[np.ix_(~held, ~held)] + np.diag(np.asarray(noise)[~held])
    np.testing.assert_allclose(
        out[held], y[held] - matrix[np.ix_(held, ~held)] @ np.linalg.solve(system, y[~held]), rtol=1e-7
    )
    assert not out[group == -1].any()


def test_lobe_model_recovers_planted_amplitudes(rng):
    num = 400
    theta_i, theta_o, phi = rng.uniform(0.1, 1.3, num), rng.uniform(0, 1.3, num), np.pi * np.sqrt(rng.random(num))
    at = guided_coordinates(*(jnp.asarray(x) for x in (theta_i, theta_o, phi)), LIMIT)
    shape = np.array([-0.7, np.log(0.0105), np.log(0.08), np.log(0.3), 1.0, 1.0, 0.8, 0.9, 0.5])
    planted = LobeModel(jnp.asarray(shape), jnp.asarray(np.log([[0.1, 0.05], [1.0, 1.0], [2.0, 2.0], [0.2, 0.4]])))
    floor = 1e-3
    z = np.asarray(lobe_log_value(planted, at, jnp.asarray(floor)))
    value = np.asarray(from_log(jnp.asarray(z), at.theta_i, jnp.asarray(floor)))
    found = fit_lobe_model(value, z, at, np.ones(num), floor)
    assert np.sqrt(np.mean((np.asarray(lobe_log_value(found, at, jnp.asarray(floor))) - z) ** 2)) < 0.02


def test_lobe_terms_are_finite_at_the_edges():
    theta = jnp.asarray([0.0, np.pi / 2, np.pi / 2, 0.0])
    other = jnp.asarray([0.0, 0.0, np.pi / 2, np.pi / 2])
    at = guided_coordinates(theta, other, jnp.asarray([0.0, 1.0, 0.0, np.pi]), LIMIT)
    terms = lobe_terms(jnp.asarray([-0.7, -4.6, -2.8, -1.4, 1.0, 1.0, 1.0, 1.0, 0.5]), at)
    assert bool(jnp.isfinite(terms).all()) and bool((terms >= 0).all())


def test_field_is_isotropic_at_both_poles(fitted):
    _, field, _ = fitted
    phi = jnp.linspace(0.0, 2 * np.pi, 9)
    for theta_i, theta_o in ((0.0, 0.7), (0.7, 0.0), (0.0, 0.0)):
        value = evaluate_guided(field, jnp.full_like(phi, theta_i), jnp.full_like(phi, theta_o), phi)
        np.testing.assert_allclose(value, np.broadcast_to(value[:1], value.shape), rtol=1e-12)


def test_field_is_finite_non_negative_and_even(fitted, rng):
    _, field, _ = fitted
    theta_i, theta_o = (jnp.asarray(np.append(rng.uniform(0, np.pi / 2, 60), [0.0, np.pi / 2])) for _ in range(2))
    phi = jnp.asarray(rng.uniform(0, 2 * np.pi, 62))
    value = evaluate_guided(field, theta_i, theta_o, phi)
    error, noise = evaluate_standard_error(field, theta_i, theta_o, phi)
    assert value.shape == error.shape == (62, 2)
    assert bool((value >= 0).all()) and bool(jnp.isfinite(value).all())
    assert bool((error >= 0).all()) and bool(jnp.isfinite(error).all()) and bool((noise > 0).all())
    np.testing.assert_allclose(evaluate_guided(field, theta_i, theta_o, -phi), value, rtol=1e-9)


def test_evaluation_equals_plain_numpy(fitted):
    _, field, _ = fitted
    theta_i, theta_o, phi = np.deg2rad([[20.0, 55.0], [30.0, 60.0], [170.0, 40.0]])  # measured incident angles
    arguments = [jnp.asarray(x) for x in (theta_i, theta_o, phi)]
    at = guided_coordinates(*arguments, field.theta_limit)
    centres = guided_coordinates(field.theta_i, field.theta_o, field.azimuth, field.theta_limit)
    z = np.array(lobe_log_value(field.lobe, at, field.floor))
    for d in range(2):
        for term, first in enumerate(("half", "azimuth", "azimuth")):
            length = np.asarray(field.kernel.scale[term])
            steps = [getattr(at, n)[d] - np.asarray(getattr(centres, n)) for n in (first, "theta_i", "theta_o")]
            distance = np.sqrt(sum((s / k) ** 2 for s, k in zip(steps, length, strict=True)))
            root = np.sqrt(3) * distance
            shape = (1 + root) * np.exp(-root) if term == 0 else np.exp(-distance)
            z[d] += float(field.kernel.amplitude[term]) * shape @ np.asarray(field.dual[0])
        z[d] += 1e-2 * np.asarray(field.dual[0]).sum(0)
    expected = float(field.floor) * np.expm1(np.maximum(z, 0)) / np.sqrt(np.cos(theta_i))[:, None]
    np.testing.assert_allclose(evaluate_guided(field, *arguments), expected, rtol=1e-8)


def test_field_is_near_the_truth_and_errors_are_calibrated(fitted, rng):
    samples, field, report = fitted
    new = measurement(rng, num=400)
    arguments = [jnp.asarray(x) for x in (new.theta_i, new.theta_o, new.phi_o)]
    value = np.asarray(evaluate_guided(field, *arguments))
    assert np.median(np.abs(value / new.value - 1)) < 0.03
    error, noise = (np.asarray(x) for x in evaluate_standard_error(field, *arguments))
    assert 0.58 < np.mean(np.abs(value - new.value) <= np.sqrt(error**2 + noise**2)) < 0.8
    assert report.residual_norm.max() < 1e-9
    assert len(report.noise_factor) == samples.num_samples


def test_scaling_the_measurement_scales_the_field(fitted):
    samples, field, _ = fitted
    scaled, _ = fit_guided(dataclasses.replace(samples, value=samples.value * 1e4))
    arguments = [jnp.asarray(np.deg2rad(x)) for x in ([20.0, 50.0], [35.0, 10.0], [180.0, 60.0])]
    np.testing.assert_allclose(evaluate_guided(scaled, *arguments), 1e4 * evaluate_guided(field, *arguments), rtol=1e-2)


def test_gradients_are_finite(fitted):
    _, field, _ = fitted

    def total(angles):
        return evaluate_guided(field, angles[0], angles[1], angles[2]).sum()

    for angles in ([0.5, 0.5, np.pi], [0.5, 0.7, 0.3], [float(field.theta_i[0]), float(field.theta_o[0]), 1.0]):
        assert bool(jnp.isfinite(jax.grad(total)(jnp.asarray(angles))).all())


def test_few_incident_angles_have_no_second_set(rng):
    samples = measurement(rng)
    samples = samples.take(samples.theta_i < np.deg2rad(25.0))
    field, report = fit_guided(samples)
    assert report.between_kernel == "" and field.measured_theta_i.shape == (1,)
    at = [jnp.asarray([0.2]), jnp.asarray([0.3]), jnp.asarray([2.0])]
    assert bool(jnp.isfinite(evaluate_guided(field, *at)).all())


def test_four_samples_are_enough(rng):
    samples = measurement(rng).take(np.arange(4))
    field, _ = fit_guided(samples)
    angles = [jnp.asarray(x) for x in (samples.theta_i, samples.theta_o, samples.phi_o)]
    assert bool(jnp.isfinite(evaluate_guided(field, *angles)).all())


def test_merging_joins_mirrored_repeats_and_respects_the_limit(rng):
    theta_i, theta_o = np.full(200, 0.5), rng.uniform(0.2, 1.2, 200)
    azimuth, half = rng.uniform(0.0, np.pi, 200), rng.uniform(0.1, 4.0, 200)
    doubled = [np.concatenate([x, x]) for x in (theta_i, theta_o, azimuth, half)]
    merged = merge_samples(*doubled)
    np.testing.assert_array_equal(merged.index[:200], merged.index[200:])
    assert merged.count.sum() == 400
    assert len(merge_samples(*doubled, max_centres=50).count) <= 50


def test_drop_outs_lose_weight(rng):
    half, theta = rng.uniform(0, 4, 300), rng.uniform(0, 1.3, 300)
    residual = 0.01 * rng.standard_normal((300, 5))
    residual[11] = -1.0
    factor = noise_factors(half, theta, theta[::-1].copy(), residual)
    assert factor[11] == factor.max() == 5.0
    assert np.median(factor) == 1.0


def test_floor_scales_with_the_values(rng):
    samples = measurement(rng)
    angles = samples.theta_i, samples.theta_o, samples.phi_o
    assert estimate_floor(*angles, 100 * samples.value) == pytest.approx(100 * estimate_floor(*angles, samples.value))


def test_held_out_fold_of_a_measured_paint(shared):
    tokens = [
        t
        for line in shared("data/cornell/garnet_red.brdf").read_text().splitlines()
        for t in line.split("#")[0].split()
    ]
    count = int(tokens[0])
    table = np.array(tokens[1 + count :], float).reshape(-1, 4 + count)
    wavelength = np.array(tokens[1 : 1 + count], float)[::4]
    with shared("cv/folds.csv").open() as file:
        fold = np.array([int(row["fold"]) for row in csv.DictReader(file)])
    rows = np.arange(len(table))
    samples = RawSamples(
        table[:, 0], table[:, 2], table[:, 3] % (2 * np.pi), wavelength, table[:, 4::4], rows, "brdf", "x", "pbrt", "0"
    )
    held = samples.take(fold == 1)
    field, _ = fit_guided(samples.take(fold != 1), ResampleOptions(method="guided", smoothness_weight=1e-3))
    arguments = [jnp.asarray(x) for x in (held.theta_i, held.theta_o, held.phi_o)]
    value = np.asarray(evaluate_guided(field, *arguments))
    error, noise = (np.asarray(x) for x in evaluate_standard_error(field, *arguments))
    big = held.value > 1e-3
    assert np.median(np.abs(value - held.value)[big] / held.value[big]) < 0.016  # the best of SciPy's RBF: 1.5 to 1.6 %
    covered = np.abs(value - held.value) <= np.sqrt(error**2 + noise**2)
    assert 0.60 < covered[big].mean() < 0.76
