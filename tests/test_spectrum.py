"""Noise that is each wavelength's own, kept out by a projection of the spectra."""

import numpy as np
import pytest

from sbrdf_jax.builtin import measure
from sbrdf_jax.cleaning import clean
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.resampling.guided import fit_field
from sbrdf_jax.resampling.guided.field import evaluate_directions
from sbrdf_jax.resampling.guided.spectrum import spectral_filter

DIRECTIONS, WAVELENGTHS, RANK, NOISE = 600, 40, 3, 0.02


@pytest.fixture
def planted(rng):
    """Spectra of three components that predictions left out tell well, and noise that they do not."""
    truth = rng.normal(size=(DIRECTIONS, RANK)) @ rng.normal(size=(RANK, WAVELENGTHS))
    error = NOISE * rng.uniform(0.3, 3.0, WAVELENGTHS)
    noise, of_prediction = rng.normal(size=(2, DIRECTIONS, WAVELENGTHS)) * error
    return truth, truth + noise, noise - 0.3 * of_prediction


def plain_filter(z, left_out):
    """The same in plain NumPy, by a singular value decomposition, of directions of about equal error."""
    error = np.sqrt((left_out**2).mean(axis=0))
    spectra, predicted = z / error, (z - left_out) / error
    components = np.linalg.svd(predicted, full_matrices=False)[2]
    kept = [c for c in components if np.sum((spectra @ c - predicted @ c) ** 2) < np.sum((spectra @ c) ** 2)]
    return sum(np.outer(spectra @ c, c) for c in kept) * error


def test_only_what_left_out_directions_tell_is_kept(planted):
    truth, z, left_out = planted
    found = spectral_filter(z, left_out)
    assert found.to_component.shape == (WAVELENGTHS, RANK)
    left = np.linalg.norm(found(z) - truth) / np.linalg.norm(z - truth)
    assert left < 1.3 * np.sqrt(RANK / WAVELENGTHS)


def test_filter_equals_its_plain_twin(planted):
    _, z, left_out = planted
    # one error for all directions: none counts less than another
    left_out = left_out / np.sqrt((left_out**2).mean(axis=1, keepdims=True)) * NOISE
    np.testing.assert_allclose(spectral_filter(z, left_out)(z), plain_filter(z, left_out), rtol=0, atol=1e-10)


def test_filter_is_a_projection_and_follows_the_unit_of_each_wavelength(planted, rng):
    _, z, left_out = planted
    once = spectral_filter(z, left_out)(z)
    np.testing.assert_allclose(spectral_filter(z, left_out)(once), once, rtol=0, atol=1e-10)
    unit = rng.uniform(0.5, 2.0, WAVELENGTHS)
    weight = np.sqrt((left_out**2).mean(axis=1) / ((unit * left_out) ** 2).mean(axis=1))[:, None]
    assert spectral_filter(z * unit * weight, left_out * unit * weight).to_component.shape == (WAVELENGTHS, RANK)


def test_a_loud_wavelength_disturbs_no_other(planted, rng):
    truth, z, left_out = planted
    loud = np.zeros(WAVELENGTHS)
    loud[7] = 1.0
    shout = 50 * rng.normal(size=(DIRECTIONS, 1)) * loud
    others = np.arange(WAVELENGTHS) != 7
    found = spectral_filter(z + shout, left_out + shout)(z + shout)
    assert np.linalg.norm((found - truth)[:, others]) < 0.5 * np.linalg.norm((z - truth)[:, others])


@pytest.mark.parametrize("case", ["few directions", "no error", "not finite", "all predicted"])
def test_spectra_are_left_as_they_are(planted, case):
    truth, z, left_out = planted
    if case == "few directions":
        z, left_out = z[:20], left_out[:20]
    elif case == "no error":
        left_out = np.zeros_like(z)
    elif case == "not finite":
        left_out = np.where(np.arange(DIRECTIONS)[:, None] == 3, np.nan, left_out)
    else:
        z, left_out = z[:, :RANK], (z - truth)[:, :RANK]
    found = spectral_filter(z, left_out)
    assert found.to_component.shape[1] == 0
    assert found(z) is z


def test_highlights_have_no_noise_of_single_wavelengths():
    raw = measure("amber_glass")  # noise of 1 % of each sample and wavelength
    options = ResampleOptions(method="guided", smoothness_weight="data", tolerance=1e-6)
    field = fit_field(clean(raw, method="guided").samples, options).field
    angle = np.deg2rad([0.0, 45.0])
    value = evaluate_directions(field, angle, angle, np.full(2, np.pi))
    roughness = np.diff(value, 2, axis=1).std(axis=1) / value.mean(axis=1) / np.sqrt(6)
    assert (roughness < 1.5e-3).all()  # 2 to 4e-3 where each wavelength has lobes of its own
