"""Resampling as the paper has it: eqs. (4) to (10), every wavelength at once."""

import dataclasses
import functools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sbrdf_jax.grid import Grid
from sbrdf_jax.multipliers import InverseNormal, invert_normal, start_from_multipliers
from sbrdf_jax.nnls import NNLSResult, Precision, ProjectedNewton, scale_of, solve_in_rounds
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.records import GriddedBRDF, RawSamples
from sbrdf_jax.resampling.extrapolation import extrapolated_nodes
from sbrdf_jax.resampling.normal import TiedGridNormal, normal_equations


def resample_paper(
    samples: RawSamples,
    grid: Grid,
    options: ResampleOptions,
    report: Callable[[int, int], None] | None = None,
    invert: Callable[[TiedGridNormal], InverseNormal | None] = invert_normal,
    *,
    wanted: np.ndarray | None = None,
    known: GriddedBRDF | None = None,
    precision: Precision = "float64",
) -> GriddedBRDF:
    """Fit the non-negative grid whose sinc interpolation is nearest to the samples.

    Xu, eqs. (6) to (10): every sample counts once, weight 1; eq. (10)'s relations weigh
    `smoothness_weight`. The window of eq. (17) is used in evaluation only.

    Args:
        samples: Cleaned measurement; a wavelength with a non-finite value ends as such a lane.
        grid: Nodes and ties.
        options: `smoothness_weight` and `tolerance`, both resolved to numbers.
        report: Called with (wavelengths converged, wavelengths) as the solver goes.
        invert: Gives the inverse of A'A; it depends on the samples' angles, the grid and the
            weight, so one serves every material of a geometry.
        wanted: Mask of the wavelengths that are needed; None: all.
        known: An earlier answer for the same samples, grid and options, whose wavelengths are taken over.
        precision: Of the solver's first steps, as for `solve_normal`.

    Returns:
        The grid with its certificate; nowhere negative, one value at each pole.
    """
    if wanted is not None and not wanted.all():
        part = {"wavelength_nm": samples.wavelength_nm[wanted], "value": samples.value[:, wanted]}
        samples = dataclasses.replace(samples, **part)
    if known is not None and np.isin(samples.wavelength_nm, known.wavelength_nm).any():
        solve = functools.partial(resample_paper, report=report, invert=invert, precision=precision)
        return _with_known(known, samples, lambda fresh: solve(fresh, grid, options))
    operator, rhs = normal_equations(samples, grid, float(options.smoothness_weight))
    found = solve_normal(operator, rhs, float(options.tolerance), invert(operator), report, precision)
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


def _with_known(known: GriddedBRDF, samples: RawSamples, solve: Callable[[RawSamples], GriddedBRDF]) -> GriddedBRDF:
    """Return an answer at the samples' wavelengths, of which only those are solved that an earlier one lacks."""
    fresh = ~np.isin(samples.wavelength_nm, known.wavelength_nm)
    old = np.isin(known.wavelength_nm, samples.wavelength_nm)
    per_wavelength = ("wavelength_nm", "brdf", "kkt_residual", "num_steps", "status")
    parts = {name: np.asarray(getattr(known, name))[..., old] for name in per_wavelength}
    if fresh.any():
        part = {"wavelength_nm": samples.wavelength_nm[fresh], "value": samples.value[:, fresh]}
        solved = solve(dataclasses.replace(samples, **part))
        order = np.argsort(np.concatenate([parts["wavelength_nm"], solved.wavelength_nm]))
        parts = {
            name: np.concatenate([value, np.asarray(getattr(solved, name))], axis=-1)[..., order]
            for name, value in parts.items()
        }
    return dataclasses.replace(known, **{name: jnp.asarray(value) for name, value in parts.items()})


def solve_normal(
    operator: TiedGridNormal,
    rhs: Float[Array, "unknown lane"],
    tolerance: float,
    known: InverseNormal | None,
    report: Callable[[int, int], None] | None = None,
    precision: Precision = "float64",
) -> NNLSResult:
    """Minimise over the non-negative grids: from the multipliers where A'A has an inverse, then to the certificate.

    Args:
        operator: A'A of `normal_equations`.
        rhs: A'b, a column per wavelength.
        tolerance: Relative KKT residual to reach.
        known: Inverse of A'A; None where there is none, then the solver starts at 0.
        report: Called with (wavelengths converged, wavelengths) as the solver goes.
        precision: Of the first steps where there is no inverse; the multipliers' first rounds are float32 in any case.

    Returns:
        The answer; `num_steps` counts the steps of both parts.

    Raises:
        ValueError: `known` is of another geometry.
    """
    if known is None:
        return solve_in_rounds(operator, rhs, ProjectedNewton(tolerance=tolerance, precision=precision), report)
    if not np.array_equal(np.asarray(known.scale), np.asarray(scale_of(operator))):
        raise ValueError("the inverse is not of this normal matrix: angles, grid or smoothness weight differ")
    start, num_steps = start_from_multipliers(operator, rhs, known, tolerance)
    found = solve_in_rounds(operator, rhs, ProjectedNewton(tolerance=tolerance), report, start)
    return found._replace(num_steps=found.num_steps + jnp.asarray(num_steps, found.num_steps.dtype))
