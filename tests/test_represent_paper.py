"""The paper's compact form: planted fields come back, plain twins agree, hard lanes end sensibly."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import sph_harm_y
from tolerances import PLANTED, ROUNDING, tolerance

from sbrdf_jax import builtin, encoding
from sbrdf_jax.harmonics import harmonic_orders, real_harmonics
from sbrdf_jax.lobes import LOBE_KINDS, lobe_exponents
from sbrdf_jax.options import RepresentOptions
from sbrdf_jax.records import CompactBRDF, SpectralField, Status
from sbrdf_jax.representation import lane_search, represent, represent_with_plan
from sbrdf_jax.representation.background import fit_background, orthonormal_harmonics
from sbrdf_jax.representation.directions import distinct_directions
from sbrdf_jax.representation.lobe_fit import Lobe
from sbrdf_jax.representation.paper import LANE_REASONS, compact_coefficient
from sbrdf_jax.representation.peak import lobe_peaks, plane_of_incidence
from sbrdf_jax.runtime import compile_clock

BACK = tolerance(PLANTED, np.float64)
THETA_I = np.radians([0.0, 15.0, 45.0, 90.0])
THETA_O = np.radians(np.arange(0, 90.1, 7.5))
PHI_O = np.radians(np.arange(0, 360.1, 7.5))
L = 4
EVEN = np.array([m >= 0 for _, m in harmonic_orders(L)])
PAPER = RepresentOptions(method="paper")
HALF_WIDTH = np.radians(6.0)
WIDTH = {k: float(lobe_exponents(np.array(HALF_WIDTH))[k]) / np.log(2) for k in range(1, 4)}


evaluate = jax.jit(compact_coefficient)
slopes = jax.jit(jax.vmap(jax.jacfwd(compact_coefficient, argnums=(2, 3)), (None, 0, 0, 0)))


def at_nodes(compact):
    """Coefficients of a compact form at the nodes [theta_i, theta_o, phi_o, coefficient]."""
    theta, phi = np.meshgrid(THETA_O, PHI_O, indexing="ij")
    return np.stack([evaluate(compact, np.array(i), theta, phi) for i in range(len(compact.theta_i))])


def planted(rng, kind, *, bilateral=True, coefficients=3, width=None):
    """A field made of the model's own parts, and what it is made of."""
    shape = (len(THETA_I), coefficients)
    background = 0.2 * rng.normal(size=(*shape, (L + 1) ** 2))
    background[..., 0] += 2
    background[0][:, [m != 0 for _, m in harmonic_orders(L)]] = 0  # a pole of theta_i: no azimuth
    if bilateral:
        background[..., ~EVEN] = 0
    height = rng.uniform(3, 10, shape) * np.where(np.arange(coefficients) % 2, -1, 1)
    width = np.broadcast_to(WIDTH[kind] if width is None else width, shape) * rng.uniform(0.9, 1.1, shape)
    peak = np.array([0.0, *(THETA_I[1:-1] + 0.03), np.radians(88.0)])
    basis = encoding.make_basis(np.linspace(400.0, 700.0, 31), "fourier", coefficients)
    kinds, none = np.full(shape, kind), np.full(shape, np.nan)
    compact = CompactBRDF(THETA_I, basis, background, kinds, height, width, none, peak, kinds, max_degree=L)
    return SpectralField(THETA_I, THETA_O, PHI_O, at_nodes(compact), basis), compact


def amber(name="amber_glass", theta_i=THETA_I, coefficients=3):
    """The noise-free truth at the nodes, and its field."""
    wavelength_nm = builtin.WAVELENGTH_NM
    brdf = builtin.true_brdf(name, theta_i[:, None, None], THETA_O[None, :, None], PHI_O[None, None, :], wavelength_nm)
    basis = encoding.make_basis(wavelength_nm, "fourier", coefficients)
    return SpectralField(theta_i, THETA_O, PHI_O, np.asarray(encoding.encode(brdf, basis)), basis), brdf


@pytest.mark.parametrize("kind", [1, 2, 3], ids=LOBE_KINDS[1:])
def test_a_field_made_of_the_models_own_parts_comes_back(kind, rng):
    field, made_of = planted(rng, kind, width=0.05 if kind == 3 else None)
    found, plan = represent_with_plan(field, PAPER)
    error = np.abs(at_nodes(found) - field.coefficient).max() / np.abs(field.coefficient).max()
    assert error < 3 * BACK  # the least of many candidates that all are right to rounding
    np.testing.assert_allclose(found.lobe_peak_theta_o, made_of.lobe_peak_theta_o, rtol=0, atol=BACK)
    np.testing.assert_array_equal(found.status, Status.OK)
    np.testing.assert_array_equal(plan["lane_reason"], LANE_REASONS.index("searched"))
    np.testing.assert_array_equal(found.lobe_kind, kind)
    np.testing.assert_allclose(found.lobe_height, made_of.lobe_height, rtol=1e-7)
    np.testing.assert_allclose(found.lobe_width, made_of.lobe_width, rtol=1e-7)
    np.testing.assert_allclose(found.background, made_of.background, rtol=0, atol=1e-6)  # of condition number 562
    assert np.all((found.critical_angle > HALF_WIDTH) & (found.critical_angle < np.pi / 2))


def test_without_mirror_symmetry_all_harmonics_take_part(rng):
    field, made_of = planted(rng, 1, bilateral=False, coefficients=1)
    found = represent(field, dataclasses.replace(PAPER, lobe="angle_squared"))
    error = np.abs(at_nodes(found) - field.coefficient).max() / np.abs(field.coefficient).max()
    assert error < BACK
    np.testing.assert_allclose(found.background, made_of.background, rtol=0, atol=1e-6)


def test_the_papers_case_is_below_its_error_for_each_kind_and_compiles_once():
    field, brdf = amber(theta_i=np.zeros(1), coefficients=19)
    other, _ = amber("amber_glass_broad", theta_i=np.zeros(1), coefficients=19)
    for kind in LOBE_KINDS[1:]:
        found = represent(field, dataclasses.replace(PAPER, lobe=kind))
        spectrum = encoding.decode(at_nodes(found), found.basis)
        eta = np.sqrt(np.sum((spectrum - brdf) ** 2) / np.sum(brdf**2))
        assert eta < 0.045, kind
        assert found.lobe_kind[0, 0] == LOBE_KINDS.index(kind)
    with compile_clock() as clock:
        represent(other, dataclasses.replace(PAPER, lobe="tan"))  # another material of the same geometry
    assert clock.num_compiled == 0 and clock.seconds == 0


def test_background_equals_lstsq_on_the_raw_harmonics_of_all_nodes():
    field, _ = amber()
    directions = distinct_directions(THETA_O, PHI_O)
    assert directions.weight.sum() == 13 * 49 and len(directions.weight) == 12 * 25 + 1
    harmonics = orthonormal_harmonics(directions, L)
    theta, phi = np.meshgrid(THETA_O, PHI_O, indexing="ij")
    raw = np.asarray(real_harmonics(theta, phi, L)).reshape(-1, len(EVEN))[:, EVEN]
    peak, i = np.array([0.0, 0.27, 0.8, 1.5]), np.arange(4)
    alpha, exponent = lane_search.lobe_geometry(peak, directions)
    value = directions.split(field.coefficient)[0][:, 0]
    kinds = lane_search.lobe_kinds((1,), THETA_O[1])
    pairs = lane_search.Pairs(
        value / value.max(axis=1, keepdims=True), np.zeros_like(value), alpha, exponent[:, kinds.index]
    )
    functions = lane_search.Functions(harmonics.value, np.zeros((len(value.T), 0)), directions.weight)
    lanes = lane_search.search_lanes(pairs, kinds, functions)
    for lane in i:
        for candidate in (0, 8):
            outside = (alpha[lane] > lanes.critical_angle[lane, candidate])[directions.index].ravel()
            expected, *_ = np.linalg.lstsq(
                raw[outside], pairs.value[lane][directions.index].ravel()[outside], rcond=1e-12
            )
            found = harmonics.to_harmonics @ lanes.even[lane, candidate]
            scale = np.abs(expected).max()
            np.testing.assert_allclose(found[EVEN], expected, rtol=0, atol=1e-6 * scale)
            np.testing.assert_allclose(found[~EVEN], 0)
            np.testing.assert_allclose((raw @ found[EVEN])[outside], (raw @ expected)[outside], rtol=0, atol=1e-9)


def test_a_background_seen_from_outside_a_wide_cone_comes_back(rng):
    directions = distinct_directions(THETA_O, PHI_O)
    functions = orthonormal_harmonics(directions, 8).value
    gram = functions.T @ (directions.weight[:, None] * functions)
    np.testing.assert_allclose(gram, np.eye(len(gram)), rtol=0, atol=tolerance(ROUNDING, np.float64))
    alpha, _ = lane_search.lobe_geometry(np.array([0.5]), directions)
    outside = alpha[0] > np.radians(46.0)  # eigenvalues of the Gram matrix down to 1e-6
    planted_coefficient = rng.normal(size=len(gram))
    value = functions @ planted_coefficient
    found = jax.jit(fit_background)(*(jax.numpy.asarray(a) for a in (value, outside, functions, directions.weight)))
    np.testing.assert_allclose(
        functions @ found, value, rtol=0, atol=tolerance(ROUNDING, np.float64) * np.abs(value).max()
    )


def test_the_winner_counts_the_part_that_no_lobe_touches():
    nothing, one = np.zeros((1, 2, 1)), np.ones((1, 2, 1))
    lobe = Lobe(one, one, np.zeros((1, 2, 1), int), np.zeros((1, 2, 1), int), np.array([[[1.0], [2.0]]]))
    critical_angle, odd_error = np.array([[0.3, 0.6]]), np.array([[5.0, 1.0]])
    lanes = lane_search.Lanes(critical_angle, nothing, nothing, odd_error, nothing, nothing > 0, lobe)
    pairs = lane_search.Pairs(*(np.zeros((1, 1)),) * 3, np.zeros((1, 1, 1)))
    best = lane_search.best_lanes(lanes, pairs, lane_search.LobeKinds((2,), np.ones((1, 2))), np.ones(1))
    assert (best.critical_angle, best.error, best.kind) == (0.6, 3.0, 2)


def test_stationary_lobes_are_no_worse_than_scipys_from_many_starts(rng):
    field, _ = amber("amber_glass_sharp")
    directions = distinct_directions(THETA_O, PHI_O)
    harmonics = orthonormal_harmonics(directions, L)
    kinds = lane_search.lobe_kinds((1, 2, 3), THETA_O[1])
    alpha, exponent = lane_search.lobe_geometry(np.array([0.0, 0.27, 0.8, 1.5]), directions)
    value = directions.split(field.coefficient)[0][:, 0]
    pairs = lane_search.Pairs(
        value / value.max(axis=1, keepdims=True), np.zeros_like(value), alpha, exponent[:, kinds.index]
    )
    functions = lane_search.Functions(harmonics.value, np.zeros((len(value.T), 0)), directions.weight)
    lanes = lane_search.search_lanes(pairs, kinds, functions)
    best = lane_search.best_lanes(lanes, pairs, kinds, directions.weight)
    np.testing.assert_array_equal(best.lobe.status, Status.OK)
    assert np.all(best.lobe.error <= np.min(lanes.lobe.error, axis=(1, 2)) * (1 + 1e-4))  # over all directions

    is_stationary = lanes.lobe.status != Status.MAX_STEPS
    assert is_stationary.mean() > 0.6 and lanes.lobe.num_steps.max() <= 12  # the rest never wins unfinished
    chosen = rng.permutation(np.flatnonzero(is_stationary))[:25]
    for p, c, k in zip(*np.unravel_index(chosen, is_stationary.shape), strict=True):
        root = np.sqrt(directions.weight * lanes.inside[p, c])
        target, s, ends = lanes.target[p, c], pairs.exponent[p, k], np.log(kinds.widths[k][[0, -1]])

        def residual(x, root=root, target=target, s=s):
            return root * (x[0] * np.exp(-s / np.exp(x[1])) - target)

        own = np.sum(residual((lanes.lobe.height[p, c, k], np.log(lanes.lobe.width[p, c, k]))) ** 2)
        bounds = ([-np.inf, ends[0]], [np.inf, ends[1]])
        starts = ((target[np.argmin(alpha[p])], x) for x in np.linspace(ends[0] + 0.1, ends[1] - 0.1, 4))
        scipys = 2 * min(least_squares(residual, start, bounds=bounds, x_scale="jac").cost for start in starts)
        assert own <= scipys * (1 + 1e-5) + 1e-18 * np.sum((root * target) ** 2), (p, c, k)


def test_hard_lanes_end_sensibly_beside_good_ones(rng):
    field, _ = planted(rng, 1, coefficients=7)
    value = np.array(field.coefficient)
    clean = represent(field, PAPER)
    value[1, 3, 5, 1] = np.nan  # and no mirror symmetry is lost: NaN stands for its twin too
    value[1, 3, -6, 1] = np.nan
    value[2, :, :, 2] = 0
    value[:, :, :, 3] = 1.5  # a constant is background
    spike = np.zeros_like(value[0, :, :, 4])
    spike[0] = 1.0  # a lobe narrower than the grid: one direction
    value[0, :, :, 4] = 0.1 + spike
    value[..., 5] *= 1e-6
    value[..., 6] *= 1e6
    found, plan = represent_with_plan(dataclasses.replace(field, coefficient=value), PAPER)

    assert found.status[1, 1] == Status.NONFINITE and np.isnan(found.background[1, 1]).all()
    assert plan["lane_reason"][1, 1] == LANE_REASONS.index("nonfinite")
    assert found.status[2, 2] == Status.NO_LOBE and not found.background[2, 2].any()
    assert plan["lane_reason"][2, 2] == LANE_REASONS.index("zero_everywhere")
    np.testing.assert_array_equal(found.status[:, 3], Status.NO_LOBE)
    np.testing.assert_array_equal(plan["lane_reason"][:, 3], LANE_REASONS.index("background_suffices"))
    np.testing.assert_allclose(found.background[:, 3, 0], 1.5 * np.sqrt(4 * np.pi), rtol=1e-9)
    assert found.status[0, 4] == Status.CLAMPED
    assert found.lobe_width[0, 4] == pytest.approx(WIDTH[1] * np.log(2) * (7.5 / 6) ** 2 / np.log(1000), rel=1e-9)
    for k, factor in ((0, 1), (5, 1e-6), (6, 1e6)):  # as if the others were not there
        np.testing.assert_allclose(found.lobe_height[:, k], factor * clean.lobe_height[:, k], rtol=1e-9)
        np.testing.assert_allclose(found.lobe_width[:, k], clean.lobe_width[:, k], rtol=1e-9)
    has_lobe = found.lobe_kind > 0
    assert np.isfinite(found.critical_angle[has_lobe]).all() and np.isnan(found.critical_angle[~has_lobe]).all()
    rebuilt = at_nodes(found)
    np.testing.assert_array_equal(np.isnan(rebuilt).any(axis=(1, 2)), ~np.isfinite(value).all(axis=(1, 2)))
    assert plan["num_lobe_fits"] == np.sum(plan["lane_reason"] == 0) * 21 * 3


def test_peaks_in_the_plane_of_incidence():
    directions = distinct_directions(THETA_O, PHI_O)
    plane = plane_of_incidence(THETA_O, PHI_O, directions)
    theta_i = np.radians([0.0, 30.0, 30.0, 30.0, 30.0, 89.0])
    peak = np.radians([0.0, 33.0, 0.0, 30.0, 90.0, 88.0])
    alpha, _ = lane_search.lobe_geometry(peak, directions)
    value = np.exp(-(alpha**2) / 0.05)
    np.testing.assert_allclose(lobe_peaks(plane, value, theta_i), peak, rtol=0, atol=1e-12)
    assert plane.signed_theta[0] == -np.pi / 2 and np.all(np.diff(plane.signed_theta) > 0)
    value[1] = -1.0  # nothing positive: the mirror direction
    value[2] = alpha[2] < 0.01  # no logarithm beside the highest node: that node
    value[3] = directions.theta_o  # a parabola that opens upwards or not at all: the highest node
    found = lobe_peaks(plane, value, theta_i)[1:4]
    np.testing.assert_allclose(found, [theta_i[1], 0.0, np.pi / 2], rtol=0, atol=1e-12)


def test_evaluation_equals_its_twin_and_has_finite_gradients(rng):
    _, compact = planted(rng, 3)
    compact = dataclasses.replace(compact, lobe_kind=np.broadcast_to([0, 1, 3], (4, 3)))
    theta, phi, node = rng.uniform(0, np.pi / 2, 20), rng.uniform(-np.pi, np.pi, 20), rng.integers(0, 4, 20)
    found = evaluate(compact, node, theta, phi)
    for j in range(20):
        i = node[j]
        complex_harmonic = [sph_harm_y(degree, abs(m), theta[j], phi[j]) for degree, m in harmonic_orders(L)]
        parts = zip(complex_harmonic, harmonic_orders(L), strict=True)
        harmonic = [(y.imag if m < 0 else y.real) * (np.sqrt(2) * (-1) ** m if m else 1) for y, (_, m) in parts]
        peak = compact.lobe_peak_theta_o[i]
        cosine = np.cos(theta[j]) * np.cos(peak) - np.sin(theta[j]) * np.sin(peak) * np.cos(phi[j])
        alpha = np.arccos(cosine)
        height, width = compact.lobe_height[i], compact.lobe_width[i]
        lobe = [0, height[1] * np.exp(-(alpha**2) / width[1]), height[2] * np.exp(-np.tan(alpha) / width[2])]
        expected = compact.background[i] @ harmonic + np.where([True, True, alpha < np.pi / 2], lobe, 0)
        np.testing.assert_allclose(found[j], expected, rtol=0, atol=1e-11)

    alone = jax.jit(jax.vmap(compact_coefficient, (None, 0, 0, 0)))(compact, node, theta, phi)
    np.testing.assert_allclose(alone, found, rtol=0, atol=1e-13)
    for where in (compact.lobe_peak_theta_o, np.zeros(4), np.full(4, np.pi / 2)):  # the peak, the pole, the horizon
        assert all(np.isfinite(a).all() for a in slopes(compact, np.arange(4), where, np.full(4, np.pi)))


def test_the_two_parts_of_a_field_weigh_as_its_nodes(rng):
    directions = distinct_directions(THETA_O, PHI_O)
    value = rng.normal(size=(2, 13, 49, 3))
    value[:, 0] = value[:, 0, :1]
    value[:, :, -1] = value[:, :, 0]
    even, odd = directions.split(value)
    nodes = even[:, :, directions.index] + directions.side * odd[:, :, directions.index]
    np.testing.assert_allclose(np.moveaxis(nodes, 1, -1), value, rtol=0, atol=1e-12)
    np.testing.assert_allclose((even**2 + odd**2) @ directions.weight, np.sum(value**2, axis=(1, 2)), rtol=1e-12)
    assert not directions.split(value + value[:, :, ::-1])[1].any()
    with pytest.raises(ValueError, match="symmetric"):
        distinct_directions(THETA_O, PHI_O[:20])


def test_a_coarse_grid_still_has_an_answer():
    theta_o, phi_o = np.radians([0.0, 45.0, 90.0]), np.radians(np.arange(0, 361, 90.0))
    basis = encoding.make_basis(np.array([450.0, 550.0, 650.0]), "identity", 3)
    value = np.ones((1, 3, 5, 3)) + np.array([0.0, 1.0, 0.0])[None, :, None, None]
    found = represent(SpectralField(np.array([0.6]), theta_o, phi_o, value, basis), PAPER)
    assert np.isfinite(found.background).all() and np.isin(found.status, [s.value for s in Status]).all()
