"""Samples to field: floor, lobe model, smoothness, weights, dual coefficients, error scale, in this order."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sbrdf_jax.angles import fold_azimuth
from sbrdf_jax.coverage import cluster_incidences
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.records import RawSamples
from sbrdf_jax.resampling.guided.coordinates import EXTRAPOLATION, Coordinates, guided_coordinates, to_log
from sbrdf_jax.resampling.guided.error_model import (
    COVERED,
    ResidualScale,
    estimate_floor,
    fit_residual_scale,
    noise_factors,
    residual_scale,
)
from sbrdf_jax.resampling.guided.field import GuidedField
from sbrdf_jax.resampling.guided.kernel import factorise, invert, leave_one_out, solve_dual
from sbrdf_jax.resampling.guided.lobe_model import density_weights, fit_lobe_model, lobe_log_value
from sbrdf_jax.resampling.guided.merging import merge_samples
from sbrdf_jax.resampling.guided.smoothing import (
    PADDING_NOISE,
    BetweenChoice,
    Choice,
    choose_between,
    choose_smoothing,
    leave_group_out,
)

BUCKET = 128  # centres are padded to a multiple, so that folds of one size class compile once
MAX_CHOICE_CENTRES = 1500  # smoothness is chosen on so many centres
CALIBRATION_GROUPS = 5
MIN_GROUP = 8  # centres per incident angle, for leave-one-incident-angle-out
STEEPEST = np.deg2rad(85.0)


class GuidedReport(NamedTuple):
    """What the fit found, for the result file and the log."""

    floor: float  # 1/sr
    kernel: str
    between_kernel: str  # "" where incident angles are too few, too scattered or too sparse
    noise: float  # variance relative to the kernel's half-angle term
    curve: tuple[tuple[str, float, float], ...]  # kernel, noise, score
    noise_factor: np.ndarray  # [sample] 1, or larger for samples that lost weight
    num_centres: int
    residual_norm: np.ndarray  # [wavelength] relative residual of the linear system


class _Centres(NamedTuple):
    """Merged samples, padded to a bucket."""

    theta_i: np.ndarray  # [centre] rad
    theta_o: np.ndarray
    azimuth: np.ndarray
    at: Coordinates
    z: np.ndarray  # [centre, wavelength]
    value: np.ndarray  # [centre, wavelength] 1/sr
    count: np.ndarray  # [centre] samples each stands for
    padding: np.ndarray  # [centre] bool
    index: np.ndarray  # [sample] its centre

    @property
    def num(self) -> int:
        """Centres that are none of the padding; they come first."""
        return int((~self.padding).sum())


def _pad(x: np.ndarray, size: int, value: float = 0.0) -> np.ndarray:
    return np.concatenate([x, np.full((size - len(x), *x.shape[1:]), value, dtype=x.dtype)])


def _bucket(count: int) -> int:
    return -(-count // BUCKET) * BUCKET


def _merge(samples: RawSamples, floor: float, limit: jax.Array) -> _Centres:
    angles = samples.theta_i, samples.theta_o, fold_azimuth(samples.phi_o)
    raw = guided_coordinates(*[jnp.asarray(x) for x in angles], limit)
    merged = merge_samples(*angles, np.asarray(raw.half))
    size = _bucket(len(merged.count))
    theta_i, theta_o, azimuth = [_pad(merged.mean(x), size, 0.5) for x in angles]
    z = np.asarray(to_log(jnp.asarray(samples.value), jnp.asarray(samples.theta_i), jnp.asarray(floor)))
    return _Centres(
        theta_i=theta_i,
        theta_o=theta_o,
        azimuth=azimuth,
        at=guided_coordinates(jnp.asarray(theta_i), jnp.asarray(theta_o), jnp.asarray(azimuth), limit),
        z=_pad(merged.mean(z), size),
        value=_pad(merged.mean(np.maximum(samples.value, 0.0)), size),
        count=_pad(merged.count.astype(float), size, 1.0),
        padding=np.arange(size) >= len(merged.count),
        index=merged.index,
    )


def _choose(centres: _Centres, residual: np.ndarray, fixed: float | None) -> Choice:
    """Choose the smoothness on all centres, or on a random part of a long measurement."""
    if centres.num <= MAX_CHOICE_CENTRES:
        return choose_smoothing(centres.at, residual, centres.count, centres.padding, fixed)
    some = np.sort(np.random.default_rng(0).choice(centres.num, MAX_CHOICE_CENTRES, replace=False))
    rows = np.concatenate([some, np.zeros(_bucket(MAX_CHOICE_CENTRES) - MAX_CHOICE_CENTRES, int)])
    padding = np.arange(len(rows)) >= MAX_CHOICE_CENTRES
    part = np.where(padding[:, None], 0.0, residual[rows])
    return choose_smoothing(jax.tree.map(lambda x: x[rows], centres.at), part, centres.count[rows], padding, fixed)


def _weigh(centres: _Centres, residual: np.ndarray, choice: Choice) -> np.ndarray:
    """Factors [centre] on the noise variance: more than 1 for samples that their neighbours contradict."""
    noise = np.where(centres.padding, PADDING_NOISE, choice.noise / centres.count)
    factor = factorise(choice.kernel, centres.at, jnp.asarray(noise))
    out, _ = leave_one_out(factor, solve_dual(factor, jnp.asarray(residual)))
    num = centres.num
    factors = np.ones(len(noise))
    places = np.asarray(centres.at.half)[:num], centres.theta_i[:num], centres.theta_o[:num]
    factors[:num] = noise_factors(*places, np.asarray(out)[:num])
    return factors


def _scale(centres: _Centres, factor: jax.Array, dual: jax.Array, noise: np.ndarray, level: float) -> ResidualScale:
    """Calibrate the error scale by residuals of leaving a random fifth out, exact in closed form."""
    num = centres.num
    group = np.where(centres.padding, -1, np.random.default_rng(0).permutation(len(noise)) % CALIBRATION_GROUPS)
    out, variance = leave_group_out(np.asarray(invert(factor)), np.asarray(dual), group)
    # a sample's own extra noise, or what averaging took from it, is not that of a new measurement
    plain = np.maximum((variance - noise)[:num] + level, level)
    standardised = out[:num] / np.sqrt(plain)[:, None]
    half = np.asarray(centres.at.half)[:num]
    return fit_residual_scale(centres.theta_i[:num], half, (centres.z - out)[:num], standardised)


def _between_scale(centres: _Centres, scale: ResidualScale, between: BetweenChoice, group: np.ndarray) -> float:
    """How much larger residuals are between incident angles than their deviations at the calibrated scale."""
    inside = np.flatnonzero(group >= 0)
    z = jnp.asarray((centres.z - between.residual)[inside])
    local = np.asarray(residual_scale(scale, centres.at.theta_i[inside], centres.at.half[inside], z))
    ratio = np.abs(between.residual[inside]) / (np.sqrt(between.variance[inside])[:, None] * local)
    return float(np.quantile(ratio, COVERED))


def fit_guided(samples: RawSamples, options: ResampleOptions | None = None) -> tuple[GuidedField, GuidedReport]:
    """Fit the guided field to a cleaned measurement.

    Args:
        samples: Measurement of a bilateral material; azimuths are folded.
        options: `smoothness_weight`, where it is a number, is the noise variance relative to
            the kernel's half-angle term; otherwise the data choose it.

    Returns:
        The field, and a report of what the data chose.
    """
    floor = estimate_floor(samples.theta_i, samples.theta_o, fold_azimuth(samples.phi_o), samples.value)
    measured = np.array([samples.theta_i.max(), samples.theta_o.max()])
    limit = jnp.asarray(np.minimum(measured + EXTRAPOLATION, STEEPEST))
    centres = _merge(samples, floor, limit)
    num, size = centres.num, len(centres.padding)

    density = _pad(density_weights(np.asarray(centres.at.half)[:num]), size)
    lobe = fit_lobe_model(centres.value, centres.z, centres.at, density, floor)
    residual = centres.z - np.asarray(lobe_log_value(lobe, centres.at, jnp.asarray(floor)))
    residual = np.where(centres.padding[:, None], 0.0, residual)

    weight = "auto" if options is None else options.smoothness_weight
    choice = _choose(centres, residual, None if isinstance(weight, str) else float(weight))
    factors = _weigh(centres, residual, choice)
    noise = np.where(centres.padding, PADDING_NOISE, choice.noise / centres.count * factors)
    factor = factorise(choice.kernel, centres.at, jnp.asarray(noise))
    dual = solve_dual(factor, jnp.asarray(residual))
    scale = _scale(centres, factor, dual, noise, choice.noise)
    misfit = jnp.linalg.norm(factor @ (factor.T @ dual) - jnp.asarray(residual), axis=0)

    known, group = cluster_incidences(centres.theta_i[:num])
    group = np.where(np.bincount(group)[group] >= MIN_GROUP, group, -1)
    between_name, between_kernel, between_scale, curve = "", choice.kernel, 1.0, choice.curve
    duals = jnp.stack([dual, dual])
    if len(known) < 3 or num < MIN_GROUP * len(known):
        known = known[:1]
    else:
        numbers = np.concatenate([group, np.full(size - num, -1)])
        between = choose_between(centres.at, residual, noise, numbers, choice.noise)
        between_name, between_kernel, curve = between.name, between.kernel, curve + between.curve
        between_scale = _between_scale(centres, scale, between, numbers)
        duals = jnp.stack([dual, jnp.asarray(between.dual)])

    field = GuidedField(
        wavelength_nm=jnp.asarray(samples.wavelength_nm),
        floor=jnp.asarray(floor),
        lobe=lobe,
        theta_i=jnp.asarray(centres.theta_i),
        theta_o=jnp.asarray(centres.theta_o),
        azimuth=jnp.asarray(centres.azimuth),
        noise=jnp.asarray(noise),
        noise_level=jnp.asarray(choice.noise),
        dual=duals,
        kernel=choice.kernel,
        between_kernel=between_kernel,
        between_scale=jnp.asarray(between_scale),
        measured_theta_i=jnp.asarray(known),
        theta_limit=limit,
        scale=scale,
    )
    report = GuidedReport(
        floor=floor,
        kernel=choice.name,
        between_kernel=between_name,
        noise=choice.noise,
        curve=curve,
        noise_factor=factors[centres.index],
        num_centres=num,
        residual_norm=np.asarray(misfit) / np.maximum(np.linalg.norm(residual, axis=0), 1e-300),
    )
    return field, report
