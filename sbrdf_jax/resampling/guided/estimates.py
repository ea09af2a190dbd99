"""What a whole measurement says before any wavelength is solved: floor, lobe model, smoothness, trust, error scale.

It is the same whatever a scene needs of the measurement, and is kept for its next scene.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from sbrdf_jax.angles import fold_azimuth
from sbrdf_jax.records import RawSamples
from sbrdf_jax.resampling.guided.centres import Centres
from sbrdf_jax.resampling.guided.coordinates import from_log, guided_coordinates, log_scale, slope, to_log
from sbrdf_jax.resampling.guided.error_model import (
    ResidualScale,
    estimate_floor,
    estimate_mirror_deviation,
    fit_between_scale,
    fit_residual_scale,
    noise_factors,
    residual_scale,
    spread_rows,
)
from sbrdf_jax.resampling.guided.field import GuidedField
from sbrdf_jax.resampling.guided.inverse import Whitener, doubted, group_blocks, leave_group_out, mirror_lower
from sbrdf_jax.resampling.guided.lobe_fit import density_weights, fit_amplitudes, fit_lobe_model
from sbrdf_jax.resampling.guided.lobe_model import LobeModel, lobe_log_value, mirror_share
from sbrdf_jax.resampling.guided.nodes import ModeVariance
from sbrdf_jax.resampling.guided.smoothing import choose_smoothing
from sbrdf_jax.resampling.guided.spectrum import SpectralFilter, spectral_filter

CALIBRATION_GROUPS = 5
TINY = 1e-12  # variance relative to the prior's


class Estimates(NamedTuple):
    """Estimates from all wavelengths, and the linear problem that they leave for each."""

    wavelength_nm: np.ndarray  # [wavelength] all that hold a positive value and are finite
    floor: float  # 1/sr
    lobe: LobeModel
    model_residual: Any  # [wavelength] relative gradient norm of the lobe model's fit
    variance: ModeVariance
    noise_level: float  # variance of z of one sample, relative to the prior's
    factor: np.ndarray  # [centre] noise variance relative to the neighbours'
    noise: np.ndarray  # [centre] variance of z relative to the prior's
    curve: tuple[tuple[float, float], ...]
    reciprocity_cost: float
    spectral_filter: SpectralFilter
    scale: ResidualScale
    whiten: Whitener  # of prior plus noise
    inverse: np.ndarray  # [centre, centre] of prior plus noise
    residual: np.ndarray  # [centre, wavelength] filtered z minus the lobe model's
    model: np.ndarray  # [centre, wavelength] z of the lobe model
    node_variance: dict[bytes, np.ndarray]  # of the nodes that were asked for, by grid: the same at every wavelength


def live_wavelengths(samples: RawSamples) -> np.ndarray:
    """Mask of the wavelengths that are finite and hold a positive value."""
    return np.isfinite(samples.value).all(axis=0) & (samples.value > 0).any(axis=0)


def live_part(samples: RawSamples) -> RawSamples:
    """Return the samples at the wavelengths that can be estimated and solved."""
    live = live_wavelengths(samples)
    return dataclasses.replace(samples, wavelength_nm=samples.wavelength_nm[live], value=samples.value[:, live])


def estimate(
    samples: RawSamples, weight: float | None, centres: Centres, report: Callable[[str], None] | None = None
) -> Estimates:
    """Estimate all that depends on the whole measurement.

    Args:
        samples: Measurement of a bilateral material; every value is finite, every wavelength has a positive one.
        weight: Noise variance of z relative to the prior's; None: chosen by left-out errors.
        centres: Where the samples are.
        report: Told of each step.
    """
    say = report or (lambda _: None)
    seen = centres.number > 0
    floor = estimate_floor(samples.theta_i, samples.theta_o, fold_azimuth(samples.phi_o), samples.value)
    z_sample, at_samples = _sample_logarithm(samples, floor, centres)
    z = centres.mean(z_sample)

    say("lobe model")
    half = centres.at.half
    density = np.zeros(centres.count)
    density[seen] = density_weights(half[seen])
    lobe, model_residual = fit_lobe_model(centres.mean(np.maximum(samples.value, 0.0)), z, centres.at, density, floor)
    residual, model = _split(centres, z_sample, at_samples, lobe, floor)

    say("smoothness")
    choice = choose_smoothing(centres, residual, weight)
    factor = np.ones(centres.count)
    factor[seen] = noise_factors(half[seen], *centres.angles[:2, seen], choice.left_out[seen])
    spectra = spectral_filter((model + residual)[seen], choice.left_out[seen])
    if spectra.to_component.size:  # the amplitudes have noise of single wavelengths too
        filtered = spectra(model + residual)
        value = from_log(filtered, log_scale(centres.at, floor))
        lobe, model_residual = fit_amplitudes(lobe.shape, value, filtered, centres.at, density, floor)
        residual, model = _split(centres, z_sample, at_samples, lobe, floor)
    residual = _filtered(spectra, residual, model)
    noise, whiten, lower = _invert(centres, choice.variance, choice.noise, factor)
    inverse = mirror_lower(lower)

    say("error scale")
    dual = inverse @ residual
    out, variance = _left_out_fifths(seen, lower, dual)
    # a centre's own extra noise, or what averaging took from it, is not that of a new measurement
    spread = np.maximum(variance - noise, 0.0) + choice.noise
    scale = _calibrate(centres, samples, model + residual - out, spread, floor)
    share = mirror_share(lobe, centres.at, floor).mean(axis=1)
    deviation = estimate_mirror_deviation(share[seen], np.sqrt((out[seen] ** 2).mean(axis=1)))
    scale = dataclasses.replace(scale, mirror=np.array(deviation))
    out, variance = leave_group_out(group_blocks(lower, centres.group), dual)
    unsure = np.maximum(variance - noise, 0.0)
    scale = _calibrate_between(scale, centres, samples, model + residual - out, unsure, choice.noise, floor)
    return Estimates(
        wavelength_nm=samples.wavelength_nm,
        floor=floor,
        lobe=lobe,
        model_residual=model_residual,
        variance=choice.variance,
        noise_level=choice.noise,
        factor=factor,
        noise=noise,
        curve=choice.curve,
        reciprocity_cost=choice.reciprocity_cost,
        spectral_filter=spectra,
        scale=scale,
        whiten=whiten,
        inverse=inverse,
        residual=residual,
        model=model,
        node_variance={},
    )


def _sample_logarithm(samples: RawSamples, floor: float, centres: Centres):
    """Return the generalised logarithm of the samples [sample, wavelength], and their coordinates."""
    at = guided_coordinates(samples.theta_i, samples.theta_o, samples.phi_o, centres.theta_limit)
    return to_log(samples.value, log_scale(at, floor)), at


def _split(centres: Centres, z_sample: np.ndarray, at_samples, lobe: LobeModel, floor: float):
    """Return what the lobe model leaves at the centres, and what it says there [centre, wavelength]."""
    residual = centres.mean(z_sample - lobe_log_value(lobe, at_samples, floor))
    seen = (centres.number > 0)[:, None]
    return residual, np.where(seen, lobe_log_value(lobe, centres.at, floor), 0.0)


def _filtered(spectra: SpectralFilter, residual: np.ndarray, model: np.ndarray) -> np.ndarray:
    """What the lobe model leaves of the filtered logarithms; both are 0 at centres without samples."""
    return spectra(model + residual) - model


def _invert(centres: Centres, variance: ModeVariance, level: float, factor: np.ndarray):
    """Return the noise [centre], the whitener of prior plus noise, and the lower triangle of its inverse."""
    whiten, lower, _ = centres.inverse(variance, level)
    alike = centres.noise(level)
    doubt, lower = doubted(lower, alike * (factor - 1))
    return alike * factor, Whitener(whiten, doubt), lower


def _left_out_fifths(seen: np.ndarray, lower: np.ndarray, dual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact residuals of leaving random fifths out, and their variances."""
    group = np.random.default_rng(0).permutation(len(seen)) % CALIBRATION_GROUPS
    return leave_group_out(group_blocks(lower, np.where(seen, group, -1)), dual)


def _calibrate(centres: Centres, samples: RawSamples, predicted, spread, floor: float) -> ResidualScale:
    """Calibrate the error scale by how far samples lie from predictions that did not see them."""
    centre, z, error = _errors_of_predictions(centres, samples, predicted, floor)
    standardised = error / np.sqrt(spread[centre])[:, None]
    return fit_residual_scale(centres.angles[0, centre], centres.at.half[centre], z, standardised)


def _calibrate_between(
    scale: ResidualScale, centres: Centres, samples: RawSamples, predicted, unsure, noise: float, floor: float
) -> ResidualScale:
    """Calibrate it between incident angles too, by predictions that did not see a sample's incident angle.

    They are held against the scale that would be known there without it: that of the angles beside.
    """
    centre, z, error = _errors_of_predictions(centres, samples, predicted, floor)
    theta_i, half, group = centres.angles[0, centre], centres.at.half[centre], centres.group[centre]
    members = [group == number for number in np.unique(group)]
    members.sort(key=lambda rows: np.median(theta_i[rows]))
    angles = [float(np.median(theta_i[rows])) for rows in members]
    ratios = []
    for number, rows in enumerate(members):
        beside = [angles[k] for k in (number - 1, number + 1) if 0 <= k < len(angles)] or angles
        local = [residual_scale(scale, np.full(rows.sum(), angle), half[rows], z[rows]) for angle in beside]
        squares = error[rows] ** 2 / (local[0] * local[-1]) - noise
        ratios.append((np.maximum(squares, 0.0) / np.maximum(unsure[centre[rows]], TINY)[:, None]).ravel())
    return dataclasses.replace(scale, **fit_between_scale(np.array(angles), ratios))


def _errors_of_predictions(centres: Centres, samples: RawSamples, predicted, floor: float):
    """Return the centre of some rows, what is predicted there in z, and how far they lie from it in z."""
    rows = spread_rows(samples.num_samples)
    centre = centres.index[rows]
    z = predicted[centre]
    scale = log_scale(centres.at, floor)[centre]
    return centre, z, (np.maximum(samples.value[rows], 0.0) - from_log(z, scale)) / slope(z, scale)


def restore_estimates(field: GuidedField, samples: RawSamples, centres: Centres) -> Estimates:
    """Return the estimates that a stored field was solved from, at the cost of one factorisation.

    Args:
        field: Of an earlier run on the same samples, at whatever wavelengths.
        samples: As for `estimate`: `live_part` of them.
        centres: Where the samples are.
    """
    floor = float(field.floor)
    field = jax.tree.map(np.asarray, field)
    lobe = dataclasses.replace(field.lobe, log_amplitude=field.measured.log_amplitude)
    residual, model = _split(centres, *_sample_logarithm(samples, floor, centres), lobe, floor)
    spectra = SpectralFilter(field.measured.to_component, field.measured.from_component)
    residual = _filtered(spectra, residual, model)
    level, factor = float(field.noise_level), field.noise_factor.reshape(-1)
    noise, whiten, lower = _invert(centres, field.variance, level, factor)
    return Estimates(
        wavelength_nm=field.measured.wavelength_nm,
        floor=floor,
        lobe=lobe,
        model_residual=field.measured.model_residual,
        variance=field.variance,
        noise_level=level,
        factor=factor,
        noise=noise,
        curve=tuple(map(tuple, field.curve.T)),
        reciprocity_cost=float(field.reciprocity_cost),
        spectral_filter=spectra,
        scale=field.scale,
        whiten=whiten,
        inverse=mirror_lower(lower),
        residual=residual,
        model=model,
        node_variance={},
    )
