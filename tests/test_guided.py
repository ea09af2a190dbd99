"""The guided method: its closed forms against refits, its promises at the edges, and held-out measured samples."""

import dataclasses

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from sbrdf_jax.cleaning import Flag, clean
from sbrdf_jax.cli import main
from sbrdf_jax.evaluation import (
    evaluate,
    evaluate_in_chunks,
    evaluate_on_axes,
    evaluate_standard_error,
    evaluate_where,
)
from sbrdf_jax.folds import NO_FOLD, Folds, read_fold_file
from sbrdf_jax.formats import read, write_samples
from sbrdf_jax.grid import make_grid
from sbrdf_jax.nnls import ProjectedNewton
from sbrdf_jax.options import GridOptions, InputOptions, ResampleOptions
from sbrdf_jax.records import RawSamples, Status
from sbrdf_jax.report import draw_figures
from sbrdf_jax.resampling.guided import describe_fit, fit_field, resample_guided
from sbrdf_jax.resampling.guided.bounds import solve_bounded
from sbrdf_jax.resampling.guided.centres import place_centres
from sbrdf_jax.resampling.guided.coordinates import (
    coordinates_on_axes,
    exchanged,
    from_log,
    guided_coordinates,
    log_scale,
    to_log,
)
from sbrdf_jax.resampling.guided.covariance import (
    covariance,
    covariance_on_axes,
    flatten,
    node_values,
    prior_variance,
)
from sbrdf_jax.resampling.guided.error_model import (
    MAX_FACTOR,
    MIRROR_PARAMETERS,
    ResidualScale,
    between_scale,
    estimate_floor,
    estimate_mirror_deviation,
    fit_between_scale,
    noise_factors,
)
from sbrdf_jax.resampling.guided.field import (
    evaluate_directions,
    evaluate_with_error,
    evaluated_part,
    field_whitener,
    unexplained,
)
from sbrdf_jax.resampling.guided.field import evaluate_on_axes as field_on_axes
from sbrdf_jax.resampling.guided.inverse import (
    Whitener,
    doubted,
    group_blocks,
    leave_group_out,
    leave_one_out,
    lower_inverse,
    mirror_lower,
    whitener,
)
from sbrdf_jax.resampling.guided.lobe_fit import fit_lobe_model
from sbrdf_jax.resampling.guided.lobe_model import LobeModel, lobe_log_value, lobe_terms, mirror_share
from sbrdf_jax.resampling.guided.lobe_slopes import lobe_slopes
from sbrdf_jax.resampling.guided.merging import merge_samples
from sbrdf_jax.resampling.guided.nodes import GRIDS, interpolate, mirror, mode_variance
from sbrdf_jax.resampling.guided.shadows import NUM_NEAREST, POWER, measured_value
from sbrdf_jax.resampling.guided.smoothing import CONSTANT, PRIOR
from sbrdf_jax.runtime import compile_clock
from sbrdf_jax.scores import coverage, held_out_scores
from sbrdf_jax.store import load, load_stage
from sbrdf_jax.validation import predict_held_out

LIMIT = jnp.asarray(np.deg2rad([85.0, 85.0]))
OPTIONS = ResampleOptions(method="guided", smoothness_weight="data", tolerance=1e-6)


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
    wavelength = np.array([500.0, 600.0])
    return RawSamples(theta_i, theta_o, phi_o, wavelength, value, np.arange(num), "brdf", "simulated", "builtin", "0")


@pytest.fixture(scope="module")
def samples():
    return measurement(np.random.default_rng(7))


@pytest.fixture(scope="module")
def field(samples):
    return fit_field(samples, OPTIONS).field


def random_directions(rng, num=30, highest=1.3):
    return [jnp.asarray(a) for a in (*rng.uniform(0.05, highest, (2, num)), rng.uniform(0, np.pi, num))]


def random_problem(rng, num=40):
    """A prior covariance of random directions, residuals and noise."""
    root = rng.standard_normal((num, num)) / np.sqrt(num)
    return jnp.asarray(root @ root.T), jnp.asarray(rng.uniform(1e-3, 1e-1, num)), jnp.asarray(rng.normal(size=(num, 3)))


def keys(distance):
    """Keys' cubic convolution kernel, a = -1/2, as published."""
    t = np.abs(distance)
    near, far = 1.5 * t**3 - 2.5 * t**2 + 1, -0.5 * t**3 + 2.5 * t**2 - 4 * t + 2
    return np.where(t < 1, near, np.where(t < 2, far, 0.0))


def plain_weights(x, axis):
    """Weights [direction, node] of one axis, mirrored at its ends."""
    place = (np.asarray(x) - axis.start) / (axis.stop - axis.start) * (axis.count - 1)
    weight = np.zeros((len(place), axis.count))
    for node in range(-1, axis.count + 1):
        mirrored = axis.count - 1 - abs(axis.count - 1 - abs(node))
        weight[:, mirrored] += keys(place - node)
    return weight


def plain_features(at, name):
    """All modes of a grid at directions, as one matrix [direction, mode]."""
    grid = GRIDS[name]
    along = [plain_weights(x, axis) @ axis.modes for x, axis in zip(grid.places(at), grid.axes, strict=True)]
    return np.einsum("ni,nj,nk->nijk", *along).reshape(len(along[0]), -1)


def test_half_angle_is_accurate_at_the_mirror():
    theta, offset = np.deg2rad(50.0), 1e-6
    at = guided_coordinates(jnp.asarray(theta), jnp.asarray(theta + offset), jnp.asarray(np.pi), LIMIT)
    assert np.expm1(float(at.half)) == pytest.approx(np.rad2deg(offset / 2), rel=1e-4)
    assert float(at.cos_difference) == pytest.approx(np.cos(theta), abs=1e-5)


def test_generalised_logarithm_inverts(rng):
    value = jnp.asarray(10 ** rng.uniform(-6, 2, (50, 2)))
    at = guided_coordinates(*random_directions(rng, 50, highest=1.57), LIMIT)
    scale = log_scale(at, jnp.asarray(5e-4))
    np.testing.assert_allclose(from_log(to_log(value, scale), scale), value, rtol=1e-9)
    assert float(from_log(jnp.full((1, 1), -3.0), scale[:1])[0, 0]) == 0.0
    np.testing.assert_array_equal(log_scale(exchanged(at), jnp.asarray(5e-4)), scale)


def test_modes_are_orthonormal_functions():
    for grid in GRIDS.values():
        for axis in grid.axes:
            trapezoid = np.full(axis.count, (axis.stop - axis.start) / (axis.count - 1))
            trapezoid[[0, -1]] /= 2
            gram = axis.modes[:, :-1].T @ (trapezoid[:, None] * axis.modes[:, :-1])
            np.testing.assert_allclose(gram, np.eye(axis.count - 1), atol=1e-12)


@pytest.mark.parametrize("reciprocal", [False, True])
def test_covariance_and_nodes_equal_dense_matrices(rng, reciprocal):
    """A E^-1 A' without nodes x nodes, and x = E^-1 A' a read back by the four-node kernel, against plain sums."""
    angles = random_directions(rng, 24)
    angles[0] = jnp.repeat(jnp.asarray([0.2, 0.5, 1.1]), 8)
    samples = RawSamples(*map(np.asarray, angles), np.array([500.0]), np.ones((24, 1)), np.arange(24), *"abcd")
    centres = place_centres(samples)
    seen = np.flatnonzero(centres.number > 0)
    at = guided_coordinates(*random_directions(rng, 9), jnp.asarray(centres.theta_limit))
    variance = mode_variance(PRIOR, CONSTANT, reciprocal)
    expected, own = np.zeros((9, len(seen))), np.zeros(9)
    for name in GRIDS:
        left, right = (
            (plain_features(x, name) + plain_features(exchanged(x) if reciprocal else x, name)) / 2
            for x in (at, jax.tree.map(lambda x: x[seen], centres.snapped))
        )
        weight = getattr(variance, name).reshape(-1)
        expected += (left * weight) @ right.T
        own += (left**2) @ weight
    found = np.asarray(covariance(variance, at, centres.features))
    np.testing.assert_allclose(found[:, seen], expected, rtol=1e-10)
    np.testing.assert_allclose(prior_variance(variance, at), own, rtol=1e-10)
    theta_o, phi_o = jnp.asarray([0.0, 0.4, 1.2]), jnp.asarray([0.0, 1.0, np.pi])
    limit, centre = jnp.asarray(centres.theta_limit), jnp.asarray(centres.angles.reshape(3, 3, -1))
    along, along_prior = covariance_on_axes(variance, centre, limit, jnp.asarray(0.3), theta_o, phi_o)
    mesh = guided_coordinates(jnp.full((3, 3), 0.3), *jnp.meshgrid(theta_o, phi_o, indexing="ij"), limit)
    on_axes = coordinates_on_axes(jnp.asarray(0.3), theta_o, phi_o, limit)
    for part, whole in zip(jax.tree.leaves(on_axes), jax.tree.leaves(mesh), strict=True):
        np.testing.assert_allclose(jnp.broadcast_to(part, (3, 3)), whole, rtol=1e-12)
    np.testing.assert_allclose(
        along.reshape(9, -1), covariance(variance, flatten(mesh), centres.features), rtol=1e-10, atol=1e-14
    )
    np.testing.assert_allclose(along_prior.reshape(-1), prior_variance(variance, flatten(mesh)), rtol=1e-10)
    dual = np.zeros((centres.count, 2))
    dual[seen] = rng.normal(size=(len(seen), 2))
    nodes = node_values(variance, centres.node_rows, dual)
    read_back = sum(
        np.stack([
            interpolate(mirror(jnp.asarray(nodes[name])), jax.tree.map(lambda x, k=k: x[k], grid.places(at)), grid.axes)
            for k in range(9)
        ])
        for name, grid in GRIDS.items()
    )  # fmt: skip
    np.testing.assert_allclose(read_back, found @ dual, rtol=1e-8)


def test_leave_one_out_equals_refits(rng):
    prior, noise, residual = random_problem(rng)
    matrix, noise, y = (np.asarray(a) for a in (prior, noise, residual))
    out, dual = leave_one_out(lower_inverse(matrix, noise), y)
    np.testing.assert_allclose((matrix + np.diag(noise)) @ dual, y, rtol=1e-7, atol=1e-9)
    for i in (0, 17):
        keep = np.arange(len(y)) != i
        weights = np.linalg.solve(matrix[np.ix_(keep, keep)] + np.diag(noise[keep]), matrix[keep, i])
        np.testing.assert_allclose(out[i], y[i] - weights @ y[keep], rtol=1e-8)


def test_leave_group_out_equals_refits(rng):
    prior, noise, residual = random_problem(rng)
    lower = lower_inverse(np.asarray(prior), np.asarray(noise))
    group = np.repeat([0, 1, 2, -1], 10)
    out, variance = leave_group_out(group_blocks(lower, group), mirror_lower(lower) @ np.asarray(residual))
    matrix, y, held = np.asarray(prior), np.asarray(residual), group == 1
    system = matrix[np.ix_(~held, ~held)] + np.diag(np.asarray(noise)[~held])
    cross = matrix[np.ix_(held, ~held)]
    np.testing.assert_allclose(out[held], y[held] - cross @ np.linalg.solve(system, y[~held]), rtol=1e-7)
    spread = matrix[np.ix_(held, held)] - cross @ np.linalg.solve(system, cross.T) + np.diag(np.asarray(noise)[held])
    np.testing.assert_allclose(variance[held], np.diag(spread), rtol=1e-7)
    assert not out[group == -1].any()


def test_more_noise_of_a_few_centres_is_as_if_the_whole_had_been_inverted_again(rng):
    prior, noise, _ = (np.asarray(a) for a in random_problem(rng))
    extra = np.zeros(len(noise))
    extra[[3, 4, 17]] = [0.1, 2.0, 1e4]
    doubt, lower = doubted(np.tril(lower_inverse(prior, noise)), extra)
    whole = np.linalg.inv(prior + np.diag(noise + extra))
    np.testing.assert_allclose(np.tril(lower), np.tril(whole), rtol=1e-8, atol=1e-9 * np.abs(whole).max())
    cross = rng.standard_normal((5, len(noise)))
    alike = whitener(prior, noise)
    found = unexplained(cross, np.full(5, 1e6), Whitener(alike, doubt))
    np.testing.assert_allclose(1e6 - found, np.einsum("dc,ce,de->d", cross, whole, cross), rtol=1e-7, atol=1e-7)
    assert doubted(lower, np.zeros(len(noise)))[0].shape == (0, len(noise))
    assert np.isnan(doubted(np.full_like(prior, np.nan), extra)[0]).all()  # and no exception


def planted_hole(samples):
    """A direction of the third incident angle and its nearest, hidden; and the next, to be held out; the samples."""
    angle = np.arccos(np.clip(np.cos(samples.theta_o - 0.4) * np.cos(samples.phi_o - 2.5), -1, 1))
    row = np.flatnonzero(samples.theta_i == np.unique(samples.theta_i)[2])
    unit = unit_vectors(samples)[row]
    near = row[np.argsort(np.linalg.norm(unit - unit[np.argmin(angle[row])], axis=1))]
    value = samples.value.copy()
    value[near[:2]] = 1e-4
    return near[:2], near[2], dataclasses.replace(samples, value=value)


def unit_vectors(samples):
    theta, phi = samples.theta_o, samples.phi_o
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)


def test_what_stood_in_the_way_is_no_part_of_the_field(samples):
    hidden, _, low = planted_hole(samples)
    cleaned = clean(low, method="guided")
    assert set(np.flatnonzero(cleaned.report.flag & Flag.DROPOUT)) == set(hidden)
    assert clean(low, method="paper").report.num_kept == samples.num_samples == cleaned.report.num_kept + 2
    fit, expected = (fit_field(s, OPTIONS) for s in (cleaned.samples, samples.take(np.delete(low.row, hidden))))
    np.testing.assert_array_equal(fit.field.half, expected.field.half)
    angles = tuple(a[hidden] for a in (samples.theta_i, samples.theta_o, samples.phi_o))
    found = np.asarray(evaluate_with_error(evaluated_part(fit.field), fit.whiten, *angles)[0])
    np.testing.assert_allclose(found, glossy(*angles), rtol=0.1)


def test_a_measurement_beside_a_hole_is_predicted_as_it_would_be(samples):
    """Against sums over all directions of the incident angle: inverse distances of the nearest, in z."""
    hidden, beside, low = planted_hole(samples)
    train, held = np.delete(low.row, beside), np.array([beside])
    cleaned = clean(low.take(train), method="guided")
    fit = fit_field(cleaned.samples, OPTIONS)
    others = np.flatnonzero(samples.theta_i != samples.theta_i[beside])[:3]
    asked = np.concatenate([held, hidden, others])
    angles = tuple(a[asked] for a in (samples.theta_i, samples.theta_o, samples.phi_o))
    field = evaluated_part(fit.field)
    value = evaluate_directions(field, *angles)
    found = measured_value(field, value, angles, cleaned.samples, low.take(hidden))

    np.testing.assert_array_equal(found[3:], value[3:])  # other incident angles
    np.testing.assert_allclose(found[1:3], low.value[hidden], rtol=1e-6)  # what was measured there
    same = np.flatnonzero((samples.theta_i == samples.theta_i[beside]) & (samples.row != beside))
    unit = unit_vectors(samples)
    distance = np.linalg.norm(unit[same] - unit[beside], axis=1)
    nearest = np.argsort(distance)[:NUM_NEAREST]
    weight = dict(zip(same[nearest].tolist(), distance[nearest] ** -float(POWER), strict=True))
    scale = log_scale(guided_coordinates(*angles, field.theta_limit), field.floor)
    z = to_log(value, scale)
    depth = to_log(low.value[hidden], scale[1:3]) - z[1:3]
    lowered = sum(weight.get(row, 0.0) * deep for row, deep in zip(hidden.tolist(), depth, strict=True))
    expected = z[0] + lowered / sum(weight.values())
    np.testing.assert_allclose(to_log(found[:1], scale[:1])[0], expected, rtol=1e-9)
    assert (found[0] < 0.9 * value[0]).all()


@pytest.mark.parametrize("raised", [0.0, 10.0])  # by 10 the unbounded answer keeps the bound, and nothing is solved
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_bounded_answer_equals_scipys(rng, raised, precision):
    """Against min |N^-1/2 (z - data)|^2 + (z - model)' K^-1 (z - model), z >= 0, stated in z itself."""
    prior, noise, residual = (np.asarray(a) for a in random_problem(rng))
    prior, noise, model = prior + 0.1 * np.eye(40), 10 * noise, rng.uniform(0, 0.3, residual.shape) + raised
    inverse = mirror_lower(lower_inverse(prior, noise))
    found = solve_bounded(prior, inverse, noise, residual, model, ProjectedNewton(1e-10, precision=precision))
    z = model + prior @ found.dual
    assert (z > -1e-9).all() and (z < 1e-9).any() == (raised == 0) == found.multiplier.any()
    assert found.kkt_residual.max() <= 1e-10 and (found.status == Status.OK).all()
    root = np.linalg.inv(np.linalg.cholesky(prior))
    rows = np.concatenate([np.diag(1 / np.sqrt(noise)), root])
    for lane in range(z.shape[1]):
        data = (model + residual)[:, lane] / np.sqrt(noise)
        expected, _ = scipy.optimize.nnls(rows, np.concatenate([data, root @ model[:, lane]]))
        np.testing.assert_allclose(z[:, lane], expected, atol=1e-7)


def test_lobe_model_recovers_planted_amplitudes(rng):
    num = 400
    theta_i, theta_o, phi = rng.uniform(0.1, 1.3, num), rng.uniform(0, 1.3, num), np.pi * np.sqrt(rng.random(num))
    at = guided_coordinates(theta_i, theta_o, phi, np.asarray(LIMIT))
    shape = np.array([-0.7, np.log(0.0105), np.log(0.08), np.log(0.3), 1.0, 1.0, 0.8, 0.9, 0.5])
    planted = LobeModel(shape, np.log([[0.1, 0.05], [1.0, 1.0], [2.0, 2.0], [0.2, 0.4]]))
    floor = 1e-3
    z = lobe_log_value(planted, at, floor)
    value = from_log(z, log_scale(at, floor))
    found, gradient = fit_lobe_model(value, z, at, np.ones(num), floor)
    assert np.sqrt(np.mean((lobe_log_value(found, at, floor) - z) ** 2)) < 0.02
    assert gradient.shape == (2,) and float(gradient.max()) < 0.2


def test_lobe_slopes_are_the_derivatives_of_the_terms(rng):
    theta_i, theta_o, phi = random_directions(rng, 60)
    near_mirror = theta_o.at[:9].set(theta_i[:9]), phi.at[:9].set(3.13)
    at = jax.tree.map(np.asarray, guided_coordinates(theta_i, *near_mirror, LIMIT))
    shape = np.array([-0.7, np.log(0.02), np.log(0.08), np.log(0.3), 1.1, 0.9, 0.8, 0.7, 0.5])
    expected = jax.jacobian(lobe_terms)(jnp.asarray(shape), jax.tree.map(jnp.asarray, at))
    np.testing.assert_allclose(lobe_slopes(shape, at), np.transpose(expected, (2, 1, 0)), rtol=1e-7, atol=1e-9)


def test_lobe_terms_are_finite_at_the_edges():
    theta = jnp.asarray([0.0, np.pi / 2, np.pi / 2, 0.0])
    other = jnp.asarray([0.0, 0.0, np.pi / 2, np.pi / 2])
    at = guided_coordinates(theta, other, jnp.asarray([0.0, 1.0, 0.0, np.pi]), LIMIT)
    terms = lobe_terms(jnp.asarray([-0.7, -4.6, -2.8, -1.4, 1.0, 1.0, 1.0, 1.0, 0.5]), at)
    assert bool(jnp.isfinite(terms).all()) and bool((terms >= 0).all())


def test_field_is_isotropic_at_both_poles(field):
    phi = np.linspace(0.0, 2 * np.pi, 9)
    for theta_i, theta_o in ((0.0, 0.7), (0.7, 0.0), (0.0, 0.0)):
        value = np.asarray(evaluate(field, theta_i, theta_o, phi))
        np.testing.assert_allclose(value, np.broadcast_to(value[:1], value.shape), rtol=1e-12)


def test_field_is_finite_non_negative_and_even(field, rng):
    theta_i, theta_o = (np.append(rng.uniform(0, np.pi / 2, 60), [0.0, np.pi / 2]) for _ in range(2))
    phi = rng.uniform(0, 2 * np.pi, 62)
    value = evaluate_in_chunks(field, theta_i, theta_o, phi)
    error, noise = evaluate_standard_error(field, theta_i, theta_o, phi)
    assert value.shape == error.shape == noise.shape == (62, 2)
    assert (value >= 0).all() and np.isfinite(value).all()
    assert (error >= 0).all() and np.isfinite(error).all() and (noise > 0).all()
    np.testing.assert_allclose(evaluate_in_chunks(field, theta_i, theta_o, -phi), value, rtol=1e-9)


def test_values_along_axes_are_those_of_the_directions(field):
    """Polar angles summed once for all azimuths, in blocks, equal eq. (5) direction by direction."""
    axes = np.array([0.0, 0.5, 1.5]), np.linspace(0, np.pi / 2, 19), np.linspace(-1, 7, 5)
    mesh = np.meshgrid(*axes, indexing="ij")
    wavelength_nm = np.array([390.0, 500.0, 525.0])
    expected = evaluate_in_chunks(field, *mesh, wavelength_nm)
    np.testing.assert_allclose(evaluate_on_axes(field, *axes, wavelength_nm), expected, rtol=1e-9, atol=1e-13)
    where = np.zeros(mesh[0].shape, bool)
    where[0, 4, 1] = where[2, 2, 3] = where[2, 18, 0] = True
    found = evaluate_where(field, *axes, where)
    np.testing.assert_allclose(found, evaluate_in_chunks(field, *(a[where] for a in mesh)), rtol=1e-9, atol=1e-13)
    assert evaluate_where(field, *axes, np.zeros_like(where)).shape == (0, np.size(field.wavelength_nm))


def test_host_and_device_evaluate_alike(field, rng):
    """NumPy with sparse rows and a triangle, JAX with gathered nodes and blocks: the same values and errors."""
    part, whiten = evaluated_part(field), field_whitener(field)
    angles = [np.asarray(a) for a in random_directions(rng, 30)]
    compiled = jax.jit(evaluate_with_error.__wrapped__)
    for one, other in zip(evaluate_with_error(part, whiten, *angles), compiled(part, whiten, *angles), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-14)
    axes = np.asarray(0.4), np.array([0.0, 0.5, 1.2]), np.array([0.0, 1.0, np.pi])
    found = field_on_axes(jax.tree.map(np.asarray, part), *axes)
    np.testing.assert_allclose(found, jax.jit(field_on_axes)(part, *axes), rtol=1e-9, atol=1e-14)


def test_a_material_with_another_curve_compiles_nothing(field):
    """How many smoothings were tried differs from material to material, and evaluation does not read it."""
    angles = np.full(3, 0.4), np.full(3, 0.5), np.full(3, 2.0)
    other = dataclasses.replace(field, curve=np.ones((2, 1 + np.shape(field.curve)[1])))
    evaluate_in_chunks(field, *angles), evaluate_on_axes(field, *angles), evaluate_standard_error(field, *angles)
    with compile_clock() as clock:
        evaluate_in_chunks(other, *angles), evaluate_on_axes(other, *angles), evaluate_standard_error(other, *angles)
    assert clock.num_compiled == 0


def test_field_is_near_the_truth_and_errors_are_calibrated(field, rng):
    new = measurement(rng, num=400)
    angles = new.theta_i, new.theta_o, new.phi_o
    value = evaluate_in_chunks(field, *angles)
    assert np.median(np.abs(value / new.value - 1)) < 0.03
    error, noise = evaluate_standard_error(field, *angles)
    assert 0.58 < np.mean(np.abs(value - new.value) <= np.hypot(error, noise)) < 0.8


def test_between_wavelengths_value_and_error_follow_the_measured_ones(field):
    at = np.deg2rad([30.0, 25.0, 170.0])
    low, high = evaluate_in_chunks(field, *at)
    assert evaluate_in_chunks(field, *at, [550.0])[0] == pytest.approx((low + high) / 2)
    error, _ = evaluate_standard_error(field, *at)
    assert evaluate_standard_error(field, *at, [500.0, 550.0])[0] == pytest.approx([error[0], error.mean()])


@pytest.mark.parametrize("factor", [1e4, 1e12])
def test_scaling_the_measurement_scales_the_field(samples, field, factor):
    scaled = fit_field(dataclasses.replace(samples, value=samples.value * factor), OPTIONS).field
    angles = np.deg2rad([20.0, 50.0]), np.deg2rad([35.0, 10.0]), np.deg2rad([180.0, 60.0])
    expected = factor * evaluate_in_chunks(field, *angles)
    np.testing.assert_allclose(evaluate_in_chunks(scaled, *angles), expected, rtol=1e-6)  # iterated fits of the model


def exchangeable(theta_i, theta_o, phi_o):
    """A reciprocal gloss: one shape of the half angle."""
    cos_half = (np.cos(theta_i) + np.cos(theta_o)) / np.sqrt(
        2 * (1 + np.cos(theta_i) * np.cos(theta_o) + np.sin(theta_i) * np.sin(theta_o) * np.cos(phi_o))
    )
    return 0.1 + 0.5 * np.exp((np.minimum(cos_half, 1.0)[..., None] - 1) / np.array([0.02, 0.03]))


def test_reciprocal_field_is_so_and_says_where_the_data_are_not(samples, rng):
    clean_part = dataclasses.replace(
        samples, value=exchangeable(samples.theta_i, samples.theta_o, samples.phi_o) * np.ones((1, 2))
    )
    theta_i, theta_o, phi_o = (np.asarray(a) for a in random_directions(rng, 40, highest=np.pi / 2))
    for part, contradicts in ((clean_part, False), (samples, False), (one_sided(samples), True)):
        field = fit_field(part, OPTIONS, centres=place_centres(part, reciprocal=True)).field
        forth, back = (evaluate_in_chunks(field, *a, phi_o) for a in ((theta_i, theta_o), (theta_o, theta_i)))
        np.testing.assert_allclose(forth, back, rtol=1e-9)
        assert any("contradicts" in line for line in describe_fit(field)) == contradicts


def test_a_spike_that_few_directions_see_is_told(samples, rng):
    assert not any("spike" in line for line in describe_fit(fit_field(samples, OPTIONS).field))
    theta = np.unique(samples.theta_i)
    angles = (np.append(a, b) for a, b in ((samples.theta_i, theta), (samples.theta_o, theta), (samples.phi_o, theta)))
    theta_i, theta_o, phi_o = angles
    phi_o[-len(theta) :] = np.pi
    value = np.concatenate([samples.value, np.full((len(theta), 2), 30.0)])
    spiky = RawSamples(theta_i, theta_o, phi_o, samples.wavelength_nm, value, np.arange(len(value)), *"abcd")
    field = fit_field(spiky, OPTIONS).field
    assert any("2 of 2 wavelengths" in line for line in describe_fit(field))
    aside = np.deg2rad([40.0, 46.0, 180.0])  # the spike does not smear
    assert evaluate_in_chunks(field, *aside) == pytest.approx(glossy(*aside), rel=0.2)


def one_sided(samples: RawSamples) -> RawSamples:
    """The measurement, brighter towards grazing exitance than towards grazing incidence."""
    return dataclasses.replace(samples, value=samples.value * np.exp(samples.theta_o - samples.theta_i)[:, None])


def test_materials_of_one_geometry_share_what_angles_decide(samples):
    """What the first fit worked out changes nothing of the second."""
    other = dataclasses.replace(samples, value=np.sqrt(samples.value))
    centres = place_centres(samples)
    fit_field(samples, OPTIONS, centres=centres)
    shared, alone = fit_field(other, OPTIONS, centres=centres).field, fit_field(other, OPTIONS).field
    jax.tree.map(np.testing.assert_array_equal, shared, alone)


def test_gradients_are_finite(field):
    def total(angles):
        return evaluate(field, angles[0], angles[1], angles[2]).sum()

    for angles in ([0.5, 0.5, np.pi], [0.5, 0.7, 0.3], [0.0, 0.0, 0.0], [np.pi / 2, np.pi / 2, 1.0]):
        assert bool(jnp.isfinite(jax.grad(total)(jnp.asarray(angles))).all())


@pytest.mark.parametrize("keep", [slice(4), slice(40)], ids=["four samples", "one incident angle"])
def test_few_samples_are_enough(samples, keep):
    order = np.argsort(samples.theta_i, kind="stable")
    some = samples.take(np.sort(order[keep]))
    fit = fit_field(some, OPTIONS)
    value = evaluate_in_chunks(fit.field, some.theta_i, some.theta_o, some.phi_o)
    assert np.isfinite(value).all() and (fit.status == Status.OK).all()


def test_a_lane_without_light_is_zero_and_one_that_is_not_finite_stays_alone(samples, field):
    value = np.concatenate([samples.value, np.zeros((samples.num_samples, 1)), samples.value[:, :1]], axis=1)
    value[5, 3] = np.nan
    more = dataclasses.replace(samples, value=value, wavelength_nm=np.array([500.0, 600.0, 650.0, 700.0]))
    grid = make_grid(more, GridOptions(30.0, 22.5, 45.0), bilateral=True)
    found = resample_guided(more, grid, OPTIONS)
    np.testing.assert_array_equal(found.status, [Status.OK, Status.OK, Status.OK, Status.NONFINITE])
    brdf = np.asarray(found.brdf)
    assert not brdf[..., 2].any() and np.isnan(brdf[..., 3]).all() and np.isnan(np.asarray(found.kkt_residual)[3])
    alone = resample_guided(samples, grid, OPTIONS)
    np.testing.assert_allclose(brdf[..., :2], alone.brdf, rtol=1e-6)
    assert found.standard_error.shape == brdf.shape and (np.asarray(found.standard_error)[..., :2] > 0).all()


def test_merging_joins_repeats_and_respects_the_limit(rng):
    group = np.zeros(400, int)
    theta_o, azimuth, half = (np.tile(a, 2) for a in rng.uniform(0.2, 1.2, (3, 200)))
    cell = merge_samples(group, theta_o, azimuth, half)
    np.testing.assert_array_equal(cell[:200], cell[200:])
    assert len(np.unique(merge_samples(group, theta_o, azimuth, half, max_centres=50))) <= 50
    assert len(np.unique(merge_samples(np.arange(400) % 2, theta_o, azimuth, half))) > len(np.unique(cell)) - 1


def test_directions_that_neighbours_contradict_lose_weight(rng):
    half, theta = rng.uniform(0, 4, 300), rng.uniform(0, 1.3, 300)
    residual = 0.01 * rng.standard_normal((300, 5))
    residual[11] = -1.0
    factor = noise_factors(half, theta, theta[::-1].copy(), residual)
    assert factor[11] == factor.max() == MAX_FACTOR
    assert np.median(factor) == 1.0


def test_floor_scales_with_the_values(samples):
    angles = samples.theta_i, samples.theta_o, samples.phi_o
    assert estimate_floor(*angles, 100 * samples.value) == pytest.approx(100 * estimate_floor(*angles, samples.value))


def test_folds_share_what_angles_decide_and_never_see_held_out_values(samples):
    label = np.arange(samples.num_samples) % 3
    folds = Folds(label, "by row")
    grid = make_grid(samples, GridOptions(30.0, 22.5, 45.0), bilateral=True)
    found = predict_held_out(samples, folds, grid, OPTIONS, bilateral=True)
    wild = samples.value.copy()
    wild[label == 1] = 1e3
    spoiled = predict_held_out(dataclasses.replace(samples, value=wild), folds, grid, OPTIONS, bilateral=True)
    np.testing.assert_array_equal(found.predicted[label == 1], spoiled.predicted[label == 1])
    train = samples.take(label != 0)
    alone = fit_field(train, OPTIONS).field
    held = samples.take(label == 0)
    expected = evaluate_in_chunks(alone, held.theta_i, held.theta_o, held.phi_o)
    assert np.median(np.abs(found.predicted[label == 0] / expected - 1)) < 1e-3


def test_a_result_holds_the_field_and_its_errors(samples, tmp_path, rng):
    write_samples(tmp_path / "small.csv", samples)
    (tmp_path / "c.yaml").write_text("input: {path: small.csv}\nvalidate: {folds: 2}\n")
    steps = ["grid.theta_i_step_deg=30", "grid.theta_o_step_deg=22.5", "grid.phi_o_step_deg=45"]
    quick = [*steps, "represent.max_degree=1", "represent.lobe=tan", "output.report=false"]
    path = tmp_path / "out.h5"
    assert main(["run", str(tmp_path / "c.yaml"), *quick, f"output.path={path}"]) == 0
    with h5py.File(path) as file:
        assert (file["grid/kkt_residual"][()] <= 1e-6).all() and file["grid"].attrs["method"] == "guided"
        assert file["grid/standard_error"].shape == file["grid/brdf"].shape
        assert np.isfinite(file["field/model_residual"][()]).all() and file["field/curve"].shape[0] == 2
        assert file["validation/expected_error"].shape == (300, 2)
        assert 0.5 < file["validation/scores/coverage"][()] < 0.9
    stage, grid = load_stage(path, "grid"), load(path).gridded
    nodes = np.meshgrid(grid.theta_i, grid.theta_o, grid.phi_o, indexing="ij")
    np.testing.assert_allclose(evaluate_in_chunks(stage, *nodes), grid.brdf, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(evaluate_standard_error(stage, *nodes)[0], grid.standard_error, rtol=1e-6)
    (tmp_path / "figures").mkdir()
    without_compact = dataclasses.replace(load(path), field=None, compact=None, metrics={})
    names = [figure.name for figure in draw_figures(without_compact, tmp_path / "figures")]
    assert names[:3] == ["plane_of_incidence.png", "color_maps.png", "held_out.png"]  # no rings without eq. (5)
    (tmp_path / "at.csv").write_text("theta_i_deg,theta_o_deg,phi_o_deg\n30,45,90\n12,7,200\n")
    words = ["evaluate", str(path), "--at", str(tmp_path / "at.csv"), "--stage", "grid", "--uncertainty"]
    assert main([*words, "--output", str(tmp_path / "values.csv")]) == 0
    header, first, _ = (tmp_path / "values.csv").read_text().splitlines()
    assert header.split(",")[3:] == ["500nm", "500nm_se", "600nm", "600nm_se"]
    assert [float(x) for x in first.split(",")][3::2] == pytest.approx(np.asarray(grid.brdf)[1, 2, 2])
    with h5py.File(path, "a") as file:  # as it was before spectra were filtered
        for name in ("to_component", "from_component"):
            del file["field/measured"][name]
    older = evaluate_in_chunks(load_stage(path, "grid"), *nodes)
    np.testing.assert_allclose(older, grid.brdf, rtol=1e-9, atol=1e-12)
    with h5py.File(path, "a") as file:  # and before there was a grid over the difference angle
        for name in (
            "difference",
            "lobe/mirror_power",
            *(f"variance/along_{x}" for x in ("half", "difference", "lean")),
        ):
            del file["field"][name]
    field = load(path).gridded.field
    assert field.lobe.mirror_power == 2.0 and not field.difference.any() and not field.variance.difference.any()
    lobe = dataclasses.replace(grid.field.lobe, mirror_power=2.0)
    kept = dataclasses.replace(grid.field, lobe=lobe, difference=np.zeros_like(grid.field.difference))
    expected = evaluate_in_chunks(kept, *nodes)
    np.testing.assert_allclose(evaluate_in_chunks(load_stage(path, "grid"), *nodes), expected, rtol=1e-9, atol=1e-12)


def test_a_standard_error_grows_between_incident_angles_as_left_out_ones_need(rng):
    theta_i, wrong_by = np.radians([10.0, 30.0, 70.0]), np.array([2.0, 4.0, 1.0])
    ratios = [factor**2 * rng.normal(size=20_000) ** 2 for factor in wrong_by]
    scale = ResidualScale(np.zeros((2, 2, 2)), np.zeros(3), np.ones(3), **fit_between_scale(theta_i, ratios))
    at = np.radians([0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 50.0, 70.0, 90.0])
    middle, last = np.sqrt(2.0 * 4.0), np.sqrt(4.0 * 1.0)
    expected = [2.0, np.sqrt(2.0), 1.0, np.sqrt(middle), middle, 1.0, last, 1.0, 1.0]
    np.testing.assert_allclose(between_scale(scale, at), expected, rtol=0.03)
    np.testing.assert_allclose(between_scale(scale, jnp.asarray(at)), between_scale(scale, at), rtol=1e-12)
    assert fit_between_scale(theta_i[:1], ratios[:1]) == {}
    np.testing.assert_array_equal(between_scale(ResidualScale(np.zeros((2, 2, 2)), np.zeros(3), np.ones(3)), at), 1.0)


def test_the_mirror_image_is_as_unsure_as_left_out_samples_of_it_were(rng):
    share = np.r_[np.full(40, 0.9), np.full(1000, 0.3)]
    error = np.abs(rng.normal(size=1040)) * np.where(share > 0.5, 0.9 * 0.7, 5.0)  # where it is a part, it is not asked
    of_forty = estimate_mirror_deviation(share, error)
    assert of_forty == pytest.approx(0.7 * np.sqrt(40 / (40 - MIRROR_PARAMETERS)), rel=0.25)
    exact = np.sqrt((0.81 * (error[:40] ** 2).sum() + 1 / 33.4) / (32.4 - MIRROR_PARAMETERS + 1 / 33.4))
    assert of_forty == pytest.approx(exact)
    assert estimate_mirror_deviation(share[40:], error[40:]) == 1.0  # a factor of e
    assert estimate_mirror_deviation(np.ones(2), np.zeros(2)) == 1.0  # two samples fit any model


def test_a_standard_error_near_the_mirror_direction_has_the_doubt_of_the_mirror_image(field, rng):
    field = jax.tree.map(np.array, field)
    field.lobe.log_amplitude[1] += 15.0  # a mirror image that counts
    theta = rng.uniform(0.1, 1.4, 60)
    phi_o = np.pi + rng.normal(0, 0.05, 60)
    at = guided_coordinates(theta, theta, phi_o, field.theta_limit)
    step = 1e-6
    louder = np.array(field.lobe.log_amplitude)
    louder[1] += step
    louder = dataclasses.replace(field.lobe, log_amplitude=louder)
    slope_of_mirror = (lobe_log_value(louder, at, field.floor) - lobe_log_value(field.lobe, at, field.floor)) / step
    share = mirror_share(field.lobe, at, field.floor)
    np.testing.assert_allclose(share, slope_of_mirror, rtol=0, atol=1e-6)
    assert ((share >= 0) & (share <= 1)).all() and share.max() > 0.5

    def errors(deviation):
        scale = dataclasses.replace(field.scale, mirror=np.array(deviation))
        return evaluate_with_error(dataclasses.replace(field, scale=scale), field_whitener(field), theta, theta, phi_o)

    (value, sure, noise), (again, unsure, same) = errors(0.0), errors(0.5)
    np.testing.assert_array_equal(value, again)
    np.testing.assert_array_equal(noise, same)
    unit = value + 1 / log_scale(at, field.floor)[:, None]  # d value / d z
    np.testing.assert_allclose(unsure**2 - sure**2, (0.5 * share * unit) ** 2, rtol=1e-6, atol=1e-12 * unit.max() ** 2)


def test_an_incident_angle_beyond_the_others_is_not_too_sure(shared):
    raw = read(shared("data/cornell/garnet_red.brdf"), InputOptions(path="garnet_red"))
    degrees = np.degrees(raw.theta_i).round().astype(int)
    folds = Folds(np.where(degrees == degrees.max(), 0, NO_FOLD), "the last one")
    grid = make_grid(raw, GridOptions(), bilateral=True)
    found = predict_held_out(raw, folds, grid, OPTIONS, bilateral=True)
    rows = folds.label == 0
    assert found.expected_error is not None
    share = coverage(found.predicted[rows], raw.value[rows], found.expected_error[rows])
    assert 0.4 < share < 0.9  # .31 where it is held against its own scale of errors, which is not known without it


def test_held_out_samples_of_a_measured_paint(shared):
    raw = read(shared("data/cornell/garnet_red.brdf"), InputOptions(path="garnet_red"))
    folds = Folds(read_fold_file(str(shared("cv/folds.csv")), raw.num_samples), "as given")
    grid = make_grid(raw, GridOptions(), bilateral=True)
    found = predict_held_out(raw, folds, grid, OPTIONS, bilateral=True)
    scores = held_out_scores(found.predicted, raw.value)
    assert scores["median_rel"] < 0.0144 and scores["calm_l2"] < 0.0734  # the best of other methods, each on all folds
    assert scores["log_rms"] < 0.1899 and scores["negative_share"] == 0
    assert 0.60 < coverage(found.predicted, raw.value, found.expected_error) < 0.76
    assert (found.status == Status.OK).all()
