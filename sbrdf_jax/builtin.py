"""The embedded sample: a simulated goniometer run of an amber glass, and its noise-free truth.

It stands in for the measurement of the paper, which is not public. Three materials share one
formula; they differ in roughness and in whether the spectrum falls again at its red end, which
decides how well a short periodic Fourier series can carry it.
"""

import dataclasses
import functools
import hashlib

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from sbrdf_jax.angles import MIRROR_AZIMUTH, wrap_azimuth
from sbrdf_jax.errors import UserError
from sbrdf_jax.records import RawSamples

PREFIX = "builtin:"
REFRACTIVE_INDEX = 1.52
MIN_COS = np.cos(np.radians(85.0))  # every cosine of theta_i and theta_o is floored here
HAZE_WIDTH = np.radians(42.0)  # forward haze round the mirror direction [rad]

WAVELENGTH_NM = np.arange(380.0, 781.0, 4.0)
THETA_I_DEG = np.array([0.0, 7, 15, 22, 30, 38, 45, 52, 60, 67, 75, 80, 85])
MAX_THETA_O = np.radians(85.0)
COARSE_STEP = np.radians(8.0)  # of theta_o and phi_o, everywhere
FINE_STEP = np.radians(3.0)  # near the mirror direction
FINE_RADIUS = np.radians(25.0)
BLOCKED_RADIUS = np.radians(4.0)  # round the incidence, where the source stands in the way
DEFAULT_COUNT = 770
JITTER = 0.25  # of a lattice step, to either side


@dataclasses.dataclass(frozen=True)
class AmberGlass:
    """What tells one amber glass from another."""

    alpha: float  # GGX roughness
    red_dip: float  # r: how deeply the spectrum falls beyond 715 nm, 0 to 1


MATERIALS = {
    "amber_glass": AmberGlass(alpha=0.20, red_dip=0.93),
    "amber_glass_sharp": AmberGlass(alpha=0.12, red_dip=0.0),
    "amber_glass_broad": AmberGlass(alpha=0.35, red_dip=0.0),
}


def material(name: str) -> AmberGlass:
    """Return the parameters of an embedded material, named with or without "builtin:".

    Raises:
        UserError: there is no such material.
    """
    found = MATERIALS.get(name.removeprefix(PREFIX))
    if found is None:
        raise UserError(f"{name}: no such embedded material, expected one of {', '.join(MATERIALS)}")
    return found


def true_brdf(
    name: str, theta_i: ArrayLike, theta_o: ArrayLike, phi_o: ArrayLike, wavelength_nm: ArrayLike
) -> Float[np.ndarray, "*shape wavelength"]:
    """Return the noise-free BRDF of an embedded material.

    f = D G F(theta_d) / (4 cos_i cos_o) + (1 - F_i) (1 - F_o) s(lambda) / pi (1 + 0.35 exp(-(beta / 42 deg)^2)),
    with GGX D, height-correlated Smith G, exact unpolarised Fresnel F, and beta the angle from the mirror direction.

    Args:
        name: One of `MATERIALS`, with or without "builtin:".
        theta_i: Incident polar angle [rad], 0 to pi/2.
        theta_o: Outgoing polar angle [rad], 0 to pi/2; the three angles broadcast.
        phi_o: Outgoing azimuth [rad], the mirror direction at pi.
        wavelength_nm: Wavelengths [nm], one-dimensional.

    Returns:
        BRDF [1/sr], the shape of the angles, then wavelength.

    Raises:
        UserError: `name` is unknown.

    Numerics:
        Cosines of theta_i and theta_o are floored at cos(85 degrees), so the value is finite up to
        the horizon. The half vector comes from squared half-angle sines: exact at the mirror direction.
    """
    glass = material(name)
    theta_i, theta_o, phi_o = np.broadcast_arrays(*(np.asarray(a, float) for a in (theta_i, theta_o, phi_o)))
    cos_i, cos_o = (np.maximum(np.cos(theta), MIN_COS) for theta in (theta_i, theta_o))

    # w_i + w_o: its length is 2 cos(theta_d), its polar angle is theta_h
    from_mirror = np.sin((phi_o - MIRROR_AZIMUTH) / 2) ** 2
    tangential2 = (np.sin(theta_i) - np.sin(theta_o)) ** 2 + 4 * np.sin(theta_i) * np.sin(theta_o) * from_mirror
    normal = np.maximum(np.cos(theta_i), 0) + np.maximum(np.cos(theta_o), 0)
    cos_d = np.minimum(np.sqrt(tangential2 + normal**2) / 2, 1.0)
    theta_h = np.arctan2(np.sqrt(tangential2), normal)

    alpha2 = glass.alpha**2
    normal_density = alpha2 / (np.pi * (alpha2 * np.cos(theta_h) ** 2 + np.sin(theta_h) ** 2) ** 2)
    shadowing = 1 / (1 + _smith_lambda(cos_i, alpha2) + _smith_lambda(cos_o, alpha2))
    specular = normal_density * shadowing * fresnel(cos_d) / (4 * cos_i * cos_o)

    haze = 1 + 0.35 * np.exp(-((_angle(theta_i, MIRROR_AZIMUTH, theta_o, phi_o) / HAZE_WIDTH) ** 2))
    body = (1 - fresnel(cos_i)) * (1 - fresnel(cos_o)) * haze / np.pi
    return specular[..., None] + body[..., None] * body_spectrum(glass, wavelength_nm)


def body_spectrum(glass: AmberGlass, wavelength_nm: ArrayLike) -> Float[np.ndarray, " wavelength"]:
    """Return the albedo s(lambda) of the diffuse part: an amber edge at 552 nm, a dip beyond 715 nm."""
    wavelength_nm = np.atleast_1d(np.asarray(wavelength_nm, float))
    edge = _logistic((wavelength_nm - 552) / 17)
    return 0.02 + 0.28 * edge * (1 - glass.red_dip * _logistic((wavelength_nm - 715) / 16))


def fresnel(cos_theta: ArrayLike) -> Float[np.ndarray, "*shape"]:
    """Return the exact unpolarised Fresnel reflectance of a dielectric of index 1.52."""
    c = np.asarray(cos_theta, float)
    g = np.sqrt(REFRACTIVE_INDEX**2 - 1 + c**2)
    return np.asarray(0.5 * ((g - c) / (g + c)) ** 2 * (1 + ((c * (g + c) - 1) / (c * (g - c) + 1)) ** 2))


def measure(name: str, seed: int = 0, count: int | None = None, noise: float | int = 1.0) -> RawSamples:
    """Return a simulated measurement of an embedded material.

    Directions: a jittered lattice of about 8 degrees in theta_o and phi_o, plus one of about 3 degrees
    within 25 degrees of the mirror direction, up to theta_o = 85 degrees, without the 4 degrees round the
    incidence. They depend on `seed` and `count` alone, so the three materials share one geometry.
    value = f (1 + noise (0.010 u + 0.010 v)) + noise 2e-4 w / max(cos theta_i, cos 85 deg), with u one
    standard normal number per sample, v and w one per sample and wavelength. Negative values stay.

    Args:
        name: One of `MATERIALS`, with or without "builtin:".
        seed: Of directions and noise, 0 or more.
        count: Directions per incident angle, 20 to 100000; 770 if None.
        noise: Factor on the noise; 0 gives the truth.

    Returns:
        The samples [1/sr], incident angles in increasing order.

    Raises:
        UserError: a name or number out of its range.
    """
    material(name)
    count = DEFAULT_COUNT if count is None else count
    if seed < 0:
        raise UserError(f"seed: found {seed}, expected 0 or more")
    if not 20 <= count <= 100_000:
        raise UserError(f"count: found {count}, expected 20 to 100000 directions per incident angle")
    if not (np.isfinite(noise) and noise >= 0):
        raise UserError(f"noise: found {noise}, expected a factor of 0 or more")

    noise_rng = np.random.default_rng([seed, 1])
    theta_i, theta_o, phi_o = _directions(seed, count).copy()
    value = true_brdf(name, theta_i, theta_o, phi_o, WAVELENGTH_NM)
    per_sample = noise_rng.standard_normal((len(theta_i), 1))
    value = value * (1 + noise * 0.010 * (per_sample + noise_rng.standard_normal(value.shape)))
    offset = 2e-4 / np.maximum(np.cos(theta_i), MIN_COS)
    value = value + noise * offset[:, None] * noise_rng.standard_normal(value.shape)

    digest = hashlib.sha256()
    for array in (theta_i, theta_o, phi_o, WAVELENGTH_NM, value):
        digest.update(np.ascontiguousarray(array, "<f8").tobytes())
    return RawSamples(
        theta_i=theta_i,
        theta_o=theta_o,
        phi_o=phi_o,
        wavelength_nm=WAVELENGTH_NM.copy(),
        value=value,
        row=np.arange(len(theta_i)),
        quantity="brdf",
        source=PREFIX + name.removeprefix(PREFIX),
        source_format="builtin",
        source_sha256=digest.hexdigest(),
        notes=(f"simulated measurement, seed {seed}, noise factor {noise:g}",),
    )


@functools.lru_cache(maxsize=2)
def _directions(seed: int, count: int) -> Float[np.ndarray, "3 sample"]:
    """Return theta_i, theta_o and phi_o [rad] of a whole measurement; most of the time that one takes."""
    rng, parts = np.random.default_rng([seed, 0]), []
    for angle in np.radians(THETA_I_DEG):
        theta_o, phi_o = _jittered_directions(angle, count, rng)
        parts.append(np.stack([np.full(len(theta_o), angle), theta_o, phi_o]))
    return np.concatenate(parts, axis=1)


def _jittered_directions(theta_i: float, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return (theta_o, phi_o) [rad] of `count` directions for one incident angle."""
    # one factor on both steps makes up for what the horizon cuts off the fine lattice; the coarsest
    # lattice that has enough is thinned to the count, so that every incident angle has as many
    factor = np.sqrt(DEFAULT_COUNT / count)
    for _ in range(3):
        factor *= np.sqrt(len(_lattice(theta_i, factor, None)[0]) / count)
    factor *= 1.02
    theta_o, phi_o = _lattice(theta_i, factor, rng)
    while len(theta_o) < count:
        factor *= 0.995
        theta_o, phi_o = _lattice(theta_i, factor, rng)
    keep = np.sort(rng.choice(len(theta_o), count, replace=False))
    return theta_o[keep], phi_o[keep]


def _lattice(theta_i: float, factor: float, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions of both lattices with their steps times `factor`, jittered if there is an `rng`."""

    def jitter(shape):
        return 0.0 if rng is None else rng.uniform(-JITTER, JITTER, shape)

    rows = max(2, round(MAX_THETA_O / (COARSE_STEP * factor)))
    columns = max(4, round(2 * np.pi / (COARSE_STEP * factor)))
    row, column = np.meshgrid(np.arange(rows) + 0.5, np.arange(columns) + 0.5, indexing="ij")
    coarse_theta = (row + jitter(row.shape)) * (MAX_THETA_O / rows)
    coarse_phi = (column + row % 2 / 2 + jitter(row.shape)) * (2 * np.pi / columns)

    # hexagonal, in the plane (distance, bearing) round the mirror direction
    step = FINE_STEP * factor
    reach = int(np.ceil(FINE_RADIUS / (step * 0.86))) + 1
    row, column = np.meshgrid(np.arange(-reach, reach + 1.0), np.arange(-reach, reach + 1.0), indexing="ij")
    x = (column + row % 2 / 2 + 0.25 + jitter(row.shape)) * step
    y = (row + 0.25 + jitter(row.shape)) * step * np.sqrt(0.75)
    fine_theta, fine_phi = _around(theta_i, np.hypot(x, y), np.arctan2(y, x))
    near = np.hypot(x, y) <= FINE_RADIUS

    theta_o = np.concatenate([coarse_theta.ravel(), fine_theta[near]])
    phi_o = wrap_azimuth(np.concatenate([coarse_phi.ravel(), fine_phi[near]]))
    seen = (theta_o <= MAX_THETA_O) & (_angle(theta_i, 0.0, theta_o, phi_o) >= BLOCKED_RADIUS)
    return theta_o[seen], phi_o[seen]


def _around(theta_m, distance, bearing):
    """Directions at `distance` and `bearing` from the direction (theta_m, MIRROR_AZIMUTH) [rad]."""
    along = np.sin(distance) * np.cos(bearing)
    height = np.cos(distance) * np.cos(theta_m) - along * np.sin(theta_m)
    outward = np.cos(distance) * np.sin(theta_m) + along * np.cos(theta_m)
    across = np.sin(distance) * np.sin(bearing)
    return np.arctan2(np.hypot(outward, across), height), np.arctan2(across, outward) + MIRROR_AZIMUTH


def _angle(theta_a, phi_a, theta_b, phi_b):
    """Angle between two directions [rad]; the NumPy twin of `angles.angle_between`."""
    half = np.sin((theta_a - theta_b) / 2) ** 2
    half = half + np.sin(theta_a) * np.sin(theta_b) * np.sin((phi_a - phi_b) / 2) ** 2
    return 2 * np.arctan2(np.sqrt(np.clip(half, 0, 1)), np.sqrt(np.clip(1 - half, 0, 1)))


def _smith_lambda(cos_theta, alpha2):
    """Smith's Lambda for GGX: (sqrt(1 + alpha^2 tan^2 theta) - 1) / 2."""
    return (np.sqrt(1 + alpha2 * (1 - cos_theta**2) / cos_theta**2) - 1) / 2


def _logistic(x):
    return 1 / (1 + np.exp(-x))
