"""Colour from few wavelengths: which, and with which weights, so that a colour difference stays below a limit.

The spectra of a material span few dimensions. In r of them a colour, a linear functional of
the spectrum, is one of r of its values: those wavelengths are chosen by QR with pivots on the
leading r spectra, and r grows until the samples' colours agree.
"""

import dataclasses

import numpy as np
import scipy.linalg
from jaxtyping import Float

from sbrdf_jax import colour
from sbrdf_jax.encoding import spectral_vectors
from sbrdf_jax.errors import UserError
from sbrdf_jax.options import SceneOptions

DEFAULT_DELTA_E = 0.5  # CIE Delta E 2000, where the scene states none
COVERED = 0.95  # share of the samples that stay below the limit
FEWEST = 3  # a colour is three numbers
MOST_VECTORS = 16  # what is left of spectra in more dimensions is noise
MOST_SAMPLES = 4096


@dataclasses.dataclass(frozen=True)
class Quadrature:
    """Wavelengths that stand for all under one observer and illuminant."""

    index: np.ndarray  # [chosen] of the wavelengths, increasing
    matching: colour.ColourMatching  # at the chosen wavelengths
    observer: str
    illuminant: str
    delta_e: float  # 95th percentile over samples that did not choose
    limit: float


def choose_quadrature(
    wavelength_nm: Float[np.ndarray, " wavelength"], value: Float[np.ndarray, "sample wavelength"], scene: SceneOptions
) -> Quadrature:
    """Choose the fewest wavelengths whose colours differ by no more than the scene allows.

    Every second sample chooses, the others measure. Both are taken without what lies outside
    the leading spectra, which is noise of single measurements.

    Args:
        wavelength_nm: Wavelengths to choose from [nm].
        value: Cleaned samples there [1/sr].
        scene: `colour`, and `error_budget.delta_e` where it is given.

    Returns:
        The quadrature; all wavelengths where fewer are not enough.

    Raises:
        UserError: The illuminant is unknown, or no wavelength is visible.
    """
    options = scene.colour
    assert options is not None
    budget = scene.error_budget
    limit = DEFAULT_DELTA_E if budget is None or budget.delta_e is None else budget.delta_e
    if options.illuminant not in colour.illuminants():
        expected = f"one of {', '.join(colour.illuminants())}"
        raise UserError(f"scene.colour.illuminant: found {options.illuminant!r}; expected {expected}")
    matching = colour.colour_matching(wavelength_nm, options.observer, options.illuminant)
    if not np.isfinite(matching.white).all():
        raise UserError(f"scene.colour: {matching.note}; expected visible wavelengths")
    finite = np.isfinite(value).all(axis=0)
    some = value[np.isfinite(value[:, finite]).all(axis=1)][:, finite]
    some = np.maximum(some[np.linspace(0, len(some) - 1, min(len(some), MOST_SAMPLES)).astype(int)], 0.0)
    some = some[some.any(axis=1)]
    vectors = spectral_vectors(some[::2] / np.linalg.norm(some[::2], axis=1, keepdims=True))[:MOST_VECTORS]
    others = (some[1::2] if len(some) > 1 else some) @ vectors.T @ vectors
    full, weight = dataclasses.replace(matching, weight=matching.weight[finite]), matching.weight[finite]
    place = np.flatnonzero(finite)
    for count in range(min(FEWEST, len(vectors)), len(vectors) + 1):
        leading = vectors[:count]
        chosen = np.sort(scipy.linalg.qr(leading, pivoting=True, mode="r")[1][:count])
        few = weight.T @ leading.T @ np.linalg.inv(leading[:, chosen].T)
        reduced = dataclasses.replace(full, wavelength_nm=wavelength_nm[place[chosen]], weight=few.T)
        difference = _difference(others, chosen, full, reduced)
        if difference <= limit or count == len(vectors):
            break
    if difference > limit:
        chosen, reduced, difference = np.arange(len(place)), full, 0.0
    return Quadrature(place[chosen], reduced, options.observer, options.illuminant, difference, limit)


def _difference(spectra, chosen, full: colour.ColourMatching, reduced: colour.ColourMatching) -> float:
    one, other = (
        colour.xyz_to_lab(colour.brdf_to_xyz(brdf, matching), matching)
        for brdf, matching in ((spectra, full), (spectra[:, chosen], reduced))
    )
    return float(np.quantile(colour.lab_difference(one, other), COVERED))
