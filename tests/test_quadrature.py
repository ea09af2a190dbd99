"""Colour from few wavelengths: exact where spectra span few dimensions, within its limit on others, never beyond."""

import numpy as np
import pytest

from sbrdf_jax import colour
from sbrdf_jax.errors import UserError
from sbrdf_jax.options import ColourOptions, ErrorBudget, SceneOptions
from sbrdf_jax.quadrature import FEWEST, choose_quadrature

NM = np.arange(400.0, 701.0, 10.0)


def spectra(rng, dimensions: int, count: int = 300) -> np.ndarray:
    centres = np.linspace(420, 680, dimensions)
    shapes = np.exp(-0.5 * ((NM - centres[:, None]) / 60) ** 2)
    return rng.uniform(0.02, 0.3, (count, dimensions)) @ shapes


def scene(limit: float | None = None, **keys) -> SceneOptions:
    budget = None if limit is None else ErrorBudget(delta_e=limit)
    return SceneOptions(colour=ColourOptions(**keys), error_budget=budget)


def test_spectra_of_few_dimensions_need_no_more_wavelengths(rng):
    found = choose_quadrature(NM, spectra(rng, FEWEST), scene(1e-6))
    assert len(found.index) == FEWEST and found.delta_e < 1e-6
    other = spectra(rng, FEWEST)
    exact = colour.brdf_to_xyz(other, colour.colour_matching(NM))
    np.testing.assert_allclose(colour.brdf_to_xyz(other[:, found.index], found.matching), exact, rtol=1e-8)


@pytest.mark.parametrize("limit", [0.2, 1.0])
def test_other_samples_stay_below_the_limit(rng, limit):
    some, other = np.split(spectra(rng, 9, 600), 2)
    found = choose_quadrature(NM, some, scene(limit))
    assert len(found.index) <= 9
    full = colour.colour_matching(NM)
    labs = [
        colour.xyz_to_lab(colour.brdf_to_xyz(brdf, matching), matching)
        for brdf, matching in ((other, full), (other[:, found.index], found.matching))
    ]
    assert np.quantile(colour.lab_difference(*labs), 0.9) <= limit
    assert np.all(np.diff(found.index) > 0)


def test_three_bands_are_taken_as_they_are(rng):
    found = choose_quadrature(np.array([450.0, 550.0, 610.0]), rng.uniform(0.1, 0.3, (50, 3)), scene())
    np.testing.assert_array_equal(found.index, [0, 1, 2])
    assert found.delta_e < 1e-6


def test_a_wavelength_that_is_not_finite_is_not_chosen(rng):
    value = spectra(rng, 4)
    value[:, 12] = np.nan
    assert 12 not in choose_quadrature(NM, value, scene(0.1)).index


def test_what_has_no_colour_is_refused(rng):
    with pytest.raises(UserError, match="found 'D66'"):
        choose_quadrature(NM, spectra(rng, 3), scene(illuminant="D66"))
    with pytest.raises(UserError, match="there is no colour"):
        choose_quadrature(NM + 600, spectra(rng, 3), scene())
