"""Harmonics and lobes: shapes, joint least squares against SciPy, allocation, planted fields, targets, hard input."""

import itertools

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from tolerances import GRADIENT, ROUNDING, tolerance

from sbrdf_jax import builtin, store
from sbrdf_jax.encoding import data_basis, encode_field, make_basis
from sbrdf_jax.evaluation import evaluate, evaluate_in_chunks
from sbrdf_jax.metrics import compression, on_axes, stored_numbers
from sbrdf_jax.options import RepresentOptions, TargetOptions
from sbrdf_jax.records import GriddedBRDF, LobeHarmonics, Status
from sbrdf_jax.representation import represent, represent_with_plan
from sbrdf_jax.representation.allocation import angle_choices, lower_hull, make_ladder, spend
from sbrdf_jax.representation.joint_fit import Lobes, heights_and_errors, inner_products, make_problem, shapes_of
from sbrdf_jax.representation.joint_fit import shapes_and_slopes as columns_of
from sbrdf_jax.representation.joint_polish import FURTHEST, polish_lobes, projected_step
from sbrdf_jax.representation.lobe_family import SHAPES, lobe_shapes, width_limits
from sbrdf_jax.representation.lobe_harmonics_value import even_orders, geometric_mean, same_half_vector
from sbrdf_jax.summary import compact_text

ROUND = tolerance(ROUNDING, np.float64)
THETA = np.radians(np.arange(0, 90.1, 15))
PHI = np.radians(np.arange(0, 360.1, 15))
WAVELENGTH_NM = np.linspace(400.0, 700.0, 9)
STEP = np.radians(15.0)
all_shapes = jax.jit(lobe_shapes)


def options(**target):
    return RepresentOptions(method="lobe_harmonics", target=TargetOptions(**(target or {"numbers": 150})))


def grid_of(brdf, *, theta_i=THETA, extrapolated=None, interpolate_theta_i=True) -> GriddedBRDF:
    lanes = np.zeros(len(WAVELENGTH_NM))
    flags = np.zeros(brdf.shape[:3], int) if extrapolated is None else extrapolated
    return GriddedBRDF(
        theta_i, THETA, PHI, WAVELENGTH_NM, brdf, flags, lanes, lanes, lanes, interpolate_theta_i=interpolate_theta_i
    )


def field_of(gridded, count=4):
    return encode_field(gridded, data_basis(WAVELENGTH_NM, np.asarray(gridded.brdf), count))


def values_of(found, theta_i=THETA):
    return np.stack([on_axes(found, t, THETA, PHI) for t in np.asarray(theta_i)])


def eta(found, gridded):
    """Eq. (18) for each incident angle."""
    axes, brdf = (1, 2, 3), np.asarray(gridded.brdf)
    return np.sqrt(((values_of(found, gridded.theta_i) - brdf) ** 2).sum(axes) / (brdf**2).sum(axes))


@pytest.fixture(scope="module")
def amber():
    """The true amber glass on a coarse grid, and its compact form."""
    mesh = np.meshgrid(THETA, THETA, PHI, indexing="ij")
    gridded = grid_of(np.asarray(builtin.true_brdf("amber_glass", *mesh, WAVELENGTH_NM)))
    field = field_of(gridded)
    return gridded, field, represent(field, options(), gridded)


def planted(kinds, degree=2) -> LobeHarmonics:
    """Harmonics and two lobes at every incident angle, positive everywhere, in two spectra."""
    n, vectors = len(THETA), np.linalg.qr(np.stack([np.ones(9), np.linspace(-1, 1, 9)]).T)[0].T
    orders = np.array(even_orders(degree))
    background = np.zeros((n, 2, len(orders)))
    background[:, :, 0] = np.array([-9.0, 0.5])
    background[1:, 0, 2], background[:, 0, 1] = 0.3, 0.2
    width = np.stack([np.linspace(0.3, 0.5, n), np.linspace(0.08, 0.06, n)], axis=1)
    off = np.linspace(0, 0.1, n)[:, None] * np.array([1.0, 0.3])
    height = np.stack([np.outer(np.linspace(2, 4, n), [-1, 0.3]), np.outer(np.linspace(5, 30, n), [-1, 0.1])], axis=1)
    basis = make_basis(WAVELENGTH_NM, "identity", 9)
    basis = type(basis)(WAVELENGTH_NM, vectors.T, vectors, "data")
    degrees, status = np.full((n, 2), degree), np.zeros(n, int)
    kind = np.tile([SHAPES.index(k) for k in kinds], (n, 1))
    return LobeHarmonics(
        THETA, THETA, basis, degrees, background, kind, width, THETA[:, None] + off, height, status, max_degree=degree
    )


def problem_of(rng, max_degree=3, channels=3):
    """A problem of random values at two incident angles, and its directions."""
    theta_o, phi_o = (a.ravel() for a in np.meshgrid(THETA, PHI[:13], indexing="ij"))
    theta_i = np.array([0.0, 0.7])
    lobe = np.exp(-((theta_o - theta_i[:, None]) ** 2 + (np.pi - phi_o) ** 2 * np.sin(theta_o) ** 2) / 0.2)
    value = lobe[..., None] * rng.uniform(1, 3, channels) + 0.05 * rng.normal(size=(2, theta_o.size, channels)) + 0.3
    weight = rng.uniform(0.5, 2.0, (2, theta_o.size))
    return make_problem(theta_i, theta_o, phi_o, weight, value, max_degree)


def plain_error(problem, i, lobes, degree):
    """Squared error by plain least squares in the harmonics themselves, ridge rows and lobes, channel by channel."""
    shape = np.concatenate([shapes_of(problem, np.array([i]), lobes)[0], np.zeros((len(problem.triangle[i]), 2))])
    rows = problem.functions[i] @ problem.triangle[i]
    value = np.concatenate([problem.value[i], np.zeros((len(problem.triangle[i]), problem.value.shape[2]))])
    left = []
    for channel, own in enumerate(value.T):
        matrix = np.concatenate([rows[:, problem.degree_of <= degree[channel]], shape], axis=1)
        left.append(own - matrix @ np.linalg.lstsq(matrix, own)[0])
    return np.concatenate(left)


def test_every_shape_is_one_in_the_mirror_direction_and_is_what_it_says():
    theta = jnp.asarray(np.radians([0.0, 20.0, 60.0, 85.0]))
    one = jnp.ones_like(theta)
    at_mirror = np.asarray(all_shapes(theta, theta, np.pi * one, theta, 0.1 * one))
    np.testing.assert_allclose(at_mirror[1:], 1.0, rtol=1e-9)
    assert (at_mirror[0] == 0).all()
    i, o, phi, w = 0.6, 0.9, 2.5, 0.07
    found = np.asarray(all_shapes(*(jnp.asarray([a]) for a in (i, o, phi, i, w))))[:, 0]
    half = np.array([np.sin(i) + np.sin(o) * np.cos(phi), np.sin(o) * np.sin(phi), np.cos(i) + np.cos(o)])
    cos_h = half[2] / np.linalg.norm(half)
    distribution = w / (np.pi * (cos_h**2 * (w - 1) + 1) ** 2) * np.pi * w

    def smith(a, b):
        return 0.5 / (b * np.sqrt(w + (1 - w) * a * a) + a * np.sqrt(w + (1 - w) * b * b))

    ggx = distribution * smith(np.cos(i), np.cos(o)) / smith(np.cos(i), np.cos(i))
    tangent = np.sqrt(1 / cos_h**2 - 1)
    np.testing.assert_allclose(found[SHAPES.index("microfacet")], ggx, rtol=1e-9)
    np.testing.assert_allclose(
        found[SHAPES.index("half_gaussian")], np.exp(-(tangent**2) / w) * np.cos(i) / np.cos(o), rtol=1e-9
    )
    np.testing.assert_allclose(
        found[SHAPES.index("half_exponential")], np.exp(-tangent / w) * np.cos(i) / np.cos(o), rtol=1e-9
    )


def test_shapes_know_no_azimuth_at_the_poles_and_are_finite_with_slopes_everywhere(rng):
    phi, zero, other = rng.uniform(0, 6, 5), np.zeros(5), np.full(5, 0.7)
    for theta_i, theta_o, peak in ((zero, other, zero), (other, zero, other)):
        found = np.asarray(all_shapes(*(jnp.asarray(a) for a in (theta_i, theta_o, phi, peak, 0.1 + zero))))
        assert np.abs(found - found[:, :1]).max() < ROUND
    corners = np.array(list(itertools.product([0.0, 0.7, np.pi / 2], [0.0, 0.7, np.pi / 2], [0.0, 1.0, np.pi])))
    slopes = jax.jit(jax.vmap(jax.jacfwd(lambda a: lobe_shapes(a[0], a[1], a[2], a[3], a[4]))))
    at = np.concatenate([corners, corners[:, :1] + 0.05, np.full((len(corners), 1), 1e-3)], axis=1)
    assert np.isfinite(np.asarray(slopes(at))).all()


def test_projection_is_plain_least_squares_and_its_slope_is_right(rng):
    problem = problem_of(rng)
    lobes = Lobes(np.array([[4, 6]]), np.array([[0.3, 0.05]]), np.array([[0.75, 0.68]]))
    degree, i = np.array([[3, 1, 0]]), np.array([1])
    shape = shapes_of(problem, i, lobes)[0]
    error = heights_and_errors(inner_products(problem, 1, shape))[1]
    expected = plain_error(problem, 1, lobes, degree[0])
    loose = 1e-6  # the projected step has a ridge
    assert abs(error[degree[0] + 1, np.arange(3)].sum() / (expected**2).sum() - 1) < 1e-9
    found, slope, _ = projected_step(problem, i, columns_of(problem, i, lobes), degree)
    assert abs(found[0] / (expected**2).sum() - 1) < loose
    for unknown in range(4):
        sides = []
        for sign in (1, -1):
            shift = sign * 1e-5 * np.eye(4)[unknown]
            moved = Lobes(lobes.kind, lobes.width * np.exp(shift[:2]), lobes.peak_theta_o + shift[2:])
            sides.append((plain_error(problem, 1, moved, degree[0]) ** 2).sum())
        numeric = -(sides[0] - sides[1]) / 2e-5 / 2
        assert abs(numeric - slope[0, unknown]) < 1e-4 * np.abs(slope).max()  # a difference of large sums


@pytest.mark.parametrize("kinds", [(4, 6), (1, 6), (5, 0)], ids=str)
@pytest.mark.parametrize("place", [0, 1], ids=["normal", "oblique"])
def test_scipy_finds_no_better_lobes_from_where_the_polish_ends(kinds, place, rng):
    problem, limits = problem_of(rng), width_limits(STEP)
    kind = np.array([kinds])
    start = Lobes(kind, np.array([[0.5, 0.1]]), np.full((1, 2), problem.theta_i[place]))
    degree, i = np.array([[2, 1, 2]]), np.array([place])
    found = polish_lobes(problem, i, start, degree, limits, num_steps=300)  # along a narrow valley
    before, after = ((plain_error(problem, place, lobes, degree[0]) ** 2).sum() for lobes in (start, found))
    assert after <= before
    is_free = np.array([k > 0 for k in kinds] + [k > 0 and place == 1 for k in kinds])

    def residual(unknown):
        whole = np.concatenate([np.log(found.width[0]), found.peak_theta_o[0]])
        whole[is_free] = unknown
        lobes = Lobes(kind, np.exp(whole[None, :2]), whole[None, 2:])
        return plain_error(problem, place, lobes, degree[0])

    at = np.concatenate([np.log(found.width[0]), found.peak_theta_o[0]])[is_free]
    edge = np.log(limits[kind[0]])
    lower = np.concatenate([edge[:, 0], start.peak_theta_o[0] - FURTHEST])[is_free] - 1e-9
    upper = np.concatenate([edge[:, 1], start.peak_theta_o[0] + FURTHEST])[is_free] + 1e-9
    other = least_squares(residual, np.clip(at, lower + 1e-10, upper - 1e-10), bounds=(lower, upper))
    assert after <= 2 * other.cost * (1 + 1e-4)


def test_hull_ladder_and_spending_against_trying_everything(rng):
    size, error = rng.integers(0, 50, 30), rng.uniform(size=30)
    hull = lower_hull(size, error)
    for a, b in zip(hull[:-1], hull[1:], strict=True):
        line = error[a] + (error[b] - error[a]) * (size - size[a]) / (size[b] - size[a])
        inside = (size >= size[a]) & (size <= size[b])
        assert (error[inside] >= line[inside] - 1e-12).all()

    cost = np.array([0, 2, 5])
    errors = np.sort(rng.uniform(size=(2, 3, 2)), axis=1)[:, ::-1] * np.array([1.0, 0.2])  # angles, degrees, channels
    ladders = [[make_ladder(own, cost, same_degree=False)] for own in errors]
    choices = [angle_choices(own, error[0].sum(), 2) for own, error in zip(ladders, errors, strict=True)]
    for own, angle in zip(choices, errors, strict=True):
        for choice in own:
            assert choice.numbers == cost[choice.degree + 1].sum()
            assert abs(choice.error - angle[choice.degree + 1, [0, 1]].sum()) < 1e-12
    for budget in (2, 7, 12, 20):
        taken = spend(choices, float(budget))
        chosen = [own[k] for own, k in zip(choices, taken, strict=True)]
        used = sum(choice.numbers for choice in chosen)
        assert used <= budget
        pairs = itertools.product(*choices)
        best = min(sum(np.sqrt(c.error) for c in pair) for pair in pairs if sum(c.numbers for c in pair) <= used)
        assert sum(np.sqrt(c.error) for c in chosen) <= best + 1e-12  # on the hull nothing so small is better
    same = angle_choices([make_ladder(errors[0], cost, same_degree=True)], errors[0, 0].sum(), 2)
    assert [choice.numbers for choice in same][0] == 0 and all(c.numbers in (0, 4, 10) for c in same)


@pytest.mark.parametrize("kinds", [("half_gaussian", "microfacet"), ("angle_squared", "microfacet")], ids=str)
def test_a_field_made_of_the_models_own_parts_comes_back(kinds):
    brdf = values_of(planted(kinds))
    assert brdf.min() > 0
    gridded = grid_of(brdf)
    found = represent(field_of(gridded, 2), options(numbers=1000), gridded)
    assert eta(found, gridded).max() < 3e-3  # between the nodes it is fitted to a guess, which counts a little
    assert "microfacet" in {SHAPES[k] for k in found.lobe_kind.ravel()}  # the broad ones are nearly alike


def test_few_numbers_are_all_counted_and_serve_amber_glass(amber):
    gridded, _, found = amber
    assert stored_numbers(found) / len(THETA) <= 150
    assert np.median(eta(found, gridded)) < 0.01
    assert "microfacet" in compact_text(found)


def test_never_negative_and_finite_with_gradients_everywhere(amber, rng):
    found = amber[2]
    edges = np.array([0.0, np.pi / 2])
    angles = [np.concatenate([rng.uniform(0, np.pi / 2, 3000), [0, 0, np.pi / 2, np.pi / 2]]) for _ in range(2)]
    angles[1][-4:] = np.tile(edges, 2)
    phi = np.concatenate([rng.uniform(-7, 7, 3000), np.tile([0.0, np.pi], 2)])
    value = evaluate_in_chunks(found, *angles, phi)
    assert np.isfinite(value).all() and (value >= 0).all()
    np.testing.assert_allclose(value, evaluate_in_chunks(found, *angles, -phi), rtol=1e-9, atol=1e-12)
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
    pole = evaluate_in_chunks(found, np.array([0.0, 0.0, 0.5, 0.5]), np.array([0.4, 0.4, 0.0, 0.0]), [0.3, 2, 0.3, 2])
    np.testing.assert_allclose(pole[::2], pole[1::2], rtol=1e-9)


def test_between_incident_angles_a_lobe_moves_and_stays_one(rng):
    theta_i, other, theta_o = jnp.asarray(0.5), jnp.asarray(0.6), jnp.asarray(0.8)
    moved = same_half_vector(theta_i, theta_o, jnp.asarray(2.2), other)

    def half(i, o, phi):
        vector = np.array([np.sin(i) + np.sin(o) * np.cos(phi), np.sin(o) * np.sin(phi), np.cos(i) + np.cos(o)])
        return vector / np.linalg.norm(vector)

    np.testing.assert_allclose(half(0.5, 0.8, 2.2), half(0.6, *moved), rtol=0, atol=ROUND)
    np.testing.assert_allclose(same_half_vector(theta_i, theta_o, jnp.asarray(2.2), theta_i), (0.8, 2.2), atol=ROUND)
    below, above = rng.uniform(0, 1, (2, 9))
    blend = geometric_mean(jnp.asarray(below), jnp.asarray(above), jnp.asarray(0.3))
    np.testing.assert_allclose(blend, below**0.7 * above**0.3, rtol=0.05)
    assert (geometric_mean(jnp.zeros(9), jnp.zeros(9), jnp.asarray(0.3)) == 0).all()


def test_the_group_alone_evaluates_to_the_same_numbers(amber, tmp_path, rng):
    gridded, field, found = amber
    store.save(tmp_path / "r.h5", store.RunResult(gridded=gridded, field=field, compact=found))
    again = store.load(tmp_path / "r.h5")
    with h5py.File(tmp_path / "r.h5") as whole, h5py.File(tmp_path / "part.h5", "w") as part:
        part.attrs["schema_name"], part.attrs["schema_version"] = "sbrdf-result", 1
        whole.copy("compact", part)
        sizes: list[int] = []
        part["compact"].visititems(lambda _, item: sizes.append(item.size))
        assert part["compact"].attrs["method"] == "lobe_harmonics"
        assert sum(sizes) == part["compact"].attrs["stored_numbers"] == stored_numbers(found)
    angles, wavelength = rng.uniform(0, 1.5, (3, 50)), np.array([400.0, 512.3])
    alone = store.load_stage(tmp_path / "part.h5", "compact", wavelength)
    expected = evaluate_in_chunks(found, *angles, wavelength)
    for loaded in (alone, again.compact):
        np.testing.assert_allclose(evaluate_in_chunks(loaded, *angles, wavelength), expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("target", [{"error": 0.02}, {"delta_e": 2.0}, {"ratio": 40.0}, {"numbers": 60}], ids=str)
def test_targets_are_met_and_the_plan_says_so(amber, target):
    gridded, field, _ = amber
    known = grid_of(gridded.brdf, extrapolated=np.repeat([0] * 6 + [2], 7 * 25).reshape(7, 7, 25))
    found, plan = represent_with_plan(field, options(**target), known)
    assert plan["is_met"] and not plan["warnings"] and plan["promised"] and plan["lobe_kinds"]
    if "error" in target:
        assert eta(found, gridded)[:-1].max() <= 0.02
    elif "ratio" in target:
        assert compression(found)["compression_ratio"] >= 40
    elif "numbers" in target:
        assert stored_numbers(found) <= 60 * len(THETA)
    assert found.status[-1] == Status.SKIPPED and len(found.fitted_theta_i) == 6
    assert np.isin(found.status[:-1], [Status.OK, Status.CLAMPED]).all()


@pytest.mark.parametrize("target", [{"error": 1e-9}, {"numbers": 5}], ids=str)
def test_what_cannot_be_met_is_the_best_and_a_warning(amber, target):
    gridded, field, _ = amber
    found, plan = represent_with_plan(field, options(**target), gridded)
    assert not plan["is_met"] and "is not met" in plan["warnings"][0]
    assert np.isfinite(eta(found, gridded)).all()


def test_other_spectral_bases(amber):
    gridded, _, _ = amber
    kind = "cosine"
    field = encode_field(gridded, make_basis(WAVELENGTH_NM, kind, 7))
    found = represent(field, options(numbers=300), gridded)
    assert found.basis.kind == kind and (found.degree == found.degree[:, :1]).all()
    assert np.median(eta(found, gridded)) < 0.03
    assert stored_numbers(found) <= 300 * len(THETA)


def test_zero_nonfinite_and_lopsided_fields(amber):
    gridded, _, _ = amber
    dark = grid_of(np.zeros_like(gridded.brdf))
    found = represent(encode_field(dark, make_basis(WAVELENGTH_NM, "identity", 9)), options(), dark)
    assert (evaluate_in_chunks(found, np.array(0.3), THETA, np.array(1.0)) == 0).all()

    brdf = np.array(gridded.brdf)
    brdf[2, 3, 4] = np.nan
    found = represent(field_of(gridded), options(), grid_of(brdf))
    assert found.status[2] == Status.NONFINITE and np.isin(np.delete(found.status, 2), [0, 4]).all()
    assert np.delete(eta(found, gridded), 2).max() < 0.05 and np.isfinite(values_of(found)).all()

    brdf[1:] = np.nan
    found = represent(field_of(gridded), options(), grid_of(brdf))  # one incident angle is left
    assert eta(found, gridded)[0] < 0.02 and np.isfinite(evaluate_in_chunks(found, THETA, THETA, THETA)).all()

    lopsided = grid_of(gridded.brdf * (1 + 0.3 * np.sin(PHI)[:, None]))
    _, plan = represent_with_plan(field_of(lopsided), options(), lopsided)
    assert "not symmetric" in plan["warnings"][0]


def test_units_do_not_matter(amber):
    gridded, _, found = amber
    power = 1e-6
    scaled = grid_of(gridded.brdf * power)
    again = represent(field_of(scaled), options(), scaled)
    expected = power * values_of(found)
    loose = 1e-4  # steps of the polish are taken or not by differences at the level of rounding
    np.testing.assert_allclose(values_of(again), expected, rtol=0, atol=loose * expected.max())


def test_fewer_than_three_incident_angles_are_not_interpolated(amber):
    gridded = amber[0]
    part = grid_of(gridded.brdf[1:3], theta_i=THETA[1:3], interpolate_theta_i=False)
    found = represent(field_of(part), options(), part)
    assert eta(found, part).max() < 0.05
    beside = evaluate_in_chunks(found, THETA[1:3] + np.array([0.1, -0.1]), np.zeros(2), np.zeros(2))
    assert np.isfinite(beside).all() and (beside >= 0).all()
