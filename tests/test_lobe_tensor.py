"""The lobe tensor: least squares against plain ones, planted fields, sharp lobes, targets, hard input."""

import dataclasses

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline, CubicSpline
from tolerances import GRADIENT, ROUNDING, tolerance

from sbrdf_jax import builtin, store
from sbrdf_jax.colour import colour_matching
from sbrdf_jax.encoding import coefficients_allowed, data_basis, decode, encode, encode_field, make_basis
from sbrdf_jax.evaluation import evaluate, evaluate_in_chunks
from sbrdf_jax.grid import make_grid
from sbrdf_jax.metrics import compression, error_at_nodes, error_between, on_axes, stored_numbers
from sbrdf_jax.options import GridOptions, RepresentOptions, ResampleOptions, TargetOptions
from sbrdf_jax.records import GriddedBRDF, SpectralField, Status
from sbrdf_jax.representation import half_field as half_field_module
from sbrdf_jax.representation import represent, represent_with_plan, tensor_growth
from sbrdf_jax.representation.direction_functions import direction_functions, num_direction_functions
from sbrdf_jax.representation.half_field import half_field, near_mirror
from sbrdf_jax.representation.tensor_fit import Factors, Normal, TensorFit
from sbrdf_jax.representation.tensor_growth import grow
from sbrdf_jax.representation.tensor_pruning import prune
from sbrdf_jax.representation.tensor_value import pad_ranks
from sbrdf_jax.resampling import resample
from sbrdf_jax.splines import spline_weights

ROUND = tolerance(ROUNDING, np.float64)
THETA = np.radians(np.arange(0, 90.1, 15))
PHI = np.radians(np.arange(0, 360.1, 15))
WAVELENGTH_NM = np.linspace(400.0, 700.0, 9)


def options(**target) -> RepresentOptions:
    return RepresentOptions(method="lobe_tensor", target=TargetOptions(**target))


NUMBERS = options(numbers=120)


def truth(name, theta_i, theta_o, phi_o):
    mesh = np.meshgrid(theta_i, theta_o, phi_o, indexing="ij")
    return np.asarray(builtin.true_brdf(name, *mesh, WAVELENGTH_NM))


def grid_of(brdf, *, theta_i=THETA, extrapolated=None, interpolate_theta_i=True) -> GriddedBRDF:
    lanes = np.zeros(len(WAVELENGTH_NM))
    flags = np.zeros(brdf.shape[:3], int) if extrapolated is None else extrapolated
    return GriddedBRDF(
        theta_i, THETA, PHI, WAVELENGTH_NM, brdf, flags, lanes, lanes, lanes, interpolate_theta_i=interpolate_theta_i
    )


def field_of(gridded, count=4) -> SpectralField:
    return encode_field(gridded, data_basis(WAVELENGTH_NM, np.asarray(gridded.brdf), count))


def eta(found, gridded):
    """Eq. (18) for each incident angle."""
    value = np.stack([on_axes(found, t, THETA, PHI) for t in np.asarray(gridded.theta_i)])
    axes = (1, 2, 3)
    return np.sqrt(((value - gridded.brdf) ** 2).sum(axes) / (np.asarray(gridded.brdf) ** 2).sum(axes))


@pytest.fixture(scope="module")
def amber():
    """The true amber glass on a coarse grid, and its lobe tensor."""
    gridded = grid_of(truth("amber_glass", THETA, THETA, PHI))
    field = field_of(gridded)
    return gridded, field, represent(field, NUMBERS, gridded)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 13])
def test_splines_are_those_of_scipy(count, rng):
    position = np.concatenate([[0.0, 1.0], rng.uniform(size=20)])
    degree = min(3, count - 1)
    knots = np.concatenate([np.zeros(degree), np.linspace(0, 1, count - degree + 1), np.ones(degree)])
    expected = BSpline.design_matrix(position, knots, degree).toarray()
    np.testing.assert_allclose(spline_weights(position, count), expected, rtol=0, atol=ROUND)
    np.testing.assert_allclose(spline_weights(jnp.asarray(position), count), expected, rtol=0, atol=ROUND)
    beyond = spline_weights(np.array([-0.5, 1.5]), count)
    np.testing.assert_allclose(beyond, spline_weights(np.array([0.0, 1.0]), count), rtol=0, atol=0)


def test_direction_functions_know_no_azimuth_at_the_poles_and_are_finite_at_grazing(rng):
    floor = 1e-4
    count = num_direction_functions(floor, is_field=False)
    phi = rng.uniform(0, 6, 5)
    zero, other = np.zeros(5), np.full(5, 0.7)
    for theta_i, theta_o in ((zero, other), (other, zero)):
        found = direction_functions(theta_i, theta_o, phi, floor, count)
        assert found.shape == (5, count)
        assert np.abs(found - found[:1]).max() < ROUND
    grazing, mirror = np.full(1, np.pi / 2), np.full(1, np.pi)
    found = direction_functions(grazing, grazing, mirror, floor, count)
    expected = direction_functions(np.full(1, 0.3), np.full(1, 0.3), mirror, floor, count)  # half angle 0 alike
    assert np.abs(found - expected)[0, :-4].max() < ROUND
    assert found[0, -1] == pytest.approx(1.0, abs=1e-5)  # all is reflected
    assert direction_functions(np.zeros(1), np.zeros(1), mirror, floor, count)[0, -1] == pytest.approx(0.0, abs=ROUND)


def test_each_step_is_plain_least_squares(rng):
    num_i, num_o, num_phi, size, channels = 5, 6, 7, 4, 2
    at_i, at_o = rng.normal(size=(num_i, 4)), rng.normal(size=(num_o, 5))
    function = rng.normal(size=(num_i, num_o, num_phi, size))
    value, weight = rng.normal(size=(num_i, num_o, num_phi, channels)), rng.uniform(0.5, 2, (num_i, num_o, num_phi))
    gram = np.einsum("iop,iopk,iopl->iokl", weight, function, function)
    moment = np.einsum("iop,iopk,iopc->iokc", weight, function, value)
    energy = (weight[..., None] * value**2).sum(axis=(1, 2, 3))
    fit = TensorFit(Normal(gram, moment, energy, at_i, at_o))
    u, v, w = (rng.normal(size=(n, 2)) for n in (4, 5, size))

    def model(u, v, w, core):
        return np.einsum("ia,ob,iopq,abqc->iopc", at_i @ u, at_o @ v, function @ w, core)

    def plain(make, shape):
        """Least squares by the explicit matrix of a linear function."""
        units = np.eye(int(np.prod(shape))).reshape(-1, *shape)
        root = np.sqrt(weight)[..., None]
        matrix = np.stack([(root * make(unit)).ravel() for unit in units], axis=1)
        return np.linalg.lstsq(matrix, (root * value).ravel())[0].reshape(shape)

    solved = fit.solve_core(u, v, fit.project(w))
    core, gain = solved.value, solved.gain
    expected = plain(lambda c: model(u, v, w, c), core.shape)
    loose = 1e-2  # a ridge of 1e-5 of the diagonal
    np.testing.assert_allclose(core, expected, rtol=0, atol=loose)
    left = (weight[..., None] * (value - model(u, v, w, core)) ** 2).sum()
    assert abs(fit.energy - gain.sum() - left) < loose * fit.energy

    for mode, factor in enumerate((u, v, w)):
        wide = np.concatenate([factor, rng.normal(size=(len(factor), 1))], axis=1)
        a, b, q = (wide if k == mode else f for k, f in enumerate((u, v, w)))
        more, widened = fit.solve_core(a, b, fit.project(q)), fit.widened_core(solved, (u, v, w), mode, wide)
        np.testing.assert_allclose(widened.gain, more.gain - gain, rtol=1e-8)
        np.testing.assert_allclose(widened.value, more.value, rtol=1e-6, atol=1e-8)

    assert fit.energy - fit.error(solved, channels) == pytest.approx(gain.sum())
    once = fit.sweep([u, v, w], solved.value, solved.projection)
    by_hand = [u, v, w]
    core = solved.value
    for mode in range(3):

        def with_factor(factor, mode=mode, core=core):
            return model(*[factor if k == mode else f for k, f in enumerate(by_hand)], core)

        by_hand[mode], change = fit.orthonormal(mode, plain(with_factor, by_hand[mode].shape))
        core = np.moveaxis(np.tensordot(change, core, (1, mode)), 0, mode)  # the model is the same
    for found, wanted in zip(once, by_hand, strict=True):
        np.testing.assert_allclose(found @ np.linalg.pinv(found), wanted @ np.linalg.pinv(wanted), rtol=0, atol=loose)

    some = Factors(u, v, w, np.where(rng.uniform(size=solved.value.shape) < 0.6, solved.value, 0.0))
    renewed, by_hand = fit.renewed(some), list(some[:3])
    for mode in range(3):

        def with_given(factor, mode=mode):
            return model(*[factor if k == mode else f for k, f in enumerate(by_hand)], some.core)

        by_hand[mode] = plain(with_given, by_hand[mode].shape)
        np.testing.assert_allclose(renewed[mode], by_hand[mode], rtol=0, atol=loose * np.abs(by_hand[mode]).max())
    assert renewed.core is some.core
    found, error = fit.solve_cells(some)
    cells = plain(lambda c: model(u, v, w, np.where(some.core != 0, c, 0.0)), some.core.shape)
    np.testing.assert_allclose(found.core, cells, rtol=0, atol=loose)
    left = (weight[..., None] * (value - model(*found)) ** 2).sum()
    assert abs(error - left) < 1e-3 * fit.energy


def test_what_is_pruned_is_fitted_to_the_cells_that_are_left(rng, monkeypatch):
    at_i, at_o, w = rng.normal(size=(5, 4)), rng.normal(size=(6, 4)), rng.normal(size=(5, 6, 3, 8))
    gram, moment = w @ np.swapaxes(w, 2, 3), w @ rng.normal(size=(5, 6, 8, 2))
    fit = TensorFit(Normal(gram, moment, np.full(5, 200.0), at_i, at_o))
    factors = fit.start()
    whole = Factors(*factors, fit.solve_core(*factors[:2], fit.project(factors[2])).value)
    found = prune(fit, whole, 5, None)
    monkeypatch.setattr("sbrdf_jax.representation.tensor_pruning.POLISHES", 0)
    bare = prune(fit, whole, 5, None)
    assert np.count_nonzero(found.core) == np.count_nonzero(bare.core) == 5
    errors = [fit.solve_cells(each)[1] for each in (found, bare)]
    assert errors[0] < 0.999 * errors[1]
    _, least = fit.solve_cells(fit.renewed(found))
    assert least > 0.97 * errors[0]  # another round hardly gains


def test_a_promise_that_settling_would_break_is_kept(rng):
    at_i, at_o, w = rng.normal(size=(5, 4)), rng.normal(size=(6, 4)), rng.normal(size=(5, 6, 3, 8))
    gram, moment = w @ np.swapaxes(w, 2, 3), w @ rng.normal(size=(5, 6, 8, 2))
    fit = TensorFit(Normal(gram, moment, np.full(5, 200.0), at_i, at_o))
    asked = []

    def is_enough(factors):
        asked.append(factors)
        return len(asked) == 1  # before settling, and not after

    def alike(factors):
        return np.ones(len(gram))

    found = grow(fit, lambda a, b, q, c, core: 1, 1e6, is_enough, alike, first_channels=2)
    assert len(asked) == 4  # the last is pruned once more, then polished, and no longer enough

    def value(factors):
        return w.swapaxes(2, 3) @ factors.direction @ fit.amplitudes(factors.theta_i, factors.theta_o, factors.core)

    np.testing.assert_allclose(value(found), value(asked[0]), rtol=0, atol=1e-6 * np.abs(value(asked[0])).max())


def test_pruning_takes_the_cell_that_matters_least_and_solves_anew(rng):
    at_i, at_o, function = rng.normal(size=(5, 4)), rng.normal(size=(6, 4)), rng.normal(size=(5, 6, 7, 3))
    moment = np.swapaxes(function, 2, 3) @ rng.normal(size=(5, 6, 7, 2))
    fit = TensorFit(Normal(np.swapaxes(function, 2, 3) @ function, moment, np.full(5, 200.0), at_i, at_o))
    u, v, w = (rng.normal(size=(n, 2)) for n in (4, 4, 3))
    whole = Factors(u, v, w, fit.solve_core(u, v, fit.project(w)).value)
    found = prune(fit, whole, whole.core.size - 1, lambda factors: False)
    assert np.count_nonzero(found.core) == whole.core.size - 1

    u, v, w = found[:3]
    design = np.einsum("ia,ob,iopq->iopabq", at_i @ u, at_o @ v, function @ w).reshape(5 * 6 * 7, -1)
    wanted = np.linalg.lstsq(design.T, moment_of(fit, u, v, w), rcond=None)[0]  # any values of this moment
    error = {}
    for lost in np.ndindex(found.core.shape):
        channel, cell = lost[3], np.ravel_multi_index(lost[:3], found.core.shape[:3])
        kept = np.delete(np.arange(design.shape[1]), cell)
        core, *_ = np.linalg.lstsq(design[:, kept], wanted[:, channel], rcond=None)
        before = np.linalg.lstsq(design, wanted[:, channel], rcond=None)[0]
        error[lost] = np.sum((design[:, kept] @ core - design @ before) ** 2)
        if found.core[lost] == 0:
            rest = found.core[..., channel].ravel()[kept]
            np.testing.assert_allclose(rest, core, rtol=0, atol=1e-4 * np.abs(core).max())
    assert found.core[min(error, key=lambda lost: error[lost])] == 0


def moment_of(fit, u, v, w):
    """The right side [a b q, channel] of the core's normal equations."""
    at_i, at_o = fit.normal.theta_i @ u, fit.normal.theta_o @ v
    return np.einsum("ia,ob,kq,iokc->abqc", at_i, at_o, w, fit.normal.moment).reshape(-1, 2)


def test_a_budget_is_used_and_kept(amber):
    assert 0.99 * 120 * len(THETA) <= stored_numbers(amber[2]) <= 120 * len(THETA)


def test_a_result_that_holds_all_cells_of_the_core_is_read(amber, tmp_path):
    path, (gridded, _, found) = tmp_path / "r.h5", amber
    store.save(path, store.RunResult(gridded=gridded, compact=found))
    with h5py.File(path, "r+") as file:
        del file["compact/core"], file["compact/core_stored"]
        file["compact/core"] = found.core
    np.testing.assert_array_equal(store.load(path).compact.core, found.core)


def test_a_result_without_the_last_direction_function_is_read(amber, tmp_path):
    path, (gridded, _, found) = tmp_path / "r.h5", amber
    store.save(path, store.RunResult(gridded=gridded, compact=found))
    with h5py.File(path, "r+") as file:
        group = file["compact"]
        axis, factor = group["direction_function"][:-1], group["direction_factor"][:-1]
        del group["direction_factor"], group["direction_function"], group.attrs["direction_functions"]
        group["direction_function"], group["direction_factor"] = axis, factor
    earlier = store.load(path).compact.direction_factor
    np.testing.assert_array_equal(earlier[:-1], found.direction_factor[:-1])
    np.testing.assert_array_equal(earlier[-1], 0.0)


def test_the_worst_incident_angle_is_balanced_against_the_others(amber, monkeypatch):
    gridded, field, _ = amber
    options = RepresentOptions(method="lobe_tensor", target=TargetOptions(numbers=60))
    balanced = eta(represent(field, options, gridded), gridded)
    monkeypatch.setattr(tensor_growth, "BALANCE", (0.0,))
    plain = eta(represent(field, options, gridded), gridded)
    assert balanced.max() < plain.max() and np.ptp(balanced) < np.ptp(plain)


def test_a_sharp_lobe_costs_few_numbers_at_the_nodes_and_between_them(amber):
    gridded, _, found = amber
    assert stored_numbers(found) / len(THETA) <= 120
    assert eta(found, gridded)[:-1].max() < 0.02
    theta_i, theta_o, phi_o = np.radians([20.0, 40.0, 50.0]), np.radians([10.0, 37.0, 52.0]), np.radians([5.0, 175.0])
    expected = truth("amber_glass", theta_i, theta_o, phi_o)
    mesh = np.meshgrid(theta_i, theta_o, phi_o, indexing="ij")
    error = np.linalg.norm(evaluate_in_chunks(found, *mesh) - expected) / np.linalg.norm(expected)
    assert error < 0.15  # on a grid of 15 degrees, between which the field is guessed


@pytest.mark.parametrize(("lobe", "allowed"), [(0.0, 3e-4), (3.0, 0.02)], ids=["broad", "with a peak between nodes"])
def test_midway_between_incident_angles_what_is_broad_stays_and_a_peak_moves_on(lobe, allowed):
    def planted(theta_i, theta_o, phi_o):
        i, o, p = np.meshgrid(theta_i, theta_o, phi_o, indexing="ij")
        toward = np.sin(i) ** 2 + np.sin(o) ** 2 + 2 * np.sin(i) * np.sin(o) * np.cos(p)
        diffuse = np.exp(-0.3 * i**2 - 0.2 * o**2)
        return (diffuse + lobe * np.exp(-toward / 0.02))[..., None] * np.linspace(1.0, 2.0, len(WAVELENGTH_NM))

    gridded = grid_of(planted(THETA, THETA, PHI))
    midway = half_field(field_of(gridded), gridded.brdf, gridded).blocks[-1]
    np.testing.assert_allclose(midway.theta_i, THETA[:-1] + np.radians(7.5))
    inner = slice(1, -2)  # five incident angles or more around
    expected = planted(midway.theta_i, midway.theta_o, midway.phi_o)[inner]
    rows = np.abs(midway.theta_o - np.pi / 4) < np.radians(25)
    at_nodes = np.isin(midway.phi_o, PHI)
    error = (midway.brdf[inner] - expected)[:, rows][:, :, at_nodes]
    assert np.linalg.norm(error) < allowed * np.linalg.norm(expected[:, rows][:, :, at_nodes])


@pytest.mark.parametrize("broken", [0.0, 0.5], ids=["reciprocal", "not reciprocal"])
def test_midway_a_row_tells_what_is_known_by_reciprocity_where_rows_agree_on_it(broken):
    theta_i = np.radians(np.arange(0, 90.1, 30))
    amber = truth("amber_glass_broad", THETA, THETA, PHI)
    brdf = amber * np.exp(broken * THETA**2)[:, None, None, None]
    gridded = grid_of(brdf[::2], theta_i=theta_i)
    midway = half_field(field_of(gridded), gridded.brdf, gridded).blocks[-1]
    np.testing.assert_array_equal(midway.theta_o, THETA)
    found, wanted = midway.brdf[:, :, ::2], brdf[1::2, :, : len(PHI) // 2 + 1]
    spline = np.exp(CubicSpline(theta_i, np.log(brdf[::2]))(THETA[1::2]))[:, :, : len(PHI) // 2 + 1]
    off, plain = (np.abs(np.log(value / wanted)).max(axis=(2, 3)) for value in (found, spline))  # [theta_i, theta_o]
    assert (off < 1.2 * plain).all()
    if not broken:
        assert off[:, ::2].max() < ROUND < 0.03 < plain.min()  # rows at those theta_o are known, and say it
        assert off[:, 1::2].mean() < 0.6 * plain[:, 1::2].mean()


def test_left_out_incident_angles_are_measured_where_nothing_is_known_between_them(amber):
    gridded, field, _ = amber
    plan = represent_with_plan(field, NUMBERS, gridded)[1]
    second = grid_of(gridded.brdf[::2], theta_i=THETA[::2])
    twice = half_field(field_of(second), second.brdf, second).blocks[-1]
    whole = np.concatenate([twice.brdf[:, :, ::2], twice.brdf[:, :, -3::-2]], axis=2)
    expected = [np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in zip(whole, gridded.brdf[1::2], strict=True)]
    np.testing.assert_allclose(plan["left_out_error"][1::2], expected, rtol=0.02)  # 0 and 360 degrees are one
    assert np.isnan(plan["left_out_error"][::2]).all()
    four = grid_of(gridded.brdf[:4], theta_i=THETA[:4])
    few = half_field(field_of(four), four.brdf, four)
    assert few.left_out is not None and np.isnan(few.left_out).all()


def test_midway_no_value_is_greater_than_the_rows_around_it_have(amber):
    brdf = np.array(amber[0].brdf)
    brdf[1::2, :, 3:9] = brdf[1::2, :, -9:-3] = 0.0
    blocks = half_field(field_of(amber[0]), brdf, grid_of(brdf)).blocks
    most = blocks[0].brdf.max(axis=(1, 2))
    assert (blocks[-1].brdf.max(axis=(1, 2)) <= np.maximum(most[:-1], most[1:]) * (1 + ROUND)).all()


def test_midway_knows_no_dead_incident_angle_and_guesses_nothing_where_they_are_uneven(amber):
    brdf = np.array(amber[0].brdf)
    brdf[3] = np.nan
    dead = half_field(field_of(amber[0]), brdf, grid_of(brdf)).blocks[-1]
    whole = half_field(field_of(amber[0]), amber[0].brdf, amber[0]).blocks[-1]
    assert (dead.weight[[2, 3]] == 0).all() and (dead.weight[[0, 1, 4, 5]] > 0).all()
    for row in (0, 1, 4):
        assert np.linalg.norm(dead.brdf[row] - whole.brdf[row]) < 0.2 * np.linalg.norm(whole.brdf[row])

    theta_i = np.radians([0.0, 15.0, 45.0, 60.0])
    uneven = grid_of(truth("amber_glass", theta_i, THETA, PHI), theta_i=theta_i)
    assert [block.theta_i.tolist() for block in half_field(field_of(uneven), uneven.brdf, uneven).blocks] == [
        theta_i.tolist()
    ] * 3
    assert eta(represent(field_of(uneven), NUMBERS, uneven), uneven).max() < 0.02


def test_near_the_mirror_direction_it_is_the_field_between_nodes_too(rng):
    samples = builtin.measure("amber_glass", count=400)
    samples = dataclasses.replace(samples, value=samples.value[:, ::20], wavelength_nm=samples.wavelength_nm[::20])
    gridded = resample(samples, make_grid(samples, GridOptions(), bilateral=True), ResampleOptions(tolerance=1e-8))
    field = encode_field(gridded, data_basis(gridded.wavelength_nm, np.asarray(gridded.brdf)[1:-1], 3))
    found, plan = represent_with_plan(field, options(numbers=120), gridded)
    axes = near_mirror(gridded.theta_o, gridded.phi_o)
    pairs = [(on_axes(found, at, *axes), on_axes(gridded, at, *axes)) for at in gridded.theta_i]
    eta = [np.linalg.norm(got - wanted) / np.linalg.norm(wanted) for got, wanted in pairs]
    for half in (None, plan["half_field"]):
        near = error_between(found, gridded, half)["relative_error_near_mirror"]
        np.testing.assert_allclose(near, eta, rtol=1e-6)
    assert np.median(near) < 0.02

    theta_i = rng.uniform(0.2, 1.3, 2000)
    theta_o, phi_o = theta_i + rng.normal(0, 0.03, 2000), np.pi + rng.normal(0, 0.03, 2000) / np.sin(theta_i)
    expected = evaluate_in_chunks(gridded, theta_i, theta_o, phi_o)
    error = np.linalg.norm(evaluate_in_chunks(found, theta_i, theta_o, phi_o) - expected, axis=1)
    relative = error / np.linalg.norm(expected, axis=1)
    assert np.median(relative) < 0.01 and np.quantile(relative, 0.9) < 0.05


def test_never_negative_and_finite_with_gradients_everywhere(amber, rng):
    found = amber[2]
    edges = np.array([0.0, np.pi / 2])
    angles = [np.concatenate([rng.uniform(0, np.pi / 2, 3000), np.repeat(edges, 2)]) for _ in range(2)]
    phi = np.concatenate([rng.uniform(-7, 7, 3000), np.tile([0.0, np.pi], 2)])
    value = evaluate_in_chunks(found, *angles, phi)
    assert np.isfinite(value).all() and (value >= 0).all()
    slope = jax.jit(jax.vmap(jax.grad(lambda a: evaluate(found, a[0], a[1], a[2]).sum())))
    at = jnp.asarray(np.stack([*angles, phi], axis=1)[-40:])
    assert np.isfinite(slope(at)).all()
    step = 1e-6
    for axis in range(3):
        shift = step * jnp.eye(3)[axis]
        ahead, behind = (jax.vmap(lambda a: evaluate(found, *a).sum())(at[:20] + s * shift[None]) for s in (1, -1))
        numeric = np.asarray(ahead - behind) / (2 * step)
        error = np.abs(numeric - np.asarray(slope(at[:20]))[:, axis]).max() / (np.abs(numeric).max() + 1)
        assert error < 1e2 * tolerance(GRADIENT, np.float64)  # a clip at 0 or a sharp lobe within the step


def test_zeros_up_to_shared_ranks_change_nothing(amber, rng):
    _, _, tensor = amber
    padded = pad_ranks(tensor)
    assert all(rank % 8 == 0 for rank in padded.core.shape)
    angles = [jnp.asarray(a) for a in rng.uniform(0, np.pi / 2, (3, 20))]
    for wavelength_nm in (None, jnp.asarray([430.0, 655.0])):
        expected = evaluate(tensor, *angles, wavelength_nm)
        found = evaluate(padded, *angles, wavelength_nm)
        np.testing.assert_allclose(found, expected, rtol=ROUND, atol=1e-13)


def test_the_group_alone_evaluates_to_the_same_numbers(amber, tmp_path, rng):
    gridded, field, found = amber
    store.save(tmp_path / "r.h5", store.RunResult(gridded=gridded, field=field, compact=found))
    again = store.load(tmp_path / "r.h5")
    with h5py.File(tmp_path / "r.h5") as whole, h5py.File(tmp_path / "part.h5", "w") as part:
        part.attrs["schema_name"], part.attrs["schema_version"] = "sbrdf-result", 1
        whole.copy("compact", part)
        sizes: list[int] = []
        part["compact"].visititems(lambda _, item: sizes.append(item.size))
        assert part["compact"].attrs["method"] == "lobe_tensor"
        assert sum(sizes) == part["compact"].attrs["stored_numbers"] == stored_numbers(found)
    angles = rng.uniform(0, 1.5, (3, 50))
    wavelength = np.array([400.0, 512.3])
    alone = store.load_stage(tmp_path / "part.h5", "compact", wavelength)
    expected = evaluate_in_chunks(found, *angles, wavelength)
    for loaded in (alone, again.compact):
        np.testing.assert_allclose(evaluate_in_chunks(loaded, *angles, wavelength), expected, rtol=1e-9, atol=1e-12)
    assert again.field is not None
    np.testing.assert_array_equal(again.field.basis.synthesis, field.basis.synthesis)


@pytest.mark.parametrize("target", [{"error": 0.03}, {"delta_e": 2.0}, {"ratio": 40.0}, {"numbers": 60}], ids=str)
def test_targets_are_met_and_the_plan_says_so(amber, target):
    gridded, field, _ = amber
    known = grid_of(gridded.brdf, extrapolated=np.repeat([0] * 6 + [2], 7 * 25).reshape(7, 7, 25))
    found, plan = represent_with_plan(field, options(**target), known)
    assert plan["is_met"] and not plan["warnings"] and plan["promised"]
    if "error" in target:
        assert eta(found, gridded)[:-1].max() <= 0.03
    elif "delta_e" in target:
        assert error_at_nodes(found, gridded, colour_matching(WAVELENGTH_NM))["delta_e_median"][:-1].max() <= 2.0
    elif "ratio" in target:
        assert compression(found)["compression_ratio"] >= 40
    elif "numbers" in target:
        assert stored_numbers(found) <= 60 * len(THETA)
    np.testing.assert_array_equal(found.status, [Status.OK] * 6 + [Status.SKIPPED])


@pytest.mark.parametrize("kind", ["data", "log_data"])
def test_a_colour_difference_of_a_part_of_the_hemispheres(amber, kind):
    needed = np.zeros(amber[0].brdf.shape[:3], bool)
    needed[1:4, :2, ::24] = needed[2:5, 3:5] = True
    brdf = np.where(needed[..., None], amber[0].brdf, np.nan)
    gridded = dataclasses.replace(grid_of(brdf), needed=needed)
    field = encode_field(gridded, data_basis(WAVELENGTH_NM, np.nan_to_num(brdf), 4, kind))
    for block in half_field(field, brdf, gridded, in_colour=True, in_logarithm=kind == "log_data").blocks:
        assert np.isfinite(block.weight).all()
    found, plan = represent_with_plan(field, options(delta_e=1.0), gridded)
    assert plan["is_met"]
    assert error_at_nodes(found, gridded, colour_matching(WAVELENGTH_NM))["delta_e_median"][2:5].max() <= 1.0


def test_where_a_colour_difference_is_asked_for_errors_count_by_the_slope_of_lightness(amber):
    gridded, field, _ = amber
    brdf = np.array(gridded.brdf)
    brdf[:, :3] *= 1e-3  # darker than where L* is linear
    plain, seen = (half_field(field, brdf, grid_of(brdf), in_colour=c).nodes for c in (False, True))
    more = (seen.weight - plain.weight) / np.where(np.arange(13) == 12, 1.0, 2.0)
    luminance = np.pi * seen.brdf.mean(axis=-1)
    lightness = np.where(luminance > (6 / 29) ** 3, np.cbrt(luminance), (29 / 6) ** 2 * luminance / 3 + 4 / 29)
    step = 1e-6 * luminance
    beyond = luminance + step
    slope = np.where(beyond > (6 / 29) ** 3, np.cbrt(beyond), (29 / 6) ** 2 * beyond / 3 + 4 / 29) - lightness
    squared = (slope / step) ** 2
    for i in range(len(THETA)):
        np.testing.assert_allclose(more[i] / more[i].max(), squared[i] / squared[i].max(), rtol=1e-3)
    assert seen.weight.sum() > 1.5 * plain.weight.sum()
    sizes = []
    for share in (0.0, half_field_module.COLOUR_SHARE):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(half_field_module, "COLOUR_SHARE", share)
            found, plan = represent_with_plan(field, options(delta_e=0.5), gridded)
        assert plan["is_met"]
        sizes.append(stored_numbers(found))
    assert sizes[1] <= sizes[0]


@pytest.mark.parametrize("target", [{"error": 1e-9}, {"numbers": 5}], ids=str)
def test_what_cannot_be_met_is_the_best_and_a_warning(amber, target):
    gridded, field, _ = amber
    found, plan = represent_with_plan(field, options(**target), gridded)
    assert not plan["is_met"] and "is not met" in plan["warnings"][0]
    assert np.isfinite(eta(found, gridded)).all()


@pytest.mark.parametrize("kind", ["cosine", "fourier", "identity"])
def test_other_spectral_bases(amber, kind):
    gridded, _, _ = amber
    field = encode_field(gridded, make_basis(WAVELENGTH_NM, kind, 7))
    found = represent(field, NUMBERS, gridded)
    assert found.basis.kind == kind
    limit = eta_of_truncation(gridded.brdf, field.basis)
    assert (eta(found, gridded)[:-1] < limit[:-1] + 0.05).all()


def test_vectors_of_the_logarithm_are_positive_in_every_direction(amber, tmp_path, rng):
    gridded, _, _ = amber
    brdf = np.array(gridded.brdf)
    dark = brdf[1, 2, [3, -4]].copy()
    brdf[1, 2, [3, -4]] = 0.0  # what a positive form cannot be, and shall not bend for
    gridded = grid_of(brdf)
    field = encode_field(gridded, data_basis(WAVELENGTH_NM, brdf, 4, "log_data"))
    found, plan = represent_with_plan(field, options(numbers=300), gridded)
    assert found.basis.kind == "log_data" and stored_numbers(found) <= 300 * len(THETA) and plan["is_met"]
    assert plan["worst"] == pytest.approx(eta(found, gridded).max())
    assert np.delete(eta(found, gridded), 1).max() < 0.01
    whole = np.array(brdf)
    whole[1, 2, [3, -4]] = dark
    assert eta(found, grid_of(whole)).max() < 0.01
    angles = rng.uniform(0, 1, (3, 100_000)) * np.array([[np.pi / 2], [np.pi / 2], [2 * np.pi]])
    value = evaluate_in_chunks(found, *angles)
    assert value.min() > 0 and np.isfinite(value).all()
    store.save(tmp_path / "r.h5", store.RunResult(gridded=gridded, field=field, compact=found))
    again = store.load(tmp_path / "r.h5")
    for stage, loaded in ((found, again.compact), (field, again.field)):
        some = [angle[:50] for angle in angles]
        np.testing.assert_allclose(evaluate_in_chunks(loaded, *some), evaluate_in_chunks(stage, *some), rtol=1e-9)
    found, plan = represent_with_plan(field, options(delta_e=1.0), gridded)
    assert plan["is_met"] and found.basis.kind == "log_data"
    zero = grid_of(np.zeros_like(brdf))
    dark = represent(encode_field(zero, field.basis), NUMBERS, zero)
    assert (evaluate_in_chunks(dark, np.array(0.3), THETA, np.array(1.0)) == 0).all()


@pytest.mark.parametrize("method", ["paper", "lobe_harmonics"])
def test_sums_of_lobes_are_not_made_of_logarithms(amber, method):
    field = encode_field(amber[0], data_basis(WAVELENGTH_NM, amber[0].brdf, 4, "log_data"))
    with pytest.raises(ValueError, match="log_data"):
        represent(field, RepresentOptions(method=method), amber[0])
    plan = represent_with_plan(field, RepresentOptions(method="auto"), amber[0])[1]
    assert plan["method"] == "lobe_tensor" and "not tried" in plan["tried"]["lobe_harmonics"]


def eta_of_truncation(brdf, basis):
    rest = brdf - brdf @ np.linalg.pinv(basis.synthesis) @ basis.synthesis
    return np.sqrt((rest**2).sum((1, 2, 3)) / (brdf**2).sum((1, 2, 3)))


def test_zero_nonfinite_and_lopsided_fields(amber):
    gridded, _, _ = amber
    dark = grid_of(np.zeros_like(gridded.brdf))
    found = represent(encode_field(dark, make_basis(WAVELENGTH_NM, "identity", 9)), NUMBERS, dark)
    assert (evaluate_in_chunks(found, np.array(0.3), THETA, np.array(1.0)) == 0).all()

    brdf = np.array(gridded.brdf)
    brdf[2, 3, 4] = np.nan
    found = represent(field_of(gridded), NUMBERS, grid_of(brdf))
    assert found.status[2] == Status.NONFINITE and (np.delete(found.status, 2) == Status.OK).all()
    assert np.isfinite(eta(found, gridded)).all()

    brdf[1:] = np.nan
    found = represent(field_of(gridded), NUMBERS, grid_of(brdf))  # one incident angle is left
    assert eta(found, gridded)[0] < 0.02 and np.isfinite(evaluate_in_chunks(found, THETA, THETA, THETA)).all()

    lopsided = grid_of(gridded.brdf * (1 + 0.3 * np.sin(PHI)[:, None]))
    _, plan = represent_with_plan(field_of(lopsided), NUMBERS, lopsided)
    assert "not symmetric" in plan["warnings"][0]


@pytest.mark.parametrize("power", [1e-6, 1e6])
def test_units_do_not_matter(amber, power, rng):
    gridded, _, found = amber
    scaled = grid_of(gridded.brdf * power)
    again = represent(field_of(scaled), NUMBERS, scaled)
    angles = rng.uniform(0, 1.5, (3, 50))
    expected = power * evaluate_in_chunks(found, *angles)
    loose = 1e-3  # in directions that no node shows the ridge decides, at the level of rounding
    np.testing.assert_allclose(evaluate_in_chunks(again, *angles), expected, rtol=0, atol=loose * expected.max())


def test_fewer_than_three_incident_angles_are_not_interpolated():
    theta_i = np.radians([20.0, 55.0])
    gridded = grid_of(truth("amber_glass", theta_i, THETA, PHI), theta_i=theta_i, interpolate_theta_i=False)
    found = represent(field_of(gridded), NUMBERS, gridded)
    assert eta(found, gridded).max() < 0.1  # 240 numbers in all
    zero = np.zeros(2)
    beside = evaluate_in_chunks(found, theta_i + np.array([0.1, 0.3]), zero, zero)  # of the nearest node's factors
    assert found.theta_i_factor.shape[0] == 2 and np.isfinite(beside).all() and (beside >= 0).all()


def test_one_wavelength_and_one_step_finer(amber):
    gridded, _, _ = amber
    one = dataclasses.replace(gridded, brdf=gridded.brdf[..., 3:4], wavelength_nm=WAVELENGTH_NM[3:4])
    found = represent(encode_field(one, make_basis(WAVELENGTH_NM[3:4], "identity", 1)), NUMBERS, one)
    assert eta(found, one)[:-1].max() < 0.02


def test_between_errors_are_those_of_nodes_in_size(amber):
    gridded, _, found = amber
    between = error_between(found, dataclasses.replace(gridded, window="none"))
    assert set(between) == {"relative_error_between", "relative_error_between_theta_i"}


def test_the_data_basis_is_a_singular_value_decomposition(rng):
    spectra = rng.normal(size=(3, 20, 9)) * np.array([1.0, 100.0, 0.01])[:, None, None]
    basis = data_basis(WAVELENGTH_NM, spectra, 4)
    scaled = spectra / np.linalg.norm(spectra, axis=(1, 2), keepdims=True)
    vectors = np.linalg.svd(scaled.reshape(-1, 9))[2][:4]
    np.testing.assert_allclose(abs(vectors @ basis.synthesis.T), np.eye(4), rtol=0, atol=1e3 * ROUND)
    coefficient = encode(spectra, basis)
    np.testing.assert_allclose(decode(coefficient, basis), spectra @ vectors.T @ vectors, rtol=0, atol=1e3 * ROUND)
    assert coefficients_allowed(9, 12, "data")[:2] == ("data", 9)
    assert coefficients_allowed(3, 12, "data").kind == "identity"
    with pytest.raises(ValueError, match="data_basis"):
        make_basis(WAVELENGTH_NM, "data", 3)
