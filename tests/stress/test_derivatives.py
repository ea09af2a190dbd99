"""Derivatives of what may be differentiated, against central differences; at the poles and the mirror direction too."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_results import UNIFORM_NM, WAVELENGTH_NM, small_compact, small_field, small_grid
from tolerances import GRADIENT, ROUNDING, tolerance

from sbrdf_jax.encoding import decode, encode, make_basis
from sbrdf_jax.evaluation import evaluate
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.resampling.guided import fit_field
from tests.stress.hostile import measured

STEP = 1e-5
CLOSE = 100 * tolerance(GRADIENT, float)  # sums over wavelengths and large terms that cancel
DIRECTIONS = {
    "inside": (0.61, 0.83, 2.1),
    "outgoing pole": (0.61, 0.0, 2.1),
    "incident pole": (0.0, 0.83, 2.1),
    "both poles": (0.0, 0.0, 0.3),
    "mirror": (0.61, 0.61, np.pi),
    "mirror at grazing": (1.5, 1.5, np.pi),
    "backwards": (0.61, 0.61, 0.0),
    "horizon": (0.61, np.pi / 2, 1.0),
}
AT = np.array(list(DIRECTIONS.values()))
SMOOTH = {  # where a stage has a derivative: [direction, angle]
    "grid": np.ones(AT.shape, bool),
    "field": np.ones(AT.shape, bool),
    "compact": np.stack([AT[:, 0] > 0, *np.ones((2, len(AT)), bool)], axis=1),  # clamped below its first incident angle
    "guided": np.stack(
        [AT[:, 0] > 0, (AT[:, 1] > 0) & (AT[:, 1] < 1.4), AT[:, 2] % np.pi > 0], axis=1
    ),  # clamped; even
}


def stage_of(name, rng):
    """A small result of one stage."""
    if name == "guided":
        return fit_field(measured(rng), ResampleOptions("guided", "data", "factor", 1e-6)).field
    if name == "compact":  # without the kind "tan", which has a corner at its peak
        compact = small_compact(rng)
        return dataclasses.replace(compact, lobe_kind=np.minimum(compact.lobe_kind, 2))
    gridded = small_grid(rng)
    return gridded if name == "grid" else small_field(gridded)


def by_both_modes(function):
    """Derivatives [point, argument] of a scalar function by reverse and by forward mode."""

    def at_point(at):
        return jax.grad(function)(at), jax.vmap(lambda way: jax.jvp(function, (at,), (way,))[1])(jnp.eye(at.size))

    return jax.jit(jax.vmap(at_point))


def by_differences(function, at, step=STEP):
    """Central differences [point, argument]."""
    ways = step * np.eye(at.shape[1])
    many = jax.jit(jax.vmap(jax.vmap(function)))
    return np.asarray(many(at[:, None] + ways) - many(at[:, None] - ways)) / (2 * step)


@pytest.mark.parametrize("name", ["grid", "field", "compact", pytest.param("guided", marks=pytest.mark.slow)])
def test_evaluation_has_the_derivatives_of_its_differences(name, rng):
    stage = stage_of(name, rng)

    def total(angles):
        return jnp.sum(jnp.sin(evaluate(stage, angles[0], angles[1], angles[2])))

    reverse, forward = by_both_modes(total)(AT)
    assert np.isfinite(reverse).all() and np.isfinite(forward).all()
    size = np.abs(reverse).max()
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=100 * tolerance(ROUNDING, float) * size)
    smooth, expected = SMOOTH[name], by_differences(total, AT)
    np.testing.assert_allclose(np.asarray(reverse)[smooth], expected[smooth], rtol=1e-5, atol=CLOSE)


@pytest.mark.parametrize("name", ["grid", "compact"])
def test_evaluation_has_the_derivative_by_wavelength(name, rng):
    stage = stage_of(name, rng)

    def total(wavelength_nm):
        return jnp.sum(jnp.sin(evaluate(stage, AT[:, 0], AT[:, 1], AT[:, 2], wavelength_nm)))

    at = np.array([[433.3, 512.5, 601.0]])
    reverse, forward = by_both_modes(total)(at)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(reverse, by_differences(total, at, 1e-3), rtol=1e-5, atol=CLOSE)


FITTED = {"grid": ("brdf",), "field": ("coefficient",), "compact": ("background", "lobe_height", "lobe_width")}


@pytest.mark.parametrize("name", FITTED)
def test_fitted_numbers_have_the_derivatives_of_their_differences(name, rng):
    stage = stage_of(name, rng)
    ways = {field: rng.normal(size=np.shape(getattr(stage, field))) for field in FITTED[name]}

    def moved(share):
        parts = {field: getattr(stage, field) + share[k] * way for k, (field, way) in enumerate(ways.items())}
        return jnp.sum(jnp.sin(evaluate(dataclasses.replace(stage, **parts), AT[:, 0], AT[:, 1], AT[:, 2])))

    at = np.zeros((1, len(ways)))
    reverse, forward = by_both_modes(moved)(at)
    assert np.isfinite(reverse).all()
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(reverse, by_differences(moved, at, 1e-6), rtol=CLOSE, atol=CLOSE)


@pytest.mark.parametrize("wavelength_nm", [UNIFORM_NM, WAVELENGTH_NM], ids=["FFT", "trapezoid"])
@pytest.mark.parametrize("kind", ["fourier", "cosine", "identity"])
def test_encoding_and_decoding_have_the_derivatives_of_their_differences(kind, wavelength_nm, rng):
    basis = make_basis(wavelength_nm, kind, 5)

    def there(spectrum):
        return jnp.sum(jnp.sin(encode(spectrum, basis)))

    def and_back(spectrum):
        return jnp.sum(jnp.sin(decode(encode(spectrum, basis), basis, jnp.asarray([450.0, 555.5]))))

    at = rng.uniform(0, 1, (2, len(wavelength_nm)))
    for function in (there, and_back):
        reverse, forward = by_both_modes(function)(at)
        np.testing.assert_allclose(forward, reverse, rtol=0, atol=tolerance(ROUNDING, float))
        np.testing.assert_allclose(reverse, by_differences(function, at), rtol=CLOSE, atol=CLOSE)
