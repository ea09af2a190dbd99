"""Storage of a compact form: rounding against plain NumPy, round trips without loss, errors, promises, units."""

import dataclasses

import h5py
import numpy as np
import pytest
from small_results import small_compact, small_field, small_grid
from tolerances import ROUNDING, tolerance

from sbrdf_jax import builtin, store
from sbrdf_jax.batch.memory import check_result
from sbrdf_jax.colour import colour_matching
from sbrdf_jax.compact_layout import stored_bytes
from sbrdf_jax.encoding import data_basis, encode_field, vector_basis
from sbrdf_jax.evaluation import evaluate_in_chunks
from sbrdf_jax.metrics import error_at_nodes, off_node_scores, stored_numbers
from sbrdf_jax.options import RepresentOptions, TargetOptions
from sbrdf_jax.records import GriddedBRDF, LobeHarmonics
from sbrdf_jax.representation import represent, represent_with_plan, storage_choice
from sbrdf_jax.representation.lobe_harmonics import stored_harmonics
from sbrdf_jax.representation.lobe_harmonics_value import even_orders
from sbrdf_jax.representation.storage import VALUES, first_axis, narrowest, read_back, round_form, written
from sbrdf_jax.representation.storage_choice import LEAST_SHARE, MOST_BITS, ROUNDING_SHARE
from sbrdf_jax.representation.target import Target

ROUND = tolerance(ROUNDING, np.float64)
NARROW = ("float32", "float16", "quantised")
METHODS = ("paper", "lobe_harmonics", "lobe_tensor")
THETA, PHI = np.radians(np.arange(0, 90.1, 15)), np.radians(np.arange(0, 360.1, 30))
MESH = np.meshgrid(THETA, THETA, PHI, indexing="ij")
WAVELENGTH_NM = np.linspace(400.0, 700.0, 9)
HALF_STEP = {"float32": 2.0**-24, "float16": 2.0**-11}  # of a value, relative, at most
LARGEST = {"float32": 1e-5, "float16": 0.05}  # of the error that rounding may add to these forms


def field_of(gridded: GriddedBRDF):
    return encode_field(gridded, data_basis(WAVELENGTH_NM, np.asarray(gridded.brdf), 4))


def options(storage: str = "float64", **target) -> RepresentOptions:
    return RepresentOptions("lobe_tensor", TargetOptions(**(target or {"numbers": 100})), storage=storage)


def grid_of(brdf) -> GriddedBRDF:
    lanes = np.zeros(len(WAVELENGTH_NM))
    return GriddedBRDF(THETA, THETA, PHI, WAVELENGTH_NM, brdf, np.zeros(brdf.shape[:3], int), lanes, lanes, lanes)


def small_harmonics(rng) -> LobeHarmonics:
    """Harmonics and lobes, some of them absent, in three spectra of decreasing weight."""
    n, size, weight = len(THETA), len(even_orders(3)), np.array([1.0, 0.1, 0.01])
    degree = np.tile([3, 2, 0], (n, 1))
    degree[2, 2] = -1
    kind = np.tile([1, 4], (n, 1))
    kind[3, 1] = 0
    form = LobeHarmonics(
        THETA,
        THETA,
        vector_basis(WAVELENGTH_NM, np.linalg.qr(rng.normal(size=(9, 3)))[0].T),
        degree,
        0.3 * rng.normal(size=(n, 3, size)) * weight[:, None],
        kind,
        rng.uniform(0.02, 0.3, (n, 2)),
        THETA[:, None] + rng.uniform(0, 0.05, (n, 2)),
        rng.uniform(1, 9, (n, 2, 3)) * weight,
        np.zeros(n, int),
        max_degree=3,
    )
    has_harmonic, has_height = stored_harmonics(form)
    background, height = np.where(has_harmonic, form.background, 0), np.where(has_height, form.lobe_height, 0)
    background[:, 0, 0] -= 9  # the leading spectrum has either sign: light somewhere, clipped elsewhere
    return dataclasses.replace(form, background=background, lobe_height=height)


@pytest.fixture(scope="module")
def forms():
    """A compact form of each method, unrounded, and a grid from which it is a few percent off."""
    rng = np.random.default_rng(11)
    truth = np.asarray(builtin.true_brdf("amber_glass", *MESH, WAVELENGTH_NM))
    tensor = represent(field_of(grid_of(truth)), options(), grid_of(truth))
    paper = small_compact(rng, theta_i=THETA, wavelength_nm=WAVELENGTH_NM, coefficients=7)
    found = {"lobe_tensor": (tensor, grid_of(truth))}
    for method, form in (("paper", paper), ("lobe_harmonics", small_harmonics(rng))):
        wave = 1 + 0.03 * np.cos(np.arange(9) + MESH[1][..., None])
        found[method] = form, grid_of(evaluate_in_chunks(form, *MESH) * wave)
    return found


def eta(found, gridded, wanted=None):
    """Eq. (18) for each incident angle, against the grid or another form."""
    reference = np.asarray(gridded.brdf) if wanted is None else evaluate_in_chunks(wanted, *MESH)
    rest = evaluate_in_chunks(found, *MESH) - reference
    return np.sqrt((rest**2).sum((1, 2, 3)) / (reference**2).sum((1, 2, 3)))


def allowed(own):
    """What rounding may add at each incident angle."""
    return np.maximum(ROUNDING_SHARE * own, LEAST_SHARE * own.max())


def test_quantising_is_that_of_a_plain_loop(rng):
    compact = small_compact(rng)
    found = round_form(compact, "quantised", 9)
    for name in VALUES[type(compact)]:
        for row, given in zip(getattr(found, name), getattr(compact, name), strict=True):
            largest = np.abs(given).max()
            step = 1.0
            while step <= largest:
                step *= 2
            while step / 2 > largest:
                step /= 2
            step /= 2**9
            expected = [step * round(value / step) for value in given.ravel()]  # halves to even
            np.testing.assert_array_equal(row.ravel(), expected)
            assert np.abs(row - given).max() <= step / 2


@pytest.mark.parametrize("scale", [1e-300, 1e-12, 1.0, 1e12, 1e300])
def test_float16_keeps_its_digits_in_any_unit(rng, scale):
    compact = small_compact(rng)
    height = scale * 10.0 ** rng.uniform(-6, 0, compact.lobe_height.shape)
    height[1], height[2, 0] = 0.0, np.nan
    found = round_form(dataclasses.replace(compact, lobe_height=height), "float16").lobe_height
    error = np.abs(found - height)[height > 0] / height[height > 0]
    assert error.max() <= HALF_STEP["float16"] and (found[1] == 0).all() and np.isnan(found[2, 0])


@pytest.mark.parametrize("storage", NARROW)
@pytest.mark.parametrize("largest", [1, 126, 128, 32639, 32641, 2**40])
def test_what_is_rounded_is_written_without_loss(rng, storage, largest):
    number = rng.integers(-largest, largest, (6, 3, 4), endpoint=True)
    number[0, 0, 0], number[3] = largest, 0
    value = np.ldexp(number.astype(float), rng.integers(-60, 60, (6, 1, 1)))
    if storage == "float32":
        value = value.astype(np.float32).astype(float)
    if storage == "float16":
        value = np.ldexp(np.ldexp(number.astype(float), -26).astype(np.float16).astype(float), 40)
    rows = first_axis(value.shape)
    found = written(value, storage, rows)
    assert found.number.dtype.itemsize < 8 or largest == 2**40
    np.testing.assert_array_equal(read_back(found, rows), value)
    some = rng.random(value.shape) < 0.5  # one after another, as ragged values are written
    np.testing.assert_array_equal(read_back(written(value[some], storage, rows[some]), rows[some]), value[some])


def test_the_narrowest_type_is_exact():
    for value, kind in (
        ([0.0, 7.5, 90.0], "f2"),
        ([380.0, 383.7], "f8"),
        ([2049.0, np.nan], "f4"),
        ([1e300], "f8"),
        ([0, 127], "i1"),
        ([-200], "i2"),
        ([2**20], "i4"),
        ([2**40], "i8"),
    ):
        found = narrowest(np.array(value))
        assert found.dtype == np.dtype(kind)
        np.testing.assert_array_equal(found.astype(np.array(value).dtype), value)


@pytest.mark.parametrize("storage", ["float64", *NARROW])
@pytest.mark.parametrize("method", METHODS)
def test_what_is_read_back_is_what_was_measured(tmp_path, rng, forms, method, storage):
    unrounded, gridded = forms[method]
    compact = round_form(unrounded, storage, 9)
    path = tmp_path / "r.h5"
    store.save(path, store.RunResult(gridded=gridded, compact=compact))
    found = store.load(path).compact
    assert type(found) is type(compact) and found.storage == storage
    for field in dataclasses.fields(compact):
        value, again = getattr(compact, field.name), getattr(found, field.name)
        if field.name in VALUES[type(compact)]:
            np.testing.assert_array_equal(again, value)
            assert again.dtype == np.float64
        elif field.name == "basis":
            np.testing.assert_array_equal(again.synthesis, value.synthesis)
        elif isinstance(value, np.ndarray):
            np.testing.assert_allclose(again, value, rtol=1e-15, atol=1e-15)  # angles by way of degrees
            assert again.dtype.itemsize == 8
        else:
            assert again == value
    directions = rng.uniform(0, 1.5, (3, 40))
    for loaded in (found, store.load_stage(path, "compact", [412.0])):
        expected = evaluate_in_chunks(compact, *directions)
        np.testing.assert_allclose(evaluate_in_chunks(loaded, *directions), expected, rtol=1e-9, atol=1e-12)
    with h5py.File(path) as file:
        group = file["compact"]
        assert group.attrs["storage"] == storage
        assert sum(item.size for item in group.values()) == group.attrs["stored_numbers"] == stored_numbers(compact)
        values = [item.dtype for name, item in group.items() if name in VALUES[type(compact)]]
        assert all(kind.kind == "i" if storage == "quantised" else kind == np.dtype(storage) for kind in values)
        payload = sum(item.id.get_storage_size() for item in group.values())
    assert payload <= stored_bytes(compact) <= 1.2 * payload + 40
    bytes_a_number = stored_bytes(compact) / stored_numbers(compact)
    assert bytes_a_number < {"float64": 8.5, "float32": 4.8, "float16": 3.2, "quantised": 3.2}[storage]


def test_a_result_that_does_not_say_its_storage_is_float64(tmp_path, forms):
    path, (compact, gridded) = tmp_path / "old.h5", forms["lobe_tensor"]
    store.save(path, store.RunResult(gridded=gridded, compact=compact))
    with h5py.File(path, "a") as file:
        del file["compact"].attrs["storage"]
    assert store.load(path).compact.storage == "float64"


@pytest.mark.parametrize("storage", NARROW)
@pytest.mark.parametrize("method", METHODS)
def test_what_rounding_adds_is_measured_and_small(forms, method, storage):
    form, gridded = forms[method]
    found = storage_choice.store(form, storage, field_of(gridded), gridded, (), None)
    assert found.compact.storage == storage and not found.warnings
    own = eta(form, gridded)
    np.testing.assert_allclose(found.error, eta(found.compact, gridded, form), rtol=1e-9, atol=1e-14)
    assert (found.error > 0).all()
    limit = allowed(own) if storage == "quantised" else LARGEST[storage]
    assert (found.error <= limit).all()
    assert (eta(found.compact, gridded) <= own + found.error + ROUND).all()
    assert stored_bytes(found.compact) < 0.65 * stored_bytes(form)
    if method != "paper":
        assert off_node_scores(found.compact)[0] == 0


@pytest.mark.parametrize("method", METHODS)
def test_fewer_bits_would_add_too_much(forms, method):
    form, gridded = forms[method]
    found = storage_choice.store(form, "quantised", field_of(gridded), gridded, (), None).compact
    own = eta(form, gridded)
    trials = [round_form(form, "quantised", bits) for bits in range(1, MOST_BITS + 1)]
    is_small = [(eta(trial, gridded, form) <= allowed(own)).all() for trial in trials]
    fewest = is_small.index(True)
    name = VALUES[type(form)][0]
    same = [np.array_equal(getattr(found, name), getattr(trial, name)) for trial in trials]
    assert same.index(True) - fewest in (0, 1)  # it starts to look two bits below what one trial foretells


@pytest.mark.parametrize("unit", [1e-12, 1e12])
@pytest.mark.parametrize("storage", NARROW)
@pytest.mark.parametrize("method", METHODS)
def test_units_do_not_matter(forms, method, storage, unit):
    form, gridded = forms[method]
    scaled = {"background": unit, "lobe_height": unit}
    parts = {name: factor * getattr(form, name) for name, factor in scaled.items() if method != "lobe_tensor"}
    if method == "lobe_tensor":
        parts = {"log_scale": form.log_scale - np.log(unit)}
    scaled = dataclasses.replace(form, **parts)
    expected = eta(round_form(form, storage, 12), gridded, form)
    found = eta(round_form(scaled, storage, 12), gridded, scaled)
    factor = 3 if storage != "float32" else 30  # powers of two lie elsewhere; a logarithm of 30 has fewer decimals
    assert (found <= factor * expected.max()).all()


@pytest.mark.parametrize("storage", NARROW)
def test_a_promise_is_kept_or_the_storage_is_wider(forms, storage):
    form, gridded = forms["lobe_tensor"]
    field, own = field_of(gridded), float(eta(form, gridded).max())
    just = (Target("error", own * (1 + 1e-9), np.inf),)
    found = storage_choice.store(form, storage, field, gridded, just, None)
    assert eta(found.compact, gridded).max() <= just[0].value * (1 + ROUND)
    assert found.achieved["error"] == pytest.approx(eta(found.compact, gridded).max(), rel=1e-9)
    is_wider = found.compact.storage != storage
    assert is_wider == bool(found.warnings) and all(f"not as {storage}" in text for text in found.warnings)
    broken = (Target("error", own / 2, np.inf),)  # not kept before rounding either
    assert storage_choice.store(form, storage, field, gridded, broken, None).compact.storage == storage


def test_promises_that_rounding_breaks_are_stored_wider(forms):
    form, _ = forms["lobe_tensor"]
    exact = grid_of(evaluate_in_chunks(form, *MESH))  # the form has no error at all
    field = field_of(exact)
    for limit, expected in ((None, "float32"), (1e-5, "float32"), (1e-9, "float64")):
        promises = () if limit is None else (Target("error", limit, np.inf),)
        found = storage_choice.store(form, "quantised", field, exact, promises, None)
        assert found.compact.storage == expected and f"stored as {expected}, not as quantised" in found.warnings[0]
        assert limit is None or eta(found.compact, exact).max() <= limit
    found = storage_choice.store(form, "float16", field, exact, (Target("error", 1e-5, np.inf),), None)
    assert found.compact.storage == "float32"


def test_rounding_that_would_be_the_worst_error_is_stored_wider(forms):
    form, gridded = forms["lobe_harmonics"]  # with two lobes of opposite signs that all but cancel
    kind, width, peak = (
        np.repeat(array[:, :1], 2, axis=1) for array in (form.lobe_kind, form.lobe_width, THETA[:, None])
    )
    height = np.stack([form.lobe_height[:, 0] + 1e5, np.full_like(form.lobe_height[:, 0], -1e5)], axis=1)
    form = dataclasses.replace(form, lobe_kind=kind, lobe_width=width, lobe_peak_theta_o=peak, lobe_height=height)
    gridded = grid_of(evaluate_in_chunks(form, *MESH))
    assert eta(round_form(form, "float16"), gridded).max() > 10 * storage_choice.TOLERATED
    found = storage_choice.store(form, "float16", field_of(gridded), gridded, (), None)
    assert found.compact.storage == "float32" and "add more than the error is" in found.warnings[0]
    assert eta(found.compact, gridded).max() < storage_choice.TOLERATED


@pytest.mark.parametrize("target", [{"error": 0.03}, {"delta_e": 2.0}], ids=str)
@pytest.mark.parametrize("storage", ["float16", "quantised"])
def test_targets_are_met_as_stored(forms, target, storage):
    gridded = forms["lobe_tensor"][1]
    form, plan = represent_with_plan(field_of(gridded), options(storage, **target), gridded)
    assert plan["is_met"] and form.storage == plan["storage"] and np.isfinite(plan["storage_error"]).all()
    if "error" in target:
        worst = eta(form, gridded).max()
        assert worst <= 0.03 and plan["measured"] == f"{100 * worst:.3g} % at the worst"
    else:
        worst = error_at_nodes(form, gridded, colour_matching(WAVELENGTH_NM))["delta_e_median"].max()
        assert worst <= 2.0 and plan["measured"] == f"{worst:.3g} at the worst"


def test_without_a_grid_the_field_itself_is_compared(forms):
    gridded = forms["lobe_tensor"][1]
    compact, plan = represent_with_plan(field_of(gridded), options("quantised"))
    assert compact.storage == plan["storage"] == "quantised" and 0 < plan["storage_error"].max() < 0.05


def test_a_value_that_is_not_finite_is_not_quantised(rng):
    grid = small_grid(rng, wavelength_nm=np.linspace(380.0, 780.0, 11))
    compact = small_compact(rng)
    compact.background[2, 1] = np.nan
    found = storage_choice.store(compact, "quantised", small_field(grid), grid, (), None)
    assert found.compact.storage == "float32" and np.isnan(found.compact.background[2, 1]).all()
    assert np.isnan(found.error[2]) and np.isfinite(found.error[[0, 3, 4]]).all()


def test_numbers_with_units_of_their_own_are_not_stacked(tmp_path, forms):
    path, (form, gridded) = tmp_path / "r.h5", forms["lobe_tensor"]
    compact = round_form(form, "quantised", 9)
    store.save(path, store.RunResult(gridded=gridded, compact=compact, config="input: {path: builtin:amber_glass}\n"))
    layout = check_result(path).layout
    assert '"compact/status"' in layout and '"compact/core"' not in layout and '"grid/brdf"' in layout
