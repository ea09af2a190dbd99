"""The guided method: a robust lobe model, and a smooth residual in coordinates where a glossy field is smooth.

The field is fitted in a generalised logarithm, by bounded least squares on two uniform
grids, for all wavelengths at once; everything that depends on angles alone is shared.
"""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from sbrdf_jax.grid import Grid
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.records import GriddedBRDF, RawSamples, Status
from sbrdf_jax.resampling.extrapolation import extrapolated_nodes
from sbrdf_jax.resampling.guided.centres import Centres, place_centres
from sbrdf_jax.resampling.guided.field import GuidedField, evaluate_with_error
from sbrdf_jax.resampling.guided.fit import GuidedFit, fit_guided
from sbrdf_jax.resampling.guided.smoothing import PADDING_NOISE

__all__ = ["Centres", "GuidedField", "describe_fit", "fit_field", "place_centres", "resample_guided"]

DOUBTED = 1.5  # noise variance, relative, of a direction that is said to have lost weight


def fit_field(
    samples: RawSamples,
    options: ResampleOptions,
    report: Callable[[str], None] | None = None,
    centres: Centres | None = None,
) -> GuidedFit:
    """Fit the guided field to cleaned samples, whatever their wavelengths hold.

    Args:
        samples: Cleaned measurement; a wavelength with a non-finite value ends as such a lane, one without a
            positive value is 0.
        options: `smoothness_weight` ("data" or the noise variance relative to the prior's) and `tolerance`.
        report: Told of each step.
        centres: Where the samples are; several fits may share what depends on angles alone.
    """
    finite = np.isfinite(samples.value).all(axis=0)
    live = finite & (samples.value > 0).any(axis=0)
    part = dataclasses.replace(samples, wavelength_nm=samples.wavelength_nm[live], value=samples.value[:, live])
    weight = None if isinstance(options.smoothness_weight, str) else float(options.smoothness_weight)
    fit = fit_guided(part, weight=weight, tolerance=float(options.tolerance), centres=centres, report=report)
    missing = np.where(finite, 0.0, np.nan)
    is_finite = np.isfinite(np.asarray(fit.field.half)).all(axis=(0, 1, 2))
    status = np.where(finite, int(Status.OK), int(Status.NONFINITE))
    status[live] = np.where(is_finite, fit.status, int(Status.NONFINITE))
    num_steps = np.zeros(len(live), int)
    num_steps[live] = fit.num_steps
    return GuidedFit(
        field=_with_dead_wavelengths(fit.field, samples.wavelength_nm, live, missing),
        kkt_residual=_spread(fit.kkt_residual, live, missing),
        num_steps=num_steps,
        status=status,
    )


def resample_guided(
    samples: RawSamples,
    grid: Grid,
    options: ResampleOptions,
    report: Callable[[str], None] | None = None,
    centres: Centres | None = None,
) -> GriddedBRDF:
    """Fit the guided field, and read it and its standard error off at the grid's nodes.

    Args:
        samples: As for `fit_field`.
        grid: Nodes; bilateral.
        options: As for `fit_field`.
        report: Told of each step.
        centres: As for `fit_field`.
    """
    fit = fit_field(samples, options, report, centres)
    value, error = read_nodes(fit.field, grid)
    return GriddedBRDF(
        theta_i=jnp.asarray(grid.theta_i),
        theta_o=jnp.asarray(grid.theta_o),
        phi_o=jnp.asarray(grid.phi_o),
        wavelength_nm=jnp.asarray(samples.wavelength_nm),
        brdf=jnp.asarray(value),
        extrapolated=jnp.asarray(extrapolated_nodes(samples, grid)),
        kkt_residual=jnp.asarray(fit.kkt_residual),
        num_steps=jnp.asarray(fit.num_steps),
        status=jnp.asarray(fit.status),
        method="guided",
        window=options.window,
        bilateral=True,
        interpolate_theta_i=grid.interpolate_theta_i,
        standard_error=jnp.asarray(error),
        field=fit.field,
    )


def read_nodes(field: GuidedField, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return the field and its standard error [theta_i, theta_o, phi_o inclusive, wavelength] at the grid's nodes.

    The field is even in azimuth, so half of the circle is evaluated.
    """
    distinct = np.append(grid.azimuth_index, 0)
    angles = np.meshgrid(grid.theta_i, grid.theta_o, grid.phi_o[: grid.num_azimuths], indexing="ij")
    shape = (*angles[0].shape, -1)
    flat = [jnp.asarray(a.reshape(-1)) for a in angles]
    value, error, _ = (np.asarray(a).reshape(shape)[:, :, distinct] for a in evaluate_with_error(field, *flat))
    return value, error


def describe_fit(field: GuidedField) -> tuple[str, ...]:
    """Sentences on what a user should know of a fit."""
    doubted = int(np.sum(np.asarray(field.noise_factor) > DOUBTED))
    total = int(np.sum(np.asarray(field.noise) < PADDING_NOISE))
    if not doubted:
        return ()
    return (f"guided: {doubted} of {total} directions contradict their neighbours and lost weight",)


def _spread(array: np.ndarray, live: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Put an array [..., live wavelength] among all wavelengths."""
    whole = np.broadcast_to(missing, (*array.shape[:-1], len(live))).copy()
    whole[..., live] = array
    return whole


def _with_dead_wavelengths(
    field: GuidedField, wavelength_nm: np.ndarray, live: np.ndarray, missing: np.ndarray
) -> GuidedField:
    """Return the field with all wavelengths: 0 where nothing was seen, nan where a value was not finite."""
    if live.all():
        return field
    per_wavelength = ("half", "azimuth", "multiplier", "model_residual")
    parts = {name: jnp.asarray(_spread(np.asarray(getattr(field, name)), live, missing)) for name in per_wavelength}
    amplitude = _spread(np.asarray(field.lobe.log_amplitude), live, np.full(len(live), -np.inf))
    lobe = dataclasses.replace(field.lobe, log_amplitude=jnp.asarray(amplitude))
    return dataclasses.replace(field, wavelength_nm=jnp.asarray(wavelength_nm), lobe=lobe, **parts)
