"""What must hold for any measurement: few examples by default, many where slow tests run."""

import dataclasses
import functools

import hypothesis
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest
from small_results import small_compact, small_grid
from tolerances import ROUNDING, tolerance

from sbrdf_jax import formats, store
from sbrdf_jax.encoding import encode_field, make_basis
from sbrdf_jax.evaluation import evaluate_in_chunks
from sbrdf_jax.grid import make_grid, second_difference_rows
from sbrdf_jax.options import InputOptions, ResampleOptions
from sbrdf_jax.records import GriddedBRDF, RawSamples, Status
from sbrdf_jax.resampling import resample
from sbrdf_jax.resampling.kept import Kept
from sbrdf_jax.sinc import Window
from tests.stress.hostile import GRID, NUM_DIRECTIONS, WAVELENGTH_NM, measured, with_values

SOLVED = 1e-5  # relative change of an answer: the solver's tolerance 1e-8 times the condition number, about 1e3
ROUNDED = 1e-9  # the same where the solver takes the same steps
FEW_AND_MANY = [5, pytest.param(200, marks=pytest.mark.slow)]


def check(prove, examples: int, **strategies) -> None:
    """Let hypothesis look for an example that breaks a property; always the same examples."""
    limits = hypothesis.settings(max_examples=examples, deadline=None, derandomize=True, database=None)
    limits(hypothesis.given(**strategies)(prove))()


KEPT = Kept()
WELL_CONDITIONED = 30.0  # smoothness weights up to it: its square is the condition number that it adds


def fit(samples: RawSamples, *, weight: float = 1.0, window: Window = "factor") -> GriddedBRDF:
    """The field of method paper on the whole circle: samples of both half-planes."""
    options = ResampleOptions("paper", weight, window, tolerance=1e-8)
    found = resample(samples, make_grid(samples, GRID, bilateral=False), options, kept=KEPT)
    assert (np.asarray(found.status) == Status.OK).all()
    return found


@functools.cache
def usual() -> RawSamples:
    return measured(np.random.default_rng(20240612))


@functools.cache
def answer(window: Window = "factor") -> GriddedBRDF:
    return fit(usual(), window=window)


def equal(found, expected, loss: float) -> None:
    """Assert that two fields are equal within a loss, relative to the largest value of each wavelength."""
    found, expected = np.asarray(found), np.asarray(expected)
    size = np.abs(expected).max(axis=tuple(range(expected.ndim - 1)))
    assert (np.abs(found - expected) <= loss * size).all(), np.max(np.abs(found - expected) / size)


@pytest.mark.parametrize("examples", FEW_AND_MANY)
def test_scaling_the_input_scales_the_output(examples):
    basis = make_basis(WAVELENGTH_NM, "identity", 3)

    def prove(exponent):
        factor = 10.0**exponent
        found = fit(with_values(usual(), usual().value * factor))
        equal(found.brdf, np.asarray(answer().brdf) * factor, ROUNDED)
        coefficient = encode_field(found, basis).coefficient
        equal(coefficient, np.asarray(encode_field(answer(), basis).coefficient) * factor, ROUNDED)

    check(prove, examples, exponent=st.floats(-12, 12))


@pytest.mark.parametrize("examples", FEW_AND_MANY)
def test_the_order_of_samples_does_not_matter(examples):
    def prove(seed):
        order = np.random.default_rng(seed).permutation(usual().num_samples)
        equal(fit(usual().take(order)).brdf, answer().brdf, SOLVED)

    check(prove, examples, seed=st.integers(0, 2**32 - 1))


@pytest.mark.parametrize("examples", FEW_AND_MANY)
def test_a_consistent_sample_does_not_move_the_answer(examples):
    """A sample that says what the field says already: its row of eq. (6) is met, so the minimum stays where it is."""

    def prove(theta_i_deg, theta_o_deg, phi_o_deg):
        direction = np.deg2rad([[theta_i_deg], [theta_o_deg], [phi_o_deg]])
        value = evaluate_in_chunks(answer("none"), *direction)
        angles = [np.append(a, new) for a, new in zip(_angles(usual()), direction, strict=True)]
        more = dataclasses.replace(
            with_values(usual(), np.concatenate([usual().value, value])), row=np.arange(len(angles[0])),
            theta_i=angles[0], theta_o=angles[1], phi_o=angles[2],
        )  # fmt: skip
        equal(fit(more).brdf, answer().brdf, SOLVED)

    polar = st.floats(0, 90)
    check(prove, examples, theta_i_deg=polar, theta_o_deg=polar, phi_o_deg=st.floats(0, 359.9))


@pytest.mark.parametrize("examples", FEW_AND_MANY)
def test_turning_the_azimuth_turns_the_field(examples):
    num_phi = round(360 / GRID.phi_o_step_deg)

    def prove(steps, mirrored):
        sign = -1 if mirrored else 1
        turned = (sign * usual().phi_o + np.deg2rad(steps * GRID.phi_o_step_deg)) % (2 * np.pi)
        found = np.asarray(fit(dataclasses.replace(usual(), phi_o=turned)).brdf)[:, :, :-1]
        source = (sign * (np.arange(num_phi) - steps)) % num_phi
        equal(found, np.asarray(answer().brdf)[:, :, source], SOLVED)

    check(prove, examples, steps=st.integers(0, num_phi - 1), mirrored=st.booleans())


@pytest.mark.parametrize("examples", FEW_AND_MANY)
def test_a_lane_does_not_notice_its_neighbours(examples):
    def prove(place, left, right):
        value = np.stack([usual().value[:, 0] * left, usual().value[:, 1] * right, usual().value[:, 2]], axis=1)
        value = np.roll(value, place, axis=1)
        grid = make_grid(usual(), GRID, bilateral=False)
        found = resample(with_values(usual(), value), grid, ResampleOptions("paper", 1.0, "factor", 1e-8))
        lane = (2 + place) % 3
        assert np.asarray(found.status)[lane] == Status.OK
        equal(np.asarray(found.brdf)[..., lane, None], np.asarray(answer().brdf)[..., 2:], SOLVED)

    factor = st.floats(-1e8, 1e8) | st.sampled_from([0.0, np.nan, np.inf])
    check(prove, examples, place=st.integers(0, 2), left=factor, right=factor)


@pytest.mark.parametrize("examples", FEW_AND_MANY)
def test_more_smoothing_is_smoother(examples):
    grid = make_grid(usual(), GRID, bilateral=False)
    rows, index = second_difference_rows(grid), grid.unknown_index.reshape(-1)

    def roughness(weight):
        found = resample(usual(), grid, ResampleOptions("paper", weight, "factor", 1e-8), kept=KEPT)
        unknown = np.zeros((grid.num_unknowns, len(found.status)))
        unknown[index] = np.asarray(found.brdf)[:, :, :-1].reshape(len(index), -1)
        solved = np.asarray(found.status) == Status.OK
        assert solved.all() or weight > WELL_CONDITIONED  # beyond, a lane may say that it ran out of steps
        return ((rows @ unknown) ** 2).sum(axis=0), solved

    def prove(weight, ratio):
        (more, one), (less, other) = roughness(weight * ratio), roughness(weight)
        assert (more <= less * (1 + SOLVED))[one & other].all()

    check(prove, examples, weight=st.floats(1e-2, 10), ratio=st.floats(1.01, 1e3))


FLOATS = st.floats(allow_nan=True, allow_infinity=True, width=64)


@pytest.mark.parametrize("examples", [20, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_result_reads_back_as_it_was_written(examples, tmp_path):
    path = tmp_path / "result.h5"

    def prove(seed, odd, window, interpolate, warnings):
        rng = np.random.default_rng(seed)
        gridded = small_grid(rng, window=window, interpolate_theta_i=interpolate)
        gridded.brdf.reshape(-1)[rng.integers(0, gridded.brdf.size, len(odd))] = odd
        compact = small_compact(rng, theta_i=gridded.theta_i, interpolate_theta_i=interpolate)
        result = store.RunResult(gridded=gridded, compact=compact, warnings=tuple(warnings), config=" ".join(warnings))
        store.save(path, result)
        found = store.load(path)
        assert (found.warnings, found.config) == (result.warnings, result.config)
        for stage in ("gridded", "compact"):
            for field in dataclasses.fields(getattr(result, stage)):
                same(getattr(getattr(found, stage), field.name), getattr(getattr(result, stage), field.name))

    text = st.lists(st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0")), max_size=3)
    window = st.sampled_from(("none", "product", "factor"))
    check(
        prove, examples, seed=st.integers(0, 2**32 - 1), odd=st.lists(FLOATS, max_size=9), window=window,
        interpolate=st.booleans(), warnings=text,
    )  # fmt: skip


@pytest.mark.parametrize("ending", ["csv", "h5"])
@pytest.mark.parametrize("examples", [20, pytest.param(1000, marks=pytest.mark.slow)])
def test_samples_read_back_as_they_were_written(examples, ending, tmp_path):
    path = tmp_path / f"samples.{ending}"

    def prove(seed, odd):
        rng = np.random.default_rng(seed)
        value = rng.lognormal(size=(NUM_DIRECTIONS, 3))
        value.reshape(-1)[rng.integers(1, value.size, len(odd))] = odd  # the first stays positive
        written = with_values(usual().take(np.arange(NUM_DIRECTIONS)), value)
        formats.write_samples(path, written)
        found = formats.read(path, InputOptions(path="unused"))
        np.testing.assert_array_equal(found.value, value)
        for name in ("theta_i", "theta_o", "phi_o", "wavelength_nm"):
            same(getattr(found, name), getattr(written, name))

    check(prove, examples, seed=st.integers(0, 2**32 - 1), odd=st.lists(FLOATS, max_size=9))


def same(found, expected) -> None:
    """Assert that two fields of records are equal; angles are stored in degrees, which rounds them."""
    if dataclasses.is_dataclass(expected):
        for field in dataclasses.fields(expected):
            same(getattr(found, field.name), getattr(expected, field.name))
    elif isinstance(expected, np.ndarray | jnp.ndarray | float):
        np.testing.assert_allclose(found, expected, rtol=tolerance(ROUNDING, float), atol=1e-14)
    else:
        assert found == expected


def _angles(samples: RawSamples):
    return samples.theta_i, samples.theta_o, samples.phi_o
