"""Evaluation against plain loops, SciPy and finite differences, at poles and at the mirror direction too.

Nearly all tests evaluate `COUNT` directions at a time, because one shape compiles once.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from small_results import UNIFORM_NM, WAVELENGTH_NM, small_compact, small_field, small_grid
from tolerances import GRADIENT, LANE, ROUNDING, tolerance

from sbrdf_jax.encoding import decode
from sbrdf_jax.evaluation import (
    evaluate,
    evaluate_in_chunks,
    evaluate_on_axes,
    evaluate_standard_error,
)
from sbrdf_jax.interpolation import neighbours, spectral_weights
from sbrdf_jax.representation.paper import compact_coefficient
from sbrdf_jax.runtime import compile_clock

COUNT = 20
ROUND = tolerance(ROUNDING, np.float64)


def random_directions(rng):
    return rng.uniform(0, np.pi / 2, COUNT), rng.uniform(0, np.pi / 2, COUNT), rng.uniform(-6.0, 12.0, COUNT)


def sinc_by_loops(grid, theta_i, theta_o, phi_o):
    """Eqs. (5) and (17) as three loops over the nodes, phi_o to the nearest image."""
    value = np.zeros(len(grid.wavelength_nm))
    step_i, step_o, step_phi = (axis[1] - axis[0] for axis in (grid.theta_i, grid.theta_o, grid.phi_o))
    for m, node_i in enumerate(grid.theta_i):
        for n, node_o in enumerate(grid.theta_o):
            for k, node_phi in enumerate(grid.phi_o[:-1]):
                d_phi = min((phi_o - node_phi + 2 * np.pi * image for image in range(-4, 5)), key=abs)
                distance = np.array([theta_i - node_i, theta_o - node_o, d_phi])
                cosine = np.cos(2 * distance)
                window = {
                    "none": 1.0,
                    "product": max(cosine.prod(), 0.0),
                    "factor": cosine.prod() * (abs(distance) <= np.pi / 4).all(),
                }[grid.window]
                value += window * np.sinc(distance / [step_i, step_o, step_phi]).prod() * grid.brdf[m, n, k]
    return value


@pytest.mark.parametrize("window", ["none", "product", "factor"])
def test_grid_is_the_windowed_sinc_of_all_nodes(rng, window):
    grid = small_grid(rng, window=window)
    directions = random_directions(rng)
    expected = [sinc_by_loops(grid, *direction) for direction in zip(*directions, strict=True)]
    np.testing.assert_allclose(evaluate(grid, *directions), expected, rtol=0, atol=ROUND)


@pytest.mark.parametrize("window", ["none", "product", "factor"])
def test_grid_meets_its_nodes(rng, window):
    grid = small_grid(rng, window=window)
    mesh = np.meshgrid(grid.theta_i, grid.theta_o, grid.phi_o, indexing="ij")
    value = evaluate_in_chunks(grid, *mesh, chunk_size=COUNT)
    np.testing.assert_allclose(value, grid.brdf, rtol=0, atol=ROUND)


def test_azimuth_has_the_period_of_the_circle(rng):
    grid, compact = small_grid(rng), small_compact(rng)
    theta_i, theta_o, phi_o = random_directions(rng)
    for result in (grid, compact):
        value = evaluate(result, theta_i, theta_o, phi_o)
        turned = evaluate(result, theta_i, theta_o, phi_o + 2 * np.pi)
        np.testing.assert_allclose(turned, value, rtol=0, atol=1e3 * ROUND)


def test_few_incident_angles_are_not_interpolated(rng):
    grid = small_grid(rng, interpolate_theta_i=False, window="product")
    _, theta_o, phi_o = random_directions(rng)
    for theta_i_deg, node_deg in ((0.0, 20.0), (37.0, 20.0), (38.0, 55.0), (90.0, 55.0)):
        value, at_node = (
            evaluate(grid, np.full(COUNT, np.deg2rad(t)), theta_o, phi_o) for t in (theta_i_deg, node_deg)
        )
        np.testing.assert_array_equal(value, at_node)
    mesh = np.meshgrid(grid.theta_i, grid.theta_o, grid.phi_o, indexing="ij")
    np.testing.assert_allclose(evaluate_in_chunks(grid, *mesh, chunk_size=COUNT), grid.brdf, rtol=0, atol=ROUND)

    compact = small_compact(rng, theta_i=np.deg2rad([20.0, 60.0]), interpolate_theta_i=False)
    near = evaluate(compact, np.deg2rad(np.linspace(0, 80, COUNT)), np.full(COUNT, 0.7), np.full(COUNT, 2.0))
    node = np.where(np.linspace(0, 80, COUNT) < 40, 20.0, 60.0)
    at_node = evaluate(compact, np.deg2rad(node), np.full(COUNT, 0.7), np.full(COUNT, 2.0))
    np.testing.assert_array_equal(near, at_node)


def test_one_incident_angle_is_enough(rng):
    grid = small_grid(rng, interpolate_theta_i=False)
    grid = dataclasses.replace(grid, theta_i=grid.theta_i[:1], brdf=grid.brdf[:1])
    np.testing.assert_allclose(evaluate(grid, 1.0, grid.theta_o[2], grid.phi_o[3]), grid.brdf[0, 2, 3], atol=ROUND)
    compact = small_compact(rng, theta_i=np.array([0.4]))
    np.testing.assert_array_equal(evaluate(compact, 1.0, 0.3, 0.2), evaluate(compact, 0.4, 0.3, 0.2))


def test_spectral_field_is_the_decoded_kernel_sum(rng):
    grid = small_grid(rng, window="none")
    field = small_field(grid, coefficients=7)
    of_coefficients = dataclasses.replace(grid, brdf=field.coefficient, wavelength_nm=np.arange(7.0))
    directions = random_directions(rng)
    wavelength = np.array([405.0, 555.0])
    expected = decode(evaluate(of_coefficients, *directions), field.basis, wavelength)
    np.testing.assert_allclose(evaluate(field, *directions, wavelength), expected, rtol=0, atol=ROUND)


@pytest.mark.parametrize("nodes", [WAVELENGTH_NM, UNIFORM_NM, WAVELENGTH_NM[:3], WAVELENGTH_NM[:2]], ids=len)
def test_between_wavelengths_it_is_scipys_hermite_cubic(rng, nodes):
    value = rng.uniform(size=len(nodes))
    at = np.sort(np.concatenate([nodes, rng.uniform(nodes[0], nodes[-1], 50)]))
    slope = np.gradient(value, nodes, edge_order=2 if len(nodes) > 2 else 1)
    expected = CubicHermiteSpline(nodes, value, slope)(at)
    weights = np.asarray(spectral_weights(jnp.asarray(at), jnp.asarray(nodes)))
    np.testing.assert_allclose(weights @ value, expected, rtol=0, atol=10 * ROUND)
    np.testing.assert_allclose(weights[np.isin(at, nodes)], np.eye(len(nodes)), rtol=0, atol=ROUND)
    if len(nodes) > 2:
        np.testing.assert_allclose(weights @ (nodes - 500) ** 2, (at - 500) ** 2, rtol=0, atol=8e4 * 10 * ROUND)


@pytest.mark.parametrize("nodes", [WAVELENGTH_NM[:n] for n in (1, 2, 3, 4, 8)], ids=len)
def test_neighbours_are_all_that_interpolation_needs(rng, nodes):
    ends_and_nodes = np.concatenate([nodes, [nodes[0] - 1e-9, nodes[-1] + 1e-9]])
    single = [np.array([at]) for at in (*ends_and_nodes, *rng.uniform(nodes[0], nodes[-1], 20))]
    for at in (*single, *rng.uniform(nodes[0], nodes[-1], (10, 2))):
        near = neighbours(at, nodes)
        assert len(near) <= 4 * len(at)
        alone = np.zeros((len(at), len(nodes)))
        alone[:, near] = spectral_weights(jnp.asarray(at), jnp.asarray(nodes[near]))
        whole = spectral_weights(jnp.asarray(at), jnp.asarray(nodes))
        np.testing.assert_allclose(alone, whole, rtol=0, atol=10 * ROUND)


def test_outside_the_measured_wavelengths_is_nan_and_nothing_else(rng):
    directions, wanted = random_directions(rng), np.array([399.9, 400.0, 700.0, 700.1])
    for result in (small_grid(rng), small_compact(rng, wavelength_nm=WAVELENGTH_NM)):
        value = evaluate(result, *directions, wanted)
        np.testing.assert_array_equal(np.isnan(value), np.tile([True, False, False, True], (COUNT, 1)))
    on_axes = evaluate_on_axes(small_grid(rng), [0.3], [0.4], [0.5], wanted)
    np.testing.assert_array_equal(np.isnan(on_axes[0, 0, 0]), [True, False, False, True])


def test_compact_is_linear_between_its_incident_angles(rng):
    compact = small_compact(rng)
    theta_i, theta_o, phi_o = random_directions(rng)
    wavelength = rng.uniform(380, 780, 5)
    at_node = jax.jit(jax.vmap(compact_coefficient, in_axes=(None, None, 0, 0)))
    at_nodes = np.array([at_node(compact, i, theta_o, phi_o) for i in range(5)])
    blend = [
        [np.interp(incidence, compact.theta_i, column) for column in at_nodes[:, lane].T]
        for lane, incidence in enumerate(theta_i)
    ]
    found = evaluate(compact, theta_i, theta_o, phi_o, wavelength)
    np.testing.assert_allclose(found, decode(np.array(blend), compact.basis, wavelength), rtol=0, atol=10 * ROUND)


def test_shapes_broadcast_and_a_lane_alone_is_the_lane_in_the_batch(rng):
    theta_o, phi_o = rng.uniform(0, np.pi / 2, (5, 1)), rng.uniform(0, 2 * np.pi, (1, 4))
    mesh = np.broadcast_arrays(0.6, theta_o, phi_o)
    for result in (small_grid(rng), small_compact(rng)):
        broadcast = evaluate(result, 0.6, theta_o, phi_o)
        assert broadcast.shape[:2] == (5, 4)
        batch = evaluate(result, *(axis.reshape(-1) for axis in mesh))
        np.testing.assert_allclose(broadcast.reshape(batch.shape), batch, rtol=0, atol=10 * tolerance(LANE, np.float64))
        alone = [evaluate(result, *(axis.reshape(-1)[lane] for axis in mesh)) for lane in range(3)]
        np.testing.assert_allclose(batch[:3], alone, rtol=0, atol=10 * tolerance(LANE, np.float64))
    grid = small_grid(rng)
    mapped = jax.jit(jax.vmap(evaluate, in_axes=(None, None, 0, None)))(grid, 0.6, theta_o[:, 0], phi_o[0])
    np.testing.assert_allclose(
        mapped, evaluate(grid, 0.6, theta_o, phi_o), rtol=0, atol=10 * tolerance(LANE, np.float64)
    )


def test_chunks_and_axes_change_nothing(rng):
    axes = np.linspace(0, 1.5, 3), np.linspace(0.1, 1.4, 2), np.linspace(-1, 6, 5)
    mesh = np.meshgrid(*axes, indexing="ij")
    flat = np.stack(mesh).reshape(3, 30)
    results = small_grid(rng, window="product"), small_grid(rng, interpolate_theta_i=False), small_compact(rng)
    for result, wanted in zip(results, (None, np.array([450.0, 555.5]), None), strict=True):
        first, last = evaluate(result, *flat[:, :COUNT], wanted), evaluate(result, *flat[:, -COUNT:], wanted)
        expected = np.concatenate([first, last[2 * COUNT - 30 :]]).reshape(3, 2, 5, -1)
        in_chunks = evaluate_in_chunks(result, *mesh, wanted, chunk_size=COUNT)
        np.testing.assert_allclose(in_chunks, expected, rtol=0, atol=10 * ROUND)
        np.testing.assert_allclose(evaluate_on_axes(result, *axes, wanted), expected, rtol=0, atol=10 * ROUND)
    assert evaluate_in_chunks(small_grid(rng), [], [], []).shape == (0, len(WAVELENGTH_NM))


def test_a_second_chunk_or_result_of_equal_shape_traces_nothing(rng):
    directions = random_directions(rng)
    traced = []

    @jax.jit
    def traced_evaluate(result, *angles):
        traced.append(1)
        return evaluate(result, *angles)

    for result in (small_grid(rng), small_grid(rng)):
        traced_evaluate(result, *directions)
    assert len(traced) == 1
    evaluate_in_chunks(small_grid(rng), *directions, chunk_size=COUNT)
    theta_i, theta_o, phi_o = (np.tile(axis, 3)[:50] for axis in directions)
    with compile_clock() as clock:
        evaluate_in_chunks(small_grid(rng), theta_i, theta_o, phi_o, chunk_size=COUNT)
    assert clock.num_compiled == 0


def test_a_record_without_a_kernel_is_an_error(rng):
    with pytest.raises(TypeError, match="no kernel is registered"):
        evaluate(small_compact(rng).basis, 0.1, 0.2, 0.3)
    with pytest.raises(TypeError, match="no standard error"):
        evaluate_standard_error(small_grid(rng), *np.full((3, 1), 0.1))


def test_float32_is_float64_within_its_rounding(rng):
    directions, atol = random_directions(rng), 10 * tolerance(ROUNDING, np.float32)
    for result in (small_grid(rng), small_compact(rng)):
        single = jax.tree.map(lambda a: a.astype(np.float32) if a.dtype == np.float64 else a, result)
        value = evaluate(single, *directions)
        assert value.dtype == np.float32
        np.testing.assert_allclose(value, evaluate(result, *directions), rtol=0, atol=atol)


DIRECTIONS = np.array(
    [
        (0.61, 0.83, 2.1),
        (0.61, 0.0, 2.1),  # pole
        (0.0, 0.83, 2.1),  # normal incidence
        (1.5, 1.5, 0.2),  # grazing
        (0.61, 0.61, np.pi),  # mirror
        (0.0, 0.0, 0.0),
    ]
)


@jax.jit
def total(result, direction):
    return evaluate(result, direction[..., 0], direction[..., 1], direction[..., 2]).sum(-1)


slope = jax.jit(jax.vmap(jax.grad(total, argnums=1), in_axes=(None, 0)))


@pytest.mark.parametrize("stage", ["grid", "compact"])
def test_gradient_in_the_angles_is_the_central_difference(rng, stage):
    compact = small_compact(rng)
    # "tan" is left out: it has a corner at its peak
    compact = dataclasses.replace(compact, lobe_kind=np.minimum(compact.lobe_kind, 2))
    result = {"grid": small_grid(rng), "compact": compact}[stage]
    h = 1e-5
    up, down = (total(result, DIRECTIONS[:, None, :] + sign * h * np.eye(3)[None]) for sign in (1, -1))
    expected, found = np.array((up - down) / (2 * h)), np.array(slope(result, DIRECTIONS))
    assert np.isfinite(found).all()
    if stage == "compact":  # linear between nodes, clamped outside: no derivative at the first node
        first = DIRECTIONS[:, 0] == 0
        found[first, 0] = expected[first, 0] = 0
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=100 * tolerance(GRADIENT, np.float64))


def test_gradient_at_the_lobes_peak_is_finite_for_every_kind(rng):
    compact = small_compact(rng)
    peaks = np.stack([compact.theta_i, compact.lobe_peak_theta_o, np.full(5, np.pi)], axis=-1)
    assert np.isfinite(slope(compact, peaks[[0, 1, 2, 3, 4, 4]])).all()


def test_gradient_in_the_fitted_numbers_is_the_central_difference(rng):
    directions, h = random_directions(rng), 1e-6
    compact = small_compact(rng)
    energy = jax.jit(lambda result: (evaluate(result, *directions) ** 2).sum())
    for result, names in ((small_grid(rng), ("brdf",)), (compact, ("background", "lobe_height", "lobe_width"))):
        gradient = jax.jit(jax.grad(energy, allow_int=True))(result)
        for name in names:
            value = getattr(result, name)
            way = rng.normal(size=value.shape)
            up, down = (energy(dataclasses.replace(result, **{name: value + sign * h * way})) for sign in (1, -1))
            found = (getattr(gradient, name) * way).sum()
            np.testing.assert_allclose(found, (up - down) / (2 * h), rtol=100 * tolerance(GRADIENT, np.float64))
