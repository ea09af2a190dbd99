"""Evaluation against plain loops, SciPy and finite differences, at poles and at the mirror direction too."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from sbrdf_jax.encoding import decode
from sbrdf_jax.evaluation import evaluate, evaluate_in_chunks, evaluate_on_axes, spectral_weights
from sbrdf_jax.representation.paper import compact_coefficient
from small_results import UNIFORM_NM, WAVELENGTH_NM, small_compact, small_field, small_grid
from tolerances import GRADIENT, LANE, ROUNDING, tolerance

ROUND = tolerance(ROUNDING, np.float64)


def random_directions(rng, count=20):
    return rng.uniform(0, np.pi / 2, count), rng.uniform(0, np.pi / 2, count), rng.uniform(-2 * np.pi, 4 * np.pi, count)


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
    value = evaluate(grid, *np.meshgrid(grid.theta_i, grid.theta_o, grid.phi_o, indexing="ij"))
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
        value = evaluate(grid, np.deg2rad(theta_i_deg), theta_o, phi_o)
        np.testing.assert_array_equal(value, evaluate(grid, np.deg2rad(node_deg), theta_o, phi_o))
    nodes = evaluate(grid, grid.theta_i[1], grid.theta_o[:, None], grid.phi_o)
    np.testing.assert_allclose(nodes, grid.brdf[1], rtol=0, atol=ROUND)


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
    slope = np.gradient(value, nodes, edge_order=min(2, len(nodes) - 1))
    expected = CubicHermiteSpline(nodes, value, slope)(at)
    weights = np.asarray(spectral_weights(jnp.asarray(at), jnp.asarray(nodes)))
    np.testing.assert_allclose(weights @ value, expected, rtol=0, atol=10 * ROUND)
    np.testing.assert_allclose(spectral_weights(jnp.asarray(nodes), jnp.asarray(nodes)), np.eye(len(nodes)), atol=ROUND)
    if len(nodes) > 2:
        np.testing.assert_allclose(weights @ (nodes - 500) ** 2, (at - 500) ** 2, rtol=0, atol=1e4 * ROUND * 50)


def test_outside_the_measured_wavelengths_is_nan_and_nothing_else(rng):
    for result in (small_grid(rng), small_compact(rng, wavelength_nm=WAVELENGTH_NM)):
        value = evaluate(result, 0.3, 0.4, 0.5, np.array([399.9, 400.0, 700.0, 700.1]))
        np.testing.assert_array_equal(np.isnan(value), [True, False, False, True])
        on_axes = evaluate_on_axes(result, [0.3], [0.4], [0.5], np.array([399.9, 400.0, 700.0, 700.1]))
        np.testing.assert_allclose(on_axes[0, 0, 0], value, atol=ROUND)


@pytest.mark.parametrize("kind", ["fourier", "cosine", "identity"])
def test_compact_is_linear_between_its_incident_angles(rng, kind):
    compact = small_compact(rng, kind=kind)
    theta_i, theta_o, phi_o = random_directions(rng, 12)
    wavelength = rng.uniform(380, 780, 5)
    expected = []
    for incidence, *direction in zip(theta_i, theta_o, phi_o, strict=True):
        at_nodes = np.array([compact_coefficient(compact, i, *map(jnp.asarray, direction)) for i in range(5)])
        blend = [np.interp(incidence, compact.theta_i, column) for column in at_nodes.T]
        expected.append(decode(np.array(blend), compact.basis, wavelength))
    found = evaluate(compact, theta_i, theta_o, phi_o, wavelength)
    np.testing.assert_allclose(found, expected, rtol=0, atol=10 * ROUND)


def test_compact_takes_the_nearest_incident_angle_where_nothing_is_interpolated(rng):
    compact = small_compact(rng, theta_i=np.deg2rad([20.0, 60.0]), interpolate_theta_i=False)
    for theta_i_deg, node_deg in ((0.0, 20.0), (39.0, 20.0), (41.0, 60.0)):
        found, expected = (evaluate(compact, np.deg2rad(t), 0.7, 2.0) for t in (theta_i_deg, node_deg))
        np.testing.assert_array_equal(found, expected)


def test_shapes_broadcast_and_a_lane_alone_is_the_lane_in_the_batch(rng):
    for result in (small_grid(rng), small_field(small_grid(rng)), small_compact(rng)):
        theta_o = rng.uniform(0, np.pi / 2, (3, 1))
        phi_o = rng.uniform(0, 2 * np.pi, (1, 4))
        batch = evaluate(result, 0.6, theta_o, phi_o)
        assert batch.shape[:2] == (3, 4)
        alone = [evaluate(result, 0.6, theta_o[1, 0], p) for p in phi_o[0]]
        np.testing.assert_allclose(batch[1], alone, rtol=0, atol=10 * tolerance(LANE, np.float64))
        mapped = jax.jit(jax.vmap(evaluate, in_axes=(None, None, 0, 0)))(result, 0.6, theta_o[:, 0], phi_o[0, :3])
        np.testing.assert_allclose(mapped, np.diagonal(batch)[:, :3].T, rtol=0, atol=10 * tolerance(LANE, np.float64))


def test_chunks_and_axes_change_nothing(rng):
    for result in (small_grid(rng, window="product"), small_field(small_grid(rng)), small_compact(rng)):
        axes = np.linspace(0, 1.5, 3), np.linspace(0.1, 1.4, 4), np.linspace(-1, 6, 5)
        mesh = np.meshgrid(*axes, indexing="ij")
        wavelength = np.array([450.0, 555.5])
        for wanted in (None, wavelength):
            expected = evaluate(result, *mesh, wanted)
            in_chunks = evaluate_in_chunks(result, *mesh, wanted, chunk_size=7)
            np.testing.assert_allclose(in_chunks, expected, rtol=0, atol=10 * ROUND)
            np.testing.assert_allclose(evaluate_on_axes(result, *axes, wanted), expected, rtol=0, atol=10 * ROUND)
    assert evaluate_in_chunks(small_grid(rng), [], [], []).shape == (0, len(WAVELENGTH_NM))


def test_a_record_or_a_method_without_a_kernel_is_an_error(rng):
    with pytest.raises(TypeError, match="no kernel is registered"):
        evaluate(small_compact(rng).basis, 0.1, 0.2, 0.3)
    with pytest.raises(TypeError, match="field of its own"):
        evaluate(dataclasses.replace(small_grid(rng), method="guided"), 0.1, 0.2, 0.3)


def test_float32_is_float64_within_its_rounding(rng):
    for result in (small_grid(rng), small_compact(rng)):
        to_float32 = lambda leaf: np.asarray(leaf, np.float32) if np.asarray(leaf).dtype == np.float64 else leaf  # noqa: E731
        single = jax.tree.map(to_float32, result)
        directions = random_directions(rng)
        value = evaluate(single, *directions)
        assert value.dtype == np.float32
        atol = 10 * tolerance(ROUNDING, np.float32)
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


@pytest.mark.parametrize("stage", ["grid", "compact"])
def test_gradient_in_the_angles_is_the_central_difference(rng, stage):
    compact = small_compact(rng)
    # "tan" is left out: it has a corner at its peak
    compact = dataclasses.replace(compact, lobe_kind=np.minimum(compact.lobe_kind, 2))
    result = {"grid": small_grid(rng), "compact": compact}[stage]
    h = 1e-5
    found = jax.vmap(jax.grad(total, argnums=1), in_axes=(None, 0))(result, DIRECTIONS)
    up, down = (total(result, DIRECTIONS[:, None, :] + sign * h * np.eye(3)[None]) for sign in (1, -1))
    expected, found = np.array((up - down) / (2 * h)), np.array(found)
    assert np.isfinite(found).all()
    if stage == "compact":  # linear between nodes, clamped outside: no derivative at the first node
        first = DIRECTIONS[:, 0] == 0
        found[first, 0] = expected[first, 0] = 0
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=100 * tolerance(GRADIENT, np.float64))


def test_gradient_at_the_lobes_peak_is_finite_for_every_kind(rng):
    compact = small_compact(rng)
    at_peak = np.array([compact.theta_i[2], compact.lobe_peak_theta_o[2], np.pi])
    assert np.isfinite(jax.grad(total, argnums=1)(compact, at_peak)).all()


def test_gradient_in_the_fitted_numbers_is_the_central_difference(rng):
    directions = random_directions(rng, 4)
    compact = small_compact(rng)
    for result, name in ((small_grid(rng), "brdf"), (compact, "background"), (compact, "lobe_height")):
        value = getattr(result, name)

        def energy(changed, result=result, name=name):
            return (evaluate(dataclasses.replace(result, **{name: changed}), *directions) ** 2).sum()

        way = rng.normal(size=value.shape)
        h = 1e-6
        expected = (energy(value + h * way) - energy(value - h * way)) / (2 * h)
        found = (jax.grad(energy)(value) * way).sum()
        np.testing.assert_allclose(found, expected, rtol=100 * tolerance(GRADIENT, np.float64))
