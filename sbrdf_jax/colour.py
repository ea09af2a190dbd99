"""Spectra to colour: CIE XYZ by ASTM E308, sRGB for pictures, Lab, Delta E 2000.

The conversion is linear in the spectrum, so its weights are found once and a conversion is
a matrix product. The observers and D65 lie beside this file as colour-science has them, other illuminants
come from it: it takes two seconds to import, which is done inside functions. Tests hold all formulas
against colour-science.
"""

import contextlib
import dataclasses
import functools
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sbrdf_jax.interpolation import spectral_weights

VISIBLE_NM = (380.0, 780.0)
PRACTICE_NM = (360.0, 780.0)  # the range of ASTM E308
E308_INTERVALS = (1.0, 5.0, 10.0, 20.0)  # measurement intervals that ASTM E308 has a rule for [nm]
TABLE = Path(__file__).with_name("observers_d65.csv")  # over E308's range at 1 nm: wavelength, two observers, D65
LAB_CORNER = (6 / 29) ** 3  # below it the cube root of Lab goes on as a straight line
XYZ_TO_SRGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
SRGB_WHITE = np.array([0.3127 / 0.3290, 1.0, (1 - 0.3127 - 0.3290) / 0.3290])
CAT02 = np.array([[0.7328, 0.4296, -0.1624], [-0.7036, 1.6975, 0.0061], [0.0030, 0.0136, 0.9834]])  # to cone responses
OBSERVERS = {  # in the order of the table
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

    Intervals of 1 nm are summed as they are, of 5 nm at these wavelengths alone; 10 and 20 nm are
    interpolated by Lagrange's polynomials, as E308's tables of weights are. Any other wavelengths, uneven
    ones too, are brought to 1 nm by the C1 cubic of `spectral_weights`. Beyond the measured range the end
    value is held, as E308 says.

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
    if illuminant != "D65" and illuminant not in illuminants():
        raise ValueError(f"illuminant {illuminant!r} is unknown; it is one of {', '.join(illuminants())}")
    wavelength = np.asarray(wavelength_nm, float)
    note = coverage_note(wavelength)
    if wavelength[-1] < VISIBLE_NM[0] or wavelength[0] > VISIBLE_NM[1]:
        nothing = np.full((len(wavelength), 3), np.nan)
        return ColourMatching(wavelength, nothing, np.full(3, np.nan), note)
    one_nm, product = _one_nm_products(observer, illuminant)
    if _has_e308_rule(wavelength):
        rows = _e308_rows(wavelength, one_nm)
    else:
        rows = spectral_weights(np.clip(one_nm, wavelength[0], wavelength[-1]), wavelength)
    weight = rows.T @ product
    weight *= 100 / weight[:, 1].sum()
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
    share = np.asarray(xyz) / matching.white
    root = np.where(share > LAB_CORNER, np.cbrt(share), share / (3 * LAB_CORNER ** (2 / 3)) + 4 / 29)
    x, y, z = np.moveaxis(root, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def delta_e_2000(brdf_a: np.ndarray, brdf_b: np.ndarray, matching: ColourMatching) -> np.ndarray:
    """Colour difference CIE Delta E 2000 [...] between BRDF spectra [..., wavelength] in 1/sr."""
    return lab_difference(*(xyz_to_lab(brdf_to_xyz(brdf, matching), matching) for brdf in (brdf_a, brdf_b)))


def lab_difference(lab_a: np.ndarray, lab_b: np.ndarray) -> np.ndarray:
    """Colour difference CIE Delta E 2000 [...] between CIE 1976 L*a*b* [..., 3]: Sharma, Wu and Dalal (2005)."""
    (lightness_a, a_a, b_a), (lightness_b, a_b, b_b) = (np.moveaxis(np.asarray(lab), -1, 0) for lab in (lab_a, lab_b))
    stretch = 1.5 - _chroma_share((np.hypot(a_a, b_a) + np.hypot(a_b, b_b)) / 2) / 2
    chroma_a, chroma_b = np.hypot(stretch * a_a, b_a), np.hypot(stretch * a_b, b_b)
    hue_a, hue_b = (np.degrees(np.arctan2(b, stretch * a)) for a, b in ((a_a, b_a), (a_b, b_b)))
    turn = 180 - (180 - hue_b + hue_a) % 360  # the shorter way round
    hue, chroma, lightness = (hue_a + turn / 2) % 360, (chroma_a + chroma_b) / 2, (lightness_a + lightness_b) / 2
    terms = ((0.17, 1, -30.0), (-0.24, 2, 0.0), (-0.32, 3, 6.0), (0.20, 4, -63.0))
    wave = 1 - sum(height * np.cos(np.radians(k * hue + shift)) for height, k, shift in terms)
    from_middle = (lightness - 50) ** 2
    by_lightness = (lightness_b - lightness_a) / (1 + 0.015 * from_middle / np.sqrt(20 + from_middle))
    by_chroma = (chroma_b - chroma_a) / (1 + 0.045 * chroma)
    by_hue = 2 * np.sqrt(chroma_a * chroma_b) * np.sin(np.radians(turn / 2)) / (1 + 0.015 * chroma * wave)
    rotation = -np.sin(np.radians(60 * np.exp(-(((hue - 275) / 25) ** 2)))) * 2 * _chroma_share(chroma)
    return np.asarray(np.sqrt(by_lightness**2 + by_chroma**2 + by_hue**2 + rotation * by_chroma * by_hue))


def _chroma_share(chroma):
    return np.sqrt(chroma**7 / (chroma**7 + 25.0**7))


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
    xyz = exposure * brdf_to_xyz(brdf, matching) / matching.white[1]
    gain = (CAT02 @ SRGB_WHITE) / (CAT02 @ (matching.white / matching.white[1]))
    linear = xyz @ (XYZ_TO_SRGB @ np.linalg.inv(CAT02) @ (gain[:, None] * CAT02)).T
    if not gamma:
        return linear
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


@contextlib.contextmanager
def _expected_warnings_ignored():
    """Ignore what colour-science says of shapes that it aligns, and nothing else."""
    from colour.utilities import ColourRuntimeWarning

    with warnings.catch_warnings():
        for message in _EXPECTED_WARNINGS:
            warnings.filterwarnings("ignore", message=message, category=ColourRuntimeWarning)
        yield


@functools.cache
def _one_nm_products(observer: str, illuminant: str) -> tuple[np.ndarray, np.ndarray]:
    """E308's range at 1 nm [nm], and there the colour matching functions times the illuminant [wavelength, 3]."""
    table = np.loadtxt(TABLE, delimiter=",", skiprows=1)
    first = 1 + 3 * list(OBSERVERS).index(observer)
    one_nm, functions, light = table[:, 0], table[:, first : first + 3], table[:, -1]
    if illuminant != "D65":
        import colour

        with _expected_warnings_ignored():
            light = colour.SDS_ILLUMINANTS[illuminant].copy().align(colour.SpectralShape(*PRACTICE_NM, 1)).values
    return one_nm, functions * light[:, None]


def _has_e308_rule(wavelength_nm: np.ndarray) -> bool:
    """True where E308 has a rule: a uniform interval that it lists, in its range, on round wavelengths, 8 or more."""
    if len(wavelength_nm) < 8 or wavelength_nm[0] < PRACTICE_NM[0] or wavelength_nm[-1] > PRACTICE_NM[1]:
        return False
    steps = np.diff(wavelength_nm)
    grain = 10.0 if steps[0] >= 10 else steps[0]
    return bool(steps[0] in E308_INTERVALS and np.all(steps == steps[0]) and wavelength_nm[0] % grain == 0)


def _e308_rows(wavelength_nm: np.ndarray, one_nm: np.ndarray) -> Float[np.ndarray, "one_nm wavelength"]:
    """What spectra that have a rule are at each nanometre, as rows of weights; 0 where their interval leaves it out."""
    step = int(wavelength_nm[1] - wavelength_nm[0])
    if step == 20:  # to 10 nm within the measured range first
        tens = np.arange(wavelength_nm[0], wavelength_nm[-1] + 5, 10)
        return _e308_rows(tens, one_nm) @ _lagrange_rows(tens, wavelength_nm)
    nodes = one_nm[::step]
    rows = _lagrange_rows(one_nm, nodes) if step == 10 else (one_nm[:, None] == nodes).astype(float)
    held = np.searchsorted(wavelength_nm, np.clip(nodes, wavelength_nm[0], wavelength_nm[-1]))
    return rows @ np.eye(len(wavelength_nm))[held]


def _lagrange_rows(x: np.ndarray, nodes: np.ndarray) -> Float[np.ndarray, "x node"]:
    """Weights of the polynomials through the four uniform nodes around each place; three in the first and last gap."""
    rows, step, last = np.zeros((len(x), len(nodes))), nodes[1] - nodes[0], len(nodes) - 1
    for row, place in zip(rows, (x - nodes[0]) / step, strict=True):
        gap = min(int(place), last - 1)
        around = np.arange(max(gap - 1, 0), min(gap + 2, last) + 1)
        for k in around:
            others = around[around != k]
            row[k] = np.prod((place - others) / (k - others))
    return rows
