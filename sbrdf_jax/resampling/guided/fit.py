"""Samples to field: floor, lobe model, smoothness, weights, bounded solution, error scale, in this order."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from sbrdf_jax.angles import fold_azimuth
from sbrdf_jax.nnls import ProjectedNewton
from sbrdf_jax.records import RawSamples
from sbrdf_jax.resampling.guided.bounds import solve_bounded
from sbrdf_jax.resampling.guided.centres import Centres, place_centres
from sbrdf_jax.resampling.guided.coordinates import from_log, guided_coordinates, log_scale, slope, to_log
from sbrdf_jax.resampling.guided.covariance import node_values
from sbrdf_jax.resampling.guided.error_model import (
    ResidualScale,
    estimate_floor,
    fit_residual_scale,
    noise_factors,
    spread_rows,
)
from sbrdf_jax.resampling.guided.field import GuidedField
from sbrdf_jax.resampling.guided.inverse import leave_group_out, lower_product, mirror_lower, whitener
from sbrdf_jax.resampling.guided.lobe_model import density_weights, fit_lobe_model, lobe_log_value
from sbrdf_jax.resampling.guided.nodes import mirror
from sbrdf_jax.resampling.guided.smoothing import choose_smoothing

CALIBRATION_GROUPS = 5


class GuidedFit(NamedTuple):
    """A fitted field, and how well each wavelength was solved."""

    field: GuidedField
    kkt_residual: np.ndarray  # [wavelength] relative, of the bounded problem
    num_steps: np.ndarray  # [wavelength]
    status: np.ndarray  # [wavelength] Status
    whiten: np.ndarray  # [centre, centre] inverse Cholesky factor of prior plus noise, for standard errors


def fit_guided(
    samples: RawSamples,
    *,
    weight: float | None = None,
    tolerance: float = 1e-6,
    centres: Centres | None = None,
    report: Callable[[str], None] | None = None,
) -> GuidedFit:
    """Fit the guided field to a cleaned measurement.

    Args:
        samples: Measurement of a bilateral material; azimuths are folded. Every value is finite.
        weight: Noise variance of z relative to the prior's; None: chosen by leave-one-out.
        tolerance: Relative KKT residual to reach.
        centres: Where the samples are; several fits may share what depends on angles alone.
        report: Told of each step.
    """
    say = report or (lambda _: None)
    if centres is None:
        centres = place_centres(samples)
    seen = centres.number > 0
    floor = estimate_floor(samples.theta_i, samples.theta_o, fold_azimuth(samples.phi_o), samples.value)
    at_samples = guided_coordinates(
        *(jnp.asarray(a) for a in (samples.theta_i, samples.theta_o, samples.phi_o, centres.theta_limit))
    )
    z_sample = to_log(jnp.asarray(samples.value), log_scale(at_samples, jnp.asarray(floor)))
    z = centres.mean(np.asarray(z_sample))

    say("lobe model")
    half = np.asarray(centres.at.half)
    density = np.zeros(centres.count)
    density[seen] = density_weights(half[seen])
    lobe, model_residual = fit_lobe_model(centres.mean(np.maximum(samples.value, 0.0)), z, centres.at, density, floor)
    residual = centres.mean(np.asarray(z_sample) - np.asarray(lobe_log_value(lobe, at_samples, jnp.asarray(floor))))
    model = np.where(seen[:, None], np.asarray(lobe_log_value(lobe, centres.at, jnp.asarray(floor))), 0.0)

    say("smoothness")
    choice = choose_smoothing(centres, residual, weight)
    factor = np.ones(centres.count)
    factor[seen] = noise_factors(half[seen], *centres.angles[:2, seen], choice.left_out[seen])
    noise = centres.noise(choice.noise) * factor
    prior = centres.prior(choice.variance)
    whiten = whitener(np.asarray(prior), noise)
    lower = lower_product(whiten)
    inverse = mirror_lower(lower)

    say("bounded least squares")
    arrays = (jnp.asarray(a) for a in (inverse, noise, residual, model))
    bounded = solve_bounded(prior, *arrays, ProjectedNewton(tolerance=tolerance))
    half_nodes, azimuth_nodes = node_values(choice.variance, centres.features, bounded.dual)

    say("error scale")
    out, variance = _left_out_fifths(seen, lower, inverse @ residual)
    # a centre's own extra noise, or what averaging took from it, is not that of a new measurement
    spread = np.maximum(variance - noise, 0.0) + choice.noise
    shape = (3, centres.num_groups, centres.num_members)
    field = GuidedField(
        wavelength_nm=jnp.asarray(samples.wavelength_nm),
        floor=jnp.asarray(floor),
        lobe=lobe,
        half=mirror(half_nodes),
        azimuth=mirror(azimuth_nodes),
        theta_limit=jnp.asarray(centres.theta_limit),
        centre=jnp.asarray(centres.angles.reshape(shape)),
        noise=jnp.asarray(noise.reshape(shape[1:])),
        noise_factor=jnp.asarray(factor.reshape(shape[1:])),
        noise_level=jnp.asarray(choice.noise),
        variance=choice.variance,
        scale=_calibrate(centres, samples, model + residual - out, spread, floor),
        multiplier=bounded.multiplier.reshape(*shape[1:], -1),
        model_residual=model_residual,
        reciprocity_cost=jnp.asarray(choice.reciprocity_cost),
        curve=jnp.asarray(np.transpose(choice.curve)),
    )
    proof = (np.asarray(a) for a in (bounded.kkt_residual, bounded.num_steps, bounded.status))
    return GuidedFit(field, *proof, whiten)


def _left_out_fifths(seen: np.ndarray, lower: np.ndarray, dual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact residuals of leaving random fifths out, and their variances."""
    group = np.random.default_rng(0).permutation(len(seen)) % CALIBRATION_GROUPS
    return leave_group_out(lower, dual, np.where(seen, group, -1))


def _calibrate(centres: Centres, samples: RawSamples, predicted, spread, floor: float) -> ResidualScale:
    """Calibrate the error scale by how far samples lie from predictions that did not see them."""
    rows = spread_rows(samples.num_samples)
    centre = centres.index[rows]
    z = predicted[centre]
    scale = log_scale(centres.at, jnp.asarray(floor))[centre]
    value, unit = (np.asarray(f(jnp.asarray(z), scale)) for f in (from_log, slope))
    standardised = (np.maximum(samples.value[rows], 0.0) - value) / (unit * np.sqrt(spread[centre])[:, None])
    return fit_residual_scale(centres.angles[0, centre], np.asarray(centres.at.half)[centre], z, standardised)
