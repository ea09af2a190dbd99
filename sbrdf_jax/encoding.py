"""Spectrum <-> coefficients: eqs. (11) and (12), their even extension, and the samples themselves."""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sbrdf_jax.array_module import AnyArray, array_module
from sbrdf_jax.host_blas import one_blas_thread
from sbrdf_jax.interpolation import spectral_weights
from sbrdf_jax.options import DEFAULT_VECTORS, VECTOR_KINDS
from sbrdf_jax.records import GriddedBRDF, SpectralBasis, SpectralField

BASIS_KINDS = ("fourier", "cosine", *VECTOR_KINDS, "identity")
FEWEST_WAVELENGTHS = 5  # below it a series says less than the samples
LARGEST = 80.0  # logarithm; what nobody needed may be anything, and is finite in float32 too
SMALLEST = 1e-9  # of the largest value; logarithms of less are not taken
UNIFORM_TOLERANCE = 1e-6  # of the step; wavelengths closer to uniform are taken as uniform


class AllowedBasis(NamedTuple):
    """What a number of wavelengths can carry; `warning` is None where that is what was wanted."""

    kind: str
    coefficients: int
    warning: str | None


def coefficients_allowed(num_wavelengths: int, wanted: int, kind: str = "fourier") -> AllowedBasis:
    """Return the basis and the number of real coefficients that so many wavelengths can carry.

    n samples carry at most n - 1 coefficients, the largest odd number: a_0 and pairs of cosine
    and sine below the Nyquist harmonic. Below `FEWEST_WAVELENGTHS` the samples stand for themselves.

    Args:
        num_wavelengths: Samples per spectrum.
        wanted: Coefficients asked for; ignored by "identity".
        kind: One of `BASIS_KINDS`.

    Returns:
        The kind and count to use, and a sentence where they are not what was asked for.

    Raises:
        ValueError: `kind` is unknown or `wanted` below 1.
    """
    if kind not in BASIS_KINDS:
        raise ValueError(f"basis {kind!r}: expected one of {', '.join(BASIS_KINDS)}")
    if kind == "identity":
        return AllowedBasis("identity", num_wavelengths, None)
    if wanted < 1:
        raise ValueError(f"coefficients: found {wanted}, expected 1 or more")
    if num_wavelengths < FEWEST_WAVELENGTHS:
        text = f"{num_wavelengths} wavelengths are too few for a series: the samples themselves are stored"
        return AllowedBasis("identity", num_wavelengths, text)
    if kind in VECTOR_KINDS:
        used = min(wanted, num_wavelengths)
        text = f"{used} spectral coefficients in place of {wanted}: there are no more wavelengths"
        return AllowedBasis(kind, used, text if used < wanted and wanted != DEFAULT_VECTORS else None)
    most = num_wavelengths - 1 - num_wavelengths % 2  # the largest odd number up to n - 1
    used = min(wanted, most)
    if kind == "fourier" and used % 2 == 0:  # a cosine without its sine has no place in eq. (11)
        used -= 1
    if used == wanted:
        return AllowedBasis(kind, used, None)
    why = f"{num_wavelengths} wavelengths carry at most {most}" if wanted > most else "their number is odd in eq. (11)"
    return AllowedBasis(kind, used, f"{used} spectral coefficients in place of {wanted}: {why}")


def make_basis(wavelength_nm: Float[np.ndarray, " wavelength"], kind: str, coefficients: int) -> SpectralBasis:
    """Return the spectral basis of measured wavelengths, on the host.

    Args:
        wavelength_nm: Measured wavelengths [nm], increasing; both ends belong to the domain.
        kind: One of `BASIS_KINDS` but those of `VECTOR_KINDS`, which `data_basis` makes.
        coefficients: Coefficients wanted; `coefficients_allowed` says how many are used, and why.

    Returns:
        The basis, with the trapezoid rule of eq. (12) as the matrix `analysis`. Of unevenly spaced wavelengths, where
        that rule does not even keep a constant, it is least squares of eq. (11) at the wavelengths.

    Raises:
        ValueError: wavelengths that do not increase, or what `coefficients_allowed` refuses.
    """
    wavelength_nm = np.asarray(wavelength_nm, np.float64)
    step = np.diff(wavelength_nm)
    if wavelength_nm.size == 0 or not np.all(step > 0):
        raise ValueError("wavelength_nm: expected one wavelength or more, increasing")
    kind, count, _ = coefficients_allowed(wavelength_nm.size, coefficients, kind)
    if kind in VECTOR_KINDS:
        raise ValueError(f'basis "{kind}": it follows from a material, by data_basis')
    if kind == "identity":
        return SpectralBasis(wavelength_nm, np.eye(count), np.eye(count), kind, uniform=False)
    synthesis = _series(_position(wavelength_nm, wavelength_nm), kind, count, np)
    uniform = bool(np.ptp(step) <= UNIFORM_TOLERANCE * step.mean())
    if not uniform:
        return SpectralBasis(wavelength_nm, np.linalg.pinv(synthesis), synthesis, kind, uniform=False)
    weight = np.convolve(step, [0.5, 0.5]) * 2 / (wavelength_nm[-1] - wavelength_nm[0])
    analysis = weight[:, None] * synthesis.T
    analysis[:, 0] *= 2  # the half of a_0 belongs to the synthesis
    return SpectralBasis(wavelength_nm, analysis, synthesis, kind, uniform=True)


def data_basis(
    wavelength_nm: Float[np.ndarray, " wavelength"],
    brdf: Float[np.ndarray, "theta_i *direction wavelength"],
    coefficients: int,
    kind: str = "data",
) -> SpectralBasis:
    """Return the leading orthonormal spectra of a material, by singular values, on the host.

    Every incident angle is first scaled to unit energy: unscaled, only grazing ones are served.

    Args:
        wavelength_nm: Measured wavelengths [nm], increasing.
        brdf: Spectra [1/sr]; incident angles that are not finite or zero throughout do not count.
        coefficients: Vectors wanted; at most as many as wavelengths.
        kind: "data", or "log_data" for the spectra of logarithms, each weighing what it does without.

    Numerics:
        The sign of each vector is that of its sum, so that equal input gives equal vectors.
    """
    spectra = np.asarray(brdf, np.float64).reshape(len(brdf), -1, len(wavelength_nm))
    energy = np.einsum("idw,idw->i", spectra, spectra)
    counts = np.isfinite(energy) & (energy > 0)
    scaled = spectra[counts] / np.sqrt(energy[counts])[:, None, None]
    if kind == "log_data":
        scaled = np.linalg.norm(scaled, axis=2, keepdims=True) * logarithm(spectra[counts])
    vectors = spectral_vectors(scaled.reshape(-1, len(wavelength_nm)))[:coefficients]
    return vector_basis(wavelength_nm, vectors, kind)


def logarithm(brdf: Float[AnyArray, "*shape wavelength"]) -> Float[AnyArray, "*shape wavelength"]:
    """Return the logarithm of spectra [log(1/sr)], of nothing less than `SMALLEST` of the largest finite value."""
    xp = array_module(brdf)
    largest = xp.max(xp.where(xp.isfinite(brdf), brdf, 0.0), initial=1e-290)
    return xp.log(xp.maximum(brdf, SMALLEST * largest))


def spectral_vectors(spectra: Float[np.ndarray, "row wavelength"]) -> Float[np.ndarray, "vector wavelength"]:
    """Return all right singular vectors of spectra, the most important first."""
    with one_blas_thread():
        vectors = np.linalg.eigh(spectra.T @ spectra)[1][:, ::-1].T
    return vectors * np.where(vectors.sum(axis=1, keepdims=True) < 0, -1.0, 1.0)


def transform(brdf: Float[AnyArray, "*shape wavelength"], basis: SpectralBasis) -> Float[AnyArray, "*shape wavelength"]:
    """Return what the functions of a basis add up to: spectra [1/sr], or their logarithm."""
    return logarithm(brdf) if basis.is_logarithmic else brdf


def restore(value: Float[AnyArray, "*shape wavelength"], basis: SpectralBasis) -> Float[AnyArray, "*shape wavelength"]:
    """Return spectra [1/sr] from what the functions of a basis add up to; of a logarithm at most exp of `LARGEST`."""
    xp = array_module(value)
    return xp.exp(xp.minimum(value, LARGEST)) if basis.is_logarithmic else value


def vector_basis(
    wavelength_nm: Float[np.ndarray, " wavelength"],
    vectors: Float[np.ndarray, "coefficient wavelength"],
    kind: str = "data",
) -> SpectralBasis:
    """Return the basis "data" or "log_data" of orthonormal vectors."""
    return SpectralBasis(np.asarray(wavelength_nm, np.float64), np.array(vectors.T), np.array(vectors), kind)


def coefficient_names(basis: SpectralBasis) -> tuple[str, ...]:
    """Return the name of each coefficient: a_0, a_1, b_1, ... of eq. (11), c_0, ..., v_0, ... or the wavelengths."""
    count = np.shape(basis.synthesis)[0]
    if basis.kind == "fourier":
        return tuple(f"{'ab'[k > 0 and k % 2 == 0]}_{(k + 1) // 2}" for k in range(count))
    if basis.kind == "cosine":
        return tuple(f"c_{k}" for k in range(count))
    if basis.stores_vectors:
        return tuple(f"v_{k}" for k in range(count))
    return tuple(f"{wavelength:g}nm" for wavelength in np.asarray(basis.wavelength_nm))


@functools.partial(jax.jit, static_argnames="coefficients")
def encode_fft(
    spectrum: Float[Array | np.ndarray, "*shape wavelength"], coefficients: int
) -> Float[Array, "*shape coefficient"]:
    """Encode uniformly spaced spectra by eq. (12), its trapezoid rule taken as an FFT.

    The two ends are one point of the period: the FFT runs over the N - 1 samples whose first
    is the mean of both ends.

    Args:
        spectrum: Values [1/sr] at uniformly spaced wavelengths, both ends included.
        coefficients: Odd number of coefficients a_0, a_1, b_1, ..., at most N - 1.

    Returns:
        Coefficients [1/sr]; the spectrum is a_0 / 2 + sum of a_k cos + b_k sin.

    Raises:
        ValueError: an even or too large `coefficients` (raised while tracing).
    """
    period = spectrum.shape[-1] - 1
    if coefficients % 2 == 0 or coefficients > period:
        raise ValueError(f"coefficients: found {coefficients}, expected an odd number up to {period}")
    ends = (spectrum[..., :1] + spectrum[..., -1:]) / 2
    harmonic = jnp.fft.rfft(jnp.concatenate([ends, spectrum[..., 1:-1]], axis=-1), axis=-1)
    harmonic = harmonic[..., : coefficients // 2 + 1] * (2 / period)
    pairs = jnp.stack([harmonic.real, -harmonic.imag], axis=-1)
    flat = pairs.reshape(*pairs.shape[:-2], -1)  # a_0, b_0 = 0, a_1, b_1, ...
    return jnp.concatenate([flat[..., :1], flat[..., 2:]], axis=-1)


def encode(
    spectrum: Float[AnyArray, "*shape wavelength"], basis: SpectralBasis
) -> Float[AnyArray, "*shape coefficient"]:
    """Return the coefficients of spectra in a basis, eq. (12).

    Args:
        spectrum: Values [1/sr] at the basis' own wavelengths.
        basis: From `make_basis`.

    Returns:
        Coefficients [1/sr], in the order of `coefficient_names`; of basis "log_data" those of the logarithm.

    Numerics:
        Where wavelengths are uniform by an FFT, else by least squares as a matrix. A
        NaN spoils the coefficients of its own spectrum only.
    """
    spectrum = transform(spectrum, basis)
    if not basis.uniform:
        xp = array_module(spectrum, basis.analysis)
        return xp.matmul(spectrum, xp.asarray(basis.analysis, spectrum.dtype))
    return _encode_series(spectrum, basis)


@jax.jit
def _encode_series(
    spectrum: Float[Array | np.ndarray, "*shape wavelength"], basis: SpectralBasis
) -> Float[Array, "*shape coefficient"]:
    """`encode` at uniform wavelengths."""
    count = basis.analysis.shape[1]
    if basis.kind == "fourier":
        return encode_fft(spectrum, count)
    # a cosine series is the Fourier series of the even extension: no jump at the ends, no sines
    mirrored = jnp.concatenate([spectrum, spectrum[..., -2::-1]], axis=-1)
    pairs = encode_fft(mirrored, 2 * count - 1)
    return jnp.concatenate([pairs[..., :1], pairs[..., 1::2]], axis=-1)


def decode(
    coefficient: Float[AnyArray, "*shape coefficient"],
    basis: SpectralBasis,
    wavelength_nm: Float[AnyArray, " wanted"] | None = None,
) -> Float[AnyArray, "*shape wavelength"]:
    """Return spectra from their coefficients, eq. (11).

    Args:
        coefficient: Coefficients [1/sr] in the order of `coefficient_names`.
        basis: From `make_basis`.
        wavelength_nm: Where [nm]; the measured wavelengths if None. Inside the measured range.

    Returns:
        Values [1/sr]; a truncated series may be negative, and ends with the value it starts with. Of basis
        "log_data" they are positive.

    Numerics:
        Between measured wavelengths a series is itself; samples ("identity") are joined by
        straight lines, which cannot undershoot, vectors by C1 cubics. Beyond the range
        a series repeats or mirrors itself.
    """
    synthesis = basis.synthesis if wavelength_nm is None else _functions_at(wavelength_nm, basis)
    xp = array_module(coefficient, synthesis)
    return restore(xp.matmul(coefficient, xp.asarray(synthesis, coefficient.dtype)), basis)


def encode_field(gridded: GriddedBRDF, basis: SpectralBasis) -> SpectralField:
    """Return the coefficients at every node of the grid; between incident angles only where their step is uniform."""
    steps = np.diff(np.asarray(gridded.theta_i))
    uniform = len(steps) > 0 and bool(np.ptp(steps) <= 1e-9)
    return SpectralField(
        gridded.theta_i,
        gridded.theta_o,
        gridded.phi_o,
        encode(gridded.brdf, basis),
        basis,
        window=gridded.window,
        interpolate_theta_i=gridded.interpolate_theta_i and uniform,
    )


def mean_spectrum(
    coefficient: Float[Array | np.ndarray, "*shape coefficient"], basis: SpectralBasis
) -> Float[Array | np.ndarray, "*shape"]:
    """Return the mean of spectra over the wavelengths [1/sr]: half of the first coefficient of a series."""
    if basis.kind == "identity":
        return coefficient.mean(axis=-1)
    if basis.kind == "data":
        return coefficient @ basis.synthesis.mean(axis=1)
    return coefficient[..., 0] / 2


def _position(wavelength_nm, measured_nm):
    """Return wavelengths as positions from 0 to 1 over the measured range."""
    return (wavelength_nm - measured_nm[0]) / (measured_nm[-1] - measured_nm[0])


def _series(position, kind, count, xp):
    """Return the functions of eq. (11) [coefficient, wavelength] at positions from 0 to 1, by NumPy or JAX as `xp`."""
    waves = [0.5 + 0 * position]
    if kind == "cosine":
        waves += [xp.cos(math.pi * k * position) for k in range(1, count)]
    else:
        for k in range(1, count // 2 + 1):
            waves += [xp.cos(2 * math.pi * k * position), xp.sin(2 * math.pi * k * position)]
    return xp.stack(waves)


def _functions_at(wavelength_nm, basis):
    """Return the basis' functions at wavelengths, as `synthesis` holds them at the measured ones."""
    xp = array_module(wavelength_nm, basis.wavelength_nm, basis.synthesis)
    measured, count = xp.asarray(basis.wavelength_nm, wavelength_nm.dtype), basis.synthesis.shape[0]
    if basis.stores_vectors:
        weights = spectral_weights(wavelength_nm, measured)
        return xp.matmul(xp.asarray(basis.synthesis, weights.dtype), weights.T)
    if basis.kind != "identity":
        return _series(_position(wavelength_nm, measured), basis.kind, count, xp)
    if count == 1:
        return xp.ones((1, *wavelength_nm.shape), wavelength_nm.dtype)
    # node j's hat is the interpolation of the j-th row of the identity
    return xp.stack([xp.interp(wavelength_nm, measured, row) for row in np.eye(count, dtype=wavelength_nm.dtype)])
