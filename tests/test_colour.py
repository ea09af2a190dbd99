"""Colour against colour-science itself, on the wavelengths that E308 has a rule for and on others."""

import warnings

import numpy as np
import pytest

from sbrdf_jax import colour as ours

D65_WHITE = np.array([95.047, 100.0, 108.883])


def smooth_spectrum(wavelength_nm):
    """A reflectance without features that 20 nm would miss."""
    return 0.2 + 0.5 / (1 + np.exp(-(wavelength_nm - 560) / 40)) + 0.1 * np.cos(wavelength_nm / 60)


@pytest.fixture(scope="module")
def tables():
    """What a user of colour-science takes for CIE 1931 and D65, brought to E308's range."""
    import colour

    shape = colour.SpectralShape(360, 780, 1)
    functions = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message='(?s).*Aligning "D65"')
        return functions, colour.SDS_ILLUMINANTS["D65"].copy().align(shape)


@pytest.mark.filterwarnings(
    "ignore:(?s).*(Trimming|Aligning|could not be honoured)"
)  # colour-science says what it aligns
@pytest.mark.parametrize(
    "wavelength_nm",
    [np.arange(400.0, 701.0, 10), np.arange(380.0, 781.0, 5), np.arange(380.0, 781.0, 20), np.arange(360.0, 781.0, 1)],
    ids=["10 nm", "5 nm", "20 nm", "1 nm"],
)
def test_e308_weights_are_what_colour_science_answers(rng, tables, wavelength_nm):
    import colour

    matching = ours.colour_matching(wavelength_nm)
    for reflectance in rng.uniform(0, 1, (3, len(wavelength_nm))):
        expected = colour.sd_to_XYZ(colour.SpectralDistribution(reflectance, wavelength_nm), *tables)
        np.testing.assert_allclose(ours.brdf_to_xyz(reflectance / np.pi, matching), expected, rtol=1e-12)


@pytest.mark.parametrize(
    "wavelength_nm",
    [
        np.arange(380.0, 781.0, 4),
        np.linspace(391.3, 783.7, 60),
        380 + 400 * np.linspace(0, 1, 50) ** 1.2,
        np.arange(350.0, 1001.0, 10),
        np.arange(382.0, 780.0, 5),
    ],
    ids=["4 nm", "odd ends", "uneven", "far beyond", "5 nm off the tens"],
)
def test_other_wavelengths_agree_with_one_nanometre(wavelength_nm):
    one_nm = np.arange(360.0, 781.0)
    expected = ours.brdf_to_xyz(smooth_spectrum(one_nm), ours.colour_matching(one_nm))
    found = ours.brdf_to_xyz(smooth_spectrum(wavelength_nm), ours.colour_matching(wavelength_nm))
    np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_the_perfect_diffuser_is_white_whatever_the_wavelengths():
    for wavelength_nm in (
        np.arange(400.0, 701.0, 10),
        np.linspace(380, 780, 101),
        np.array([450.0, 550, 650]),
        [550.0],
    ):
        matching = ours.colour_matching(np.asarray(wavelength_nm))
        diffuser = np.full(len(wavelength_nm), 1 / np.pi)
        np.testing.assert_allclose(ours.brdf_to_xyz(diffuser, matching), D65_WHITE, rtol=1e-3)
        np.testing.assert_allclose(ours.brdf_to_srgb(diffuser, matching), 1.0, atol=2e-3)
        np.testing.assert_allclose(ours.xyz_to_lab(matching.white, matching), [100, 0, 0], atol=1e-9)


def test_what_is_not_covered_is_said():
    assert ours.colour_matching(np.arange(380.0, 781.0, 4)).note == ""
    assert "400 to 700 nm" in ours.colour_matching(np.arange(400.0, 701.0, 10)).note
    assert "3 wavelengths" in ours.colour_matching(np.array([450.0, 550, 650])).note
    infrared = ours.colour_matching(np.arange(900.0, 1000.0, 10))
    assert "no colour" in infrared.note
    assert np.isnan(infrared.weight).all()


def test_nothing_but_the_expected_is_silenced():
    from colour.utilities import ColourRuntimeWarning

    with pytest.warns(ColourRuntimeWarning, match="something else"), ours._expected_warnings_ignored():
        warnings.warn("something else", ColourRuntimeWarning, stacklevel=1)


def test_delta_e_2000_meets_published_pairs():
    """Two rows of Sharma, Wu and Dalal (2005), table 1, as spectra that have these Lab values."""
    import colour

    matching = ours.colour_matching(np.arange(380.0, 781.0, 10))
    basis = np.linalg.pinv(matching.weight.T)
    pairs = [((50, 2.6772, -79.7751), (50, 0, -82.7485), 2.0425), ((50, 2.5, 0), (73, 25, -18), 27.1492)]
    for lab_a, lab_b, expected in pairs:
        white = colour.XYZ_to_xy(matching.white)
        a, b = (basis @ (colour.Lab_to_XYZ(np.array(lab), white) * 100) / np.pi for lab in (lab_a, lab_b))
        np.testing.assert_allclose(ours.delta_e_2000(a, b, matching), expected, atol=1e-4)


def test_shapes_negative_values_and_exposure():
    matching = ours.colour_matching(np.arange(380.0, 781.0, 10))
    brdf = np.linspace(-0.01, 0.5, 2 * 3 * 41).reshape(2, 3, 41)
    assert ours.brdf_to_srgb(brdf, matching).shape == (2, 3, 3)
    assert np.isfinite(ours.delta_e_2000(brdf, -brdf, matching)).all()
    linear = ours.brdf_to_srgb(brdf, matching, gamma=False)
    np.testing.assert_allclose(ours.brdf_to_srgb(brdf, matching, gamma=False, exposure=3), 3 * linear, rtol=1e-12)
    picture = ours.brdf_to_srgb(brdf, matching, exposure=100)
    assert picture.min() >= 0 and picture.max() <= 1


def test_an_unknown_observer_is_an_error():
    with pytest.raises(ValueError, match="observer"):
        ours.colour_matching(np.arange(380.0, 781.0, 10), observer="cie_2015")
