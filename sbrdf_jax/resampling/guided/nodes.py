"""The guided field read off at the nodes of the uniform grid."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from sbrdf_jax.grid import Grid
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.records import GriddedBRDF, RawSamples, Status
from sbrdf_jax.resampling.extrapolation import extrapolated_nodes
from sbrdf_jax.resampling.guided.field import GuidedField, evaluate_guided, evaluate_standard_error
from sbrdf_jax.resampling.guided.fit import GuidedReport, fit_guided


class GuidedResult(NamedTuple):
    """The grid, its standard errors, and the field that both were read from."""

    gridded: GriddedBRDF
    standard_error: np.ndarray  # [theta_i, theta_o, phi_o, wavelength] 1/sr
    field: GuidedField
    report: GuidedReport


def read_nodes(field: GuidedField, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return the field and its standard error [theta_i, theta_o, phi_o inclusive, wavelength] at the grid's nodes.

    The field is even in azimuth, so half of the circle is evaluated.
    """
    half = grid.num_phi_o // 2
    circle = np.arange(grid.num_phi_o + 1) % grid.num_phi_o
    distinct = np.minimum(circle, grid.num_phi_o - circle)
    angles = np.meshgrid(grid.theta_i, grid.theta_o, grid.phi_o[: half + 1], indexing="ij")
    angles = [jnp.asarray(a) for a in angles]
    value = np.asarray(evaluate_guided(field, *angles))
    error, _ = evaluate_standard_error(field, *angles)
    return value[:, :, distinct], np.asarray(error)[:, :, distinct]


def resample_guided(samples: RawSamples, grid: Grid, options: ResampleOptions) -> GuidedResult:
    """Fit the guided field and read it off at the grid's nodes.

    Args:
        samples: Cleaned measurement.
        grid: Nodes; `bilateral` is taken for granted.
        options: See `fit_guided`; a wavelength whose linear system is solved worse than 1e-6 is MAX_STEPS.
    """
    field, report = fit_guided(samples, options)
    value, error = read_nodes(field, grid)
    tolerance = 1e-6 if isinstance(options.tolerance, str) else float(options.tolerance)
    status = np.where(report.residual_norm <= tolerance, int(Status.OK), int(Status.MAX_STEPS))
    status = np.where(np.isfinite(value).all(axis=(0, 1, 2)), status, int(Status.NONFINITE))
    gridded = GriddedBRDF(
        theta_i=jnp.asarray(grid.theta_i),
        theta_o=jnp.asarray(grid.theta_o),
        phi_o=jnp.asarray(grid.phi_o),
        wavelength_nm=jnp.asarray(samples.wavelength_nm),
        brdf=jnp.asarray(value),
        extrapolated=jnp.asarray(extrapolated_nodes(samples, grid)),
        kkt_residual=jnp.asarray(report.residual_norm),
        num_steps=jnp.ones(len(status), dtype=int),
        status=jnp.asarray(status),
        method="guided",
        window=options.window,
        bilateral=True,
        interpolate_theta_i=grid.interpolate_theta_i,
    )
    return GuidedResult(gridded, error, field, report)
