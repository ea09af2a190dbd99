"""Spectrum <-> coefficients against quadrature, and what the contract says of short spectra."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from tolerances import ROUNDING, tolerance

from sbrdf_jax import encoding
from sbrdf_jax.records import GriddedBRDF

TIGHT = tolerance(ROUNDING, np.float64)
UNIFORM = np.linspace(380.0, 780.0, 101)
UNEVEN = 380.0 + 400.0 * np.linspace(0, 1, 41) ** 1.3


def series(position, coefficient, kind):
    """The plain twin of `decode`: eq. (11) term by term."""
    value = coefficient[0] / 2 + 0 * position
    for k in range(1, len(coefficient)):
        if kind == "cosine":
            value = value + coefficient[k] * np.cos(np.pi * k * position)
        else:
            wave = np.sin if k % 2 == 0 else np.cos
            value = value + coefficient[k] * wave(2 * np.pi * ((k + 1) // 2) * position)
    return value


@pytest.mark.parametrize("kind", ["fourier", "cosine"])
def test_a_band_limited_spectrum_gives_the_integrals_of_eq_12(kind, rng):
    planted = rng.normal(size=19)
    basis = encoding.make_basis(UNIFORM, kind, 19)
    found = encoding.encode(series((UNIFORM - 380) / 400, planted, kind), basis)
    np.testing.assert_allclose(found, planted, rtol=0, atol=TIGHT)
    for k in (0, 1, 6, 18):  # by adaptive quadrature of the continuous function
        unit = np.zeros(19)
        unit[k] = 1 + (k == 0)
        integral, _ = quad(lambda x, unit=unit: series(x, planted, kind) * series(x, unit, kind), 0, 1, limit=200)
        np.testing.assert_allclose(found[k], 2 * integral, rtol=0, atol=1e-11)


@pytest.mark.parametrize("kind", ["fourier", "cosine"])
def test_encoding_is_the_trapezoid_rule_with_both_ends(kind, rng):
    wavelength_nm = UNIFORM
    spectrum = rng.uniform(size=(3, 2, wavelength_nm.size))
    basis = encoding.make_basis(wavelength_nm, kind, 19)
    position = (wavelength_nm - wavelength_nm[0]) / (wavelength_nm[-1] - wavelength_nm[0])
    for k in range(19):
        unit = np.zeros(19)
        unit[k] = 1 + (k == 0)
        expected = 2 * np.trapezoid(spectrum * series(position, unit, kind), position, axis=-1)
        np.testing.assert_allclose(encoding.encode(spectrum, basis)[..., k], expected, rtol=0, atol=TIGHT)
    np.testing.assert_allclose(encoding.encode(spectrum, basis), spectrum @ basis.analysis, rtol=0, atol=TIGHT)


@pytest.mark.parametrize("kind", ["fourier", "cosine"])
def test_uneven_wavelengths_are_least_squares(kind, rng):
    spectrum = rng.uniform(size=(3, 2, UNEVEN.size))
    basis = encoding.make_basis(UNEVEN, kind, 19)
    rows = np.asarray(basis.synthesis).T
    expected = np.linalg.lstsq(rows, spectrum.reshape(6, -1).T)[0].T.reshape(3, 2, 19)
    np.testing.assert_allclose(encoding.encode(spectrum, basis), expected, rtol=0, atol=1e-9)
    few = encoding.make_basis(np.array([400.0, 410.0, 420.0, 440.0, 700.0]), kind, 3)
    np.testing.assert_allclose(encoding.decode(encoding.encode(np.ones(5), few), few), 1.0, rtol=1e-12)


def test_uniform_to_a_millionth_takes_the_fft():
    assert encoding.make_basis(UNIFORM + 1e-7 * np.sin(UNIFORM), "fourier", 19).uniform
    assert not encoding.make_basis(UNIFORM + 1e-3 * np.sin(UNIFORM), "fourier", 19).uniform


@pytest.mark.parametrize(("kind", "count"), [("fourier", 19), ("cosine", 18), ("identity", 41)])
def test_round_trip_and_synthesis_between_wavelengths(kind, count, rng):
    wavelength_nm = UNEVEN if kind == "identity" else UNIFORM
    basis = encoding.make_basis(wavelength_nm, kind, count)
    planted = rng.normal(size=(4, count))
    spectrum = encoding.decode(planted, basis)
    np.testing.assert_allclose(encoding.encode(spectrum, basis), planted, rtol=0, atol=TIGHT)
    np.testing.assert_allclose(encoding.decode(planted, basis, wavelength_nm), spectrum, rtol=0, atol=TIGHT)
    between = np.array([380.0, 381.3, 552.7, 780.0])
    for row, found in zip(planted, encoding.decode(planted, basis, between), strict=True):
        if kind == "identity":
            expected = np.interp(between, wavelength_nm, row)
        else:
            expected = series((between - 380) / 400, row, kind)
        np.testing.assert_allclose(found, expected, rtol=0, atol=TIGHT)


def test_vectors_of_the_logarithm_keep_every_spectrum_positive(rng):
    shapes = rng.normal(size=(2, UNEVEN.size))
    logarithms = rng.normal(size=(3, 20, 2)) @ shapes - 5
    spectra = np.exp(logarithms)
    basis = encoding.data_basis(UNEVEN, spectra, 3, "log_data")
    weight = np.linalg.norm(spectra, axis=2, keepdims=True) / np.linalg.norm(spectra, axis=(1, 2), keepdims=True)
    expected = np.linalg.svd((weight * logarithms).reshape(-1, UNEVEN.size))[2][:3]
    np.testing.assert_allclose(np.abs(expected @ basis.synthesis.T), np.eye(3), rtol=0, atol=1e-7)
    coefficient = encoding.encode(spectra, basis)  # two shapes and a constant: three vectors hold all
    np.testing.assert_allclose(encoding.decode(coefficient, basis), spectra, rtol=1e-7)
    wild = encoding.decode(5 * rng.normal(size=(50, 3)), basis, np.array([400.0, 512.3]))
    assert (wild > 0).all() and encoding.coefficient_names(basis) == ("v_0", "v_1", "v_2")

    assert np.isfinite(encoding.decode(np.full((1, 3), 1e4), basis)).all()
    spectra[1, 2], spectra[2, 3, 4] = 0.0, np.nan
    coefficient = encoding.encode(spectra, basis)
    assert np.isfinite(np.delete(coefficient.reshape(60, 3), 43, axis=0)).all() and np.isnan(coefficient[2, 3]).all()
    assert encoding.decode(coefficient[1, 2], basis).max() < 1e-6 * np.nanmax(spectra)


def test_a_jump_between_the_ends_rings_in_fourier_and_not_in_cosine():
    ramp = np.linspace(0.0, 1.0, 101)
    error = {}
    for kind in ("fourier", "cosine"):
        basis = encoding.make_basis(UNIFORM, kind, 19)
        error[kind] = np.abs(encoding.decode(encoding.encode(ramp, basis), basis) - ramp).max()
    assert error["fourier"] > 0.4  # the series starts and ends with the mean of both ends
    assert error["cosine"] < 0.02


@pytest.mark.parametrize(
    ("n", "wanted", "kind", "expected"),
    [
        (101, 19, "fourier", ("fourier", 19)),
        (31, 19, "cosine", ("cosine", 19)),
        (16, 19, "fourier", ("fourier", 15)),
        (15, 19, "fourier", ("fourier", 13)),
        (31, 18, "fourier", ("fourier", 17)),
        (31, 18, "cosine", ("cosine", 18)),
        (5, 19, "cosine", ("cosine", 3)),
        (4, 19, "fourier", ("identity", 4)),
        (3, 19, "identity", ("identity", 3)),
        (1, 1, "fourier", ("identity", 1)),
    ],
)
def test_fewer_wavelengths_than_coefficients(n, wanted, kind, expected):
    allowed = encoding.coefficients_allowed(n, wanted, kind)
    assert allowed[:2] == expected
    clipped = kind != "identity" and expected != (kind, wanted)
    assert (allowed.warning is not None) == clipped
    basis = encoding.make_basis(np.linspace(400.0, 700.0, n), kind, wanted)
    assert (basis.kind, basis.synthesis.shape) == (expected[0], (expected[1], n))
    assert len(encoding.coefficient_names(basis)) == expected[1]
    assert np.isfinite(encoding.decode(np.ones((2, expected[1])), basis, np.array([400.0, 400.0]))).all()


def test_names_follow_eq_11():
    assert encoding.coefficient_names(encoding.make_basis(UNIFORM, "fourier", 5)) == ("a_0", "a_1", "b_1", "a_2", "b_2")
    assert encoding.coefficient_names(encoding.make_basis(UNIFORM[:3], "identity", 3)) == ("380nm", "384nm", "388nm")


@pytest.mark.parametrize(
    ("wavelength_nm", "kind", "count"),
    [(UNIFORM[::-1], "fourier", 3), (UNIFORM[:0], "fourier", 3), (UNIFORM, "wavelet", 3), (UNIFORM, "cosine", 0)],
)
def test_what_cannot_be_a_basis_is_refused(wavelength_nm, kind, count):
    with pytest.raises(ValueError, match="expected"):
        encoding.make_basis(wavelength_nm, kind, count)


def test_encode_fft_refuses_what_the_samples_cannot_carry():
    for count in (4, 11):
        with pytest.raises(ValueError, match="odd number up to 9"):
            encoding.encode_fft(np.ones(10), count)


def test_field_mean_nan_and_transformations(rng):
    basis = encoding.make_basis(UNIFORM, "fourier", 19)
    brdf = rng.uniform(size=(2, 3, 4, 101))
    brdf[0, 1, 2, 7] = np.nan
    axis = [np.linspace(0, 1, n) for n in brdf.shape[:3]]
    nothing = np.zeros(101)
    gridded = GriddedBRDF(*axis, UNIFORM, brdf, np.zeros(brdf.shape[:3], int), nothing, nothing, nothing)
    field = encoding.encode_field(gridded, basis)
    spoiled = np.isnan(field.coefficient).any(axis=-1)
    assert spoiled.sum() == 1 and spoiled[0, 1, 2]
    mean = np.trapezoid(brdf, UNIFORM, axis=-1) / 400
    np.testing.assert_allclose(encoding.mean_spectrum(field.coefficient, basis), mean, rtol=0, atol=TIGHT)
    lane = jax.jit(encoding.encode)(brdf[1, 0, 0], basis)  # alone as in the batch
    np.testing.assert_allclose(lane, field.coefficient[1, 0, 0], rtol=0, atol=TIGHT)
    slope = jax.grad(lambda nm: encoding.decode(field.coefficient[1, 0, 0], basis, nm[None])[0])(jnp.asarray(500.0))
    values = encoding.decode(field.coefficient[1, 0, 0], basis, np.array([499.99, 500.01]))
    np.testing.assert_allclose(slope, (values[1] - values[0]) / 0.02, rtol=1e-5)


def test_float32_loses_only_rounding(rng):
    spectrum = rng.uniform(size=(5, 101))
    for kind in ("fourier", "cosine"):
        basis = encoding.make_basis(UNIFORM, kind, 19)
        for one in (basis, dataclasses.replace(basis, uniform=False)):
            found = encoding.encode(spectrum.astype(np.float32), one)
            assert found.dtype == np.float32
            np.testing.assert_allclose(
                found, encoding.encode(spectrum, basis), rtol=0, atol=tolerance(ROUNDING, np.float32)
            )
