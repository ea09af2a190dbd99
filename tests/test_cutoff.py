"""The spectrum of scattered samples against the cut-off: planted bands, planted lobes, and degenerate geometries."""

import itertools

import numpy as np
import pytest
import scipy.special

from sbrdf_jax.cutoff import cutoff_warnings, hemisphere_modes, lobe_half_width, measure_cutoff, sequential_bases

STEP = np.radians(7.5)  # cut-off at degree 24
STEPS = {"theta_i_step": STEP, "theta_o_step": STEP, "phi_o_step": STEP}


def scattered(rng, count, largest_deg=85.0):
    """Directions uniform over the hemisphere down to a polar angle."""
    cosine = rng.uniform(np.cos(np.radians(largest_deg)), 1.0, count)
    return np.arccos(cosine), rng.uniform(0, 2 * np.pi, count)


def angle_from(theta, phi, peak_theta):
    cosine = np.sin(theta) * np.sin(peak_theta) * np.cos(phi - np.pi) + np.cos(theta) * np.cos(peak_theta)
    return np.arccos(np.clip(cosine, -1, 1))


def test_modes_are_the_even_harmonics_of_scipy(rng):
    theta, phi = scattered(rng, 50)
    for degree, modes in enumerate(itertools.islice(hemisphere_modes(theta, phi), 12)):
        orders = range(degree % 2, degree + 1, 2)
        wanted = [scipy.special.sph_harm_y(degree, m, theta, phi) for m in orders]
        assert modes.shape == (50, degree // 2 + 1)
        for mode, reference in zip(modes.T, [y.real for y in wanted], strict=True):
            scale = mode @ reference / (reference @ reference)
            np.testing.assert_allclose(mode, scale * reference, atol=1e-12 * np.abs(mode).max())


def test_bases_are_orthonormal_and_leave_freedom_to_the_samples(rng):
    theta, phi = scattered(rng, 200)
    bases = sequential_bases(theta, phi, max_degree=60)
    columns = np.concatenate(bases, axis=1)
    np.testing.assert_allclose(columns.T @ columns, np.eye(columns.shape[1]), atol=1e-12)
    assert 100 < columns.shape[1] <= 160


@pytest.mark.parametrize("degree", [3, 10, 20])
def test_band_limited_signal_has_no_power_above_its_band(rng, degree):
    theta, phi = scattered(rng, 700)
    modes = np.concatenate(list(itertools.islice(hemisphere_modes(theta, phi), degree + 1)), axis=1)
    value = modes @ rng.normal(size=(modes.shape[1], 4))
    (spectrum,) = measure_cutoff(np.full(700, 0.5), theta, phi, value, **STEPS)
    assert spectrum.is_resolved
    assert spectrum.sample_power[degree] > 1e-3
    assert spectrum.sample_power[degree + 1 :].max() < 1e-20
    assert spectrum.share_above < 1e-7


def test_powers_add_up_and_white_noise_is_flat(rng):
    theta, phi = scattered(rng, 600)
    noise = rng.normal(size=(600, 300))
    value = 5 + noise
    (spectrum,) = measure_cutoff(np.zeros(600), theta, phi, value, residual=noise, **STEPS)
    assert spectrum.residual_power is not None
    energy = np.mean(value**2)
    np.testing.assert_allclose(energy * spectrum.residual_power, 1.0, atol=0.3)
    np.testing.assert_allclose(spectrum.sample_power[1:], spectrum.residual_power[1:], rtol=1e-9)
    # each mode takes 1 / 600 of white noise, so what is above the cut-off is counted, not guessed
    left = 1 - spectrum.num_modes[spectrum.degree <= spectrum.cutoff].sum() / 600
    assert spectrum.share_above == pytest.approx(np.sqrt(left / energy), rel=0.02)
    (warning,) = cutoff_warnings([spectrum])
    assert "or the noise is as large, at theta_i 0 deg" in warning


@pytest.mark.parametrize("half_width_deg", [4.0, 9.0, 16.0, 25.0])
def test_half_width_of_a_planted_lobe_and_its_warning(rng, half_width_deg):
    theta, phi = scattered(rng, 1000)
    theta_i = np.radians(30)
    spacing = 4.5  # degrees between 1000 directions: nothing is known of the lobe between them
    alpha = angle_from(theta, phi, theta_i)
    value = 0.1 + 2.0 * 0.5 ** ((alpha / np.radians(half_width_deg)) ** 2)
    assert np.degrees(lobe_half_width(theta_i, theta, phi, value)) == pytest.approx(half_width_deg, abs=spacing / 2)
    (spectrum,) = measure_cutoff(np.full(1000, theta_i), theta, phi, value[:, None], **STEPS)
    assert any("coarse for the lobe" in text for text in cutoff_warnings([spectrum])) == (half_width_deg < 1.5 * 7.5)
    assert spectrum.steps_per_half_width == pytest.approx(half_width_deg / 7.5, abs=spacing / 15)


def test_spike_is_above_the_cutoff_and_a_matte_surface_has_no_lobe(rng):
    theta, phi = scattered(rng, 400)
    matte = 0.3 + 0.05 * np.cos(theta)
    assert np.isnan(lobe_half_width(0.5, theta, phi, matte))
    spiked = matte.copy()
    spiked[np.argmin(angle_from(theta, phi, 0.5))] = 100.0
    quiet, loud = (
        measure_cutoff(np.full(400, 0.5), theta, phi, value[:, None], **STEPS)[0] for value in (matte, spiked)
    )
    assert cutoff_warnings([quiet]) == [] and quiet.share_above < 1e-3
    assert loud.share_above > 0.3
    narrow, aliased = cutoff_warnings([quiet, loud])
    assert "coarse for the lobe at theta_i 28.6 deg" in narrow and "root mean square lies above the cut-off" in aliased


def test_in_plane_samples_have_one_mode_a_degree(rng):
    angle = np.radians(np.arange(-80.0, 80.5, 1.0))
    theta, phi = np.abs(angle), np.where(angle < 0, 0.0, np.pi)
    value = np.cos(6 * angle)[:, None] + 2
    (spectrum,) = measure_cutoff(np.full(len(angle), 0.2), theta, phi, value, **STEPS)
    assert (spectrum.num_modes <= 1).all() and spectrum.degree[-1] >= 24
    assert spectrum.share_above < 1e-6


def test_bad_rows_and_small_groups_are_left_out(rng):
    theta, phi = scattered(rng, 120)
    theta_i = np.repeat([0.1, 0.6, 1.1], 40)
    value = np.ones((120, 2))
    value[3, 1] = np.nan  # one row of the first group
    value[40:70] = np.inf  # leaves 10 rows of the second, too few
    value[80:] = 0.0  # nothing in the third
    spectra = measure_cutoff(theta_i, theta, phi, value, **STEPS)
    assert [(s.num_samples, round(s.theta_i, 6)) for s in spectra] == [(39, 0.1)]
