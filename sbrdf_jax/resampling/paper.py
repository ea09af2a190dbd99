"""Resampling as the paper has it: eqs. (4) to (10), every wavelength at once."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from sbrdf_jax.grid import Grid
from sbrdf_jax.nnls import AcceleratedProjectedGradient, solve_in_rounds
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.records import GriddedBRDF, RawSamples
from sbrdf_jax.resampling.extrapolation import extrapolated_nodes
from sbrdf_jax.resampling.normal import normal_equations


def resample_paper(
    samples: RawSamples,
    grid: Grid,
    options: ResampleOptions,
    report: Callable[[int, int], None] | None = None,
) -> GriddedBRDF:
    """Fit the non-negative grid whose sinc interpolation is nearest to the samples.

    Xu, eqs. (6) to (10): every sample counts once, weight 1; eq. (10)'s relations weigh
    `smoothness_weight`. The window of eq. (17) is used in evaluation only.

    Args:
        samples: Cleaned measurement; a wavelength with a non-finite value ends as such a lane.
        grid: Nodes and ties.
        options: `smoothness_weight` and `tolerance`, both resolved to numbers.
        report: Called with (wavelengths converged, wavelengths) as the solver goes.

    Returns:
        The grid with its certificate; nowhere negative, one value at each pole.
    """
    operator, rhs = normal_equations(samples, grid, float(options.smoothness_weight))
    method = AcceleratedProjectedGradient(tolerance=float(options.tolerance))
    found = solve_in_rounds(operator, rhs, method, report)
    return GriddedBRDF(
        theta_i=jnp.asarray(grid.theta_i),
        theta_o=jnp.asarray(grid.theta_o),
        phi_o=jnp.asarray(grid.phi_o),
        wavelength_nm=jnp.asarray(samples.wavelength_nm),
        brdf=jnp.asarray(grid.scatter(np.asarray(found.value))),
        extrapolated=jnp.asarray(extrapolated_nodes(samples, grid)),
        kkt_residual=found.residual,
        num_steps=found.num_steps,
        status=found.status,
        method="paper",
        window=options.window,
        bilateral=grid.bilateral,
        interpolate_theta_i=grid.interpolate_theta_i,
    )
