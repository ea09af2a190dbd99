"""Spectra to colour, through colour-science: CIE XYZ, sRGB for pictures, Lab, Delta E 2000.

The conversion is linear in the spectrum, so its weights are found once and a conversion is
a matrix product. colour-science takes a second to import: it is imported inside functions.
"""

import contextlib
import dataclasses
import functools
import warnings
from typing import Any

import numpy as np

from sbrdf_jax.interpolation import spectral_weights

VISIBLE_NM = (380.0, 780.0)
PRACTICE_NM = (360.0, 780.0)  # the range of ASTM E308
E308_INTERVALS = (1.0, 5.0, 10.0, 20.0)  # measurement intervals that ASTM E308 has a rule for [nm]
OBSERVERS = {
    "cie_1931_2deg": "CIE 1931 2 Degree Standard Observer",
    "cie_1964_10deg": "CIE 1964 10 Degree Standard Observer",
}

# What colour-science says while it fits its tables to a measurement: expected, and done here on purpose.
_EXPECTED_WARNINGS = (
    r'(?s).*Aligning ".*" (illuminant|spectral data) shape to',
    r'(?s).*Trimming ".*" spectral distribution (boundaries|shape)',
    r"(?s).*shape could not be honoured, using",
)


@dataclasses.dataclass(frozen=True)
class ColourMatching:
    """Tristimulus weights of one set of wavelengths under one observer and illuminant."""

    wavelength_nm: np.ndarray  # [wavelength]
    weight: np.ndarray  # [wavelength, 3] reflectance factor -> XYZ, Y = 100 for 1 everywhere; NaN where none is visible
    white: np.ndarray  # [3] XYZ of the perfect diffuser
    note: str  # what the wavelengths leave open; empty where they cover 380 to 780 nm


def colour_matching(
    wavelength_nm: np.ndarray, observer: str = "cie_1931_2deg", illuminant: str = "D65"
) -> ColourMatching:
    """Find the tristimulus weights of a set of wavelengths, by ASTM E308.

    At uniform intervals of 1, 5, 10 and 20 nm the weights are what colour-science's E308
    answers to unit spectra, and exact. Any other wavelengths, uneven ones too, are brought
    to 1 nm by the C1 cubic of `spectral_weights` and summed there by E308. Beyond the
    measured range the end value is held, as E308 says.

    Args:
        wavelength_nm: Increasing wavelengths [nm].
        observer: A key of `OBSERVERS`.
        illuminant: A name that colour-science knows.

    Returns:
        The weights, with a note where the wavelengths do not cover 380 to 780 nm.

    Raises:
        ValueError: the observer or the illuminant is unknown.
    """
    return _colour_matching(tuple(np.asarray(wavelength_nm, float).tolist()), observer, illuminant)


@functools.lru_cache(maxsize=16)
def _colour_matching(wavelength_nm: tuple[float, ...], observer: str, illuminant: str) -> ColourMatching:
    if observer not in OBSERVERS:
        raise ValueError(f"observer {observer!r} is unknown; it is {' or '.join(OBSERVERS)}")
    if illuminant not in illuminants():
        raise ValueError(f"illuminant {illuminant!r} is unknown; it is one of {', '.join(illuminants())}")
    wavelength = np.asarray(wavelength_nm, float)
    note = coverage_note(wavelength)
    if wavelength[-1] < VISIBLE_NM[0] or wavelength[0] > VISIBLE_NM[1]:
        nothing = np.full((len(wavelength), 3), np.nan)
        return ColourMatching(wavelength, nothing, np.full(3, np.nan), note)
    tables = _one_nm_tables(observer, illuminant)
    if _has_e308_rule(wavelength):
        weight = _unit_spectra_weights(wavelength, tables)
    else:
        weight = _weights_by_interpolation(wavelength, tables)
    return ColourMatching(wavelength, weight, weight.sum(0), note)


def illuminants() -> tuple[str, ...]:
    """Names of the illuminants that colour-science knows."""
    import colour

    return tuple(colour.SDS_ILLUMINANTS)


def coverage_note(wavelength_nm: np.ndarray) -> str:
    """Say in a sentence what wavelengths leave open for colour; empty where they cover 380 to 780 nm."""
    low, high = float(wavelength_nm[0]), float(wavelength_nm[-1])
    if high < VISIBLE_NM[0] or low > VISIBLE_NM[1]:
        return f"the spectra cover {low:g} to {high:g} nm, nothing of 380 to 780 nm: there is no colour"
    parts = []
    if low > VISIBLE_NM[0] or high < VISIBLE_NM[1]:
        parts.append(f"the spectra cover {low:g} to {high:g} nm, not 380 to 780 nm: their end values are held beyond")
    if len(wavelength_nm) < 8:
        parts.append(f"{len(wavelength_nm)} wavelengths make a rough colour")
    return "; ".join(parts)


def brdf_to_xyz(brdf: np.ndarray, matching: ColourMatching) -> np.ndarray:
    """XYZ [..., 3] of BRDF spectra [..., wavelength] in 1/sr; the perfect diffuser, 1/pi everywhere, has Y = 100."""
    return np.pi * (np.asarray(brdf) @ matching.weight)


def xyz_to_lab(xyz: np.ndarray, matching: ColourMatching) -> np.ndarray:
    """CIE 1976 L*a*b* [..., 3] of XYZ, relative to the perfect diffuser; linear, so finite, below 0."""
    import colour

    return colour.XYZ_to_Lab(np.asarray(xyz) / matching.white[1], colour.XYZ_to_xy(matching.white))


def delta_e_2000(brdf_a: np.ndarray, brdf_b: np.ndarray, matching: ColourMatching) -> np.ndarray:
    """Colour difference CIE Delta E 2000 [...] between BRDF spectra [..., wavelength] in 1/sr."""
    return lab_difference(*(xyz_to_lab(brdf_to_xyz(brdf, matching), matching) for brdf in (brdf_a, brdf_b)))


def lab_difference(lab_a: np.ndarray, lab_b: np.ndarray) -> np.ndarray:
    """Colour difference CIE Delta E 2000 [...] between CIE 1976 L*a*b* [..., 3]."""
    import colour

    return np.asarray(colour.delta_E(lab_a, lab_b, method="CIE 2000"))


def brdf_to_srgb(
    brdf: np.ndarray, matching: ColourMatching, *, exposure: float | int = 1.0, gamma: bool = True
) -> np.ndarray:
    """sRGB [..., 3] of BRDF spectra [..., wavelength] in 1/sr, for pictures.

    Args:
        brdf: BRDF spectra [1/sr].
        matching: Weights of their wavelengths.
        exposure: Multiplies the light; at 1 the perfect diffuser is white, (1, 1, 1).
        gamma: True encodes for a screen and clips to 0..1; False returns linear, unclipped values.

    Returns:
        sRGB values.
    """
    import colour

    xyz = exposure * brdf_to_xyz(brdf, matching) / matching.white[1]
    linear = colour.XYZ_to_sRGB(xyz, illuminant=colour.XYZ_to_xy(matching.white), apply_cctf_encoding=False)
    if not gamma:
        return linear
    return colour.cctf_encoding(np.clip(linear, 0.0, 1.0), function="sRGB")


@contextlib.contextmanager
def _expected_warnings_ignored():
    """Ignore what colour-science says of shapes that it aligns, and nothing else."""
    from colour.utilities import ColourRuntimeWarning

    with warnings.catch_warnings():
        for message in _EXPECTED_WARNINGS:
            warnings.filterwarnings("ignore", message=message, category=ColourRuntimeWarning)
        yield


@functools.cache
def _one_nm_tables(observer: str, illuminant: str) -> tuple[Any, Any]:
    """Colour matching functions and illuminant of colour-science, over E308's range at 1 nm."""
    import colour

    shape = colour.SpectralShape(*PRACTICE_NM, 1)
    with _expected_warnings_ignored():
        functions = colour.MSDS_CMFS[OBSERVERS[observer]].copy().align(shape)
        light = colour.SDS_ILLUMINANTS[illuminant].copy().align(shape)
    return functions, light


def _has_e308_rule(wavelength_nm: np.ndarray) -> bool:
    """True where E308 has a rule: a uniform interval that it lists, in its range, on round wavelengths, 8 or more."""
    if len(wavelength_nm) < 8 or wavelength_nm[0] < PRACTICE_NM[0] or wavelength_nm[-1] > PRACTICE_NM[1]:
        return False
    steps = np.diff(wavelength_nm)
    grain = 10.0 if steps[0] >= 10 else steps[0]
    return bool(steps[0] in E308_INTERVALS and np.all(steps == steps[0]) and wavelength_nm[0] % grain == 0)


def _unit_spectra_weights(wavelength_nm: np.ndarray, tables: tuple[Any, Any]) -> np.ndarray:
    """Weights [wavelength, 3] as what E308 in colour-science answers to each unit spectrum."""
    import colour

    weight = np.empty((len(wavelength_nm), 3))
    with _expected_warnings_ignored():
        for j, unit in enumerate(np.eye(len(wavelength_nm))):
            weight[j] = colour.sd_to_XYZ(colour.SpectralDistribution(unit, wavelength_nm), *tables)
    return weight


def _weights_by_interpolation(wavelength_nm: np.ndarray, tables: tuple[Any, Any]) -> np.ndarray:
    """Weights [wavelength, 3] through a C1 cubic to 1 nm, end values held beyond the measured range."""
    functions, light = tables
    one_nm = light.wavelengths
    summed = functions.values * light.values[:, None]
    summed *= 100 / summed[:, 1].sum()
    held = np.clip(one_nm, wavelength_nm[0], wavelength_nm[-1])
    return spectral_weights(held, wavelength_nm).T @ summed
