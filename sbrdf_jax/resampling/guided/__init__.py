"""The guided method: a robust lobe model, and a smooth residual in coordinates where a glossy field is smooth.

The field is fitted in a generalised logarithm, by bounded least squares on three uniform
grids, for all wavelengths at once; everything that depends on angles alone is shared.
"""

from collections.abc import Callable

import jax
import numpy as np

from sbrdf_jax.grid import Grid
from sbrdf_jax.needs import Needs, everything
from sbrdf_jax.nnls import Precision
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.records import GriddedBRDF, RawSamples, Status
from sbrdf_jax.resampling.extrapolation import extrapolated_nodes
from sbrdf_jax.resampling.guided.centres import PADDING_NOISE, Centres, place_centres
from sbrdf_jax.resampling.guided.coordinates import guided_coordinates
from sbrdf_jax.resampling.guided.estimates import Estimates, estimate, live_part, live_wavelengths
from sbrdf_jax.resampling.guided.field import GuidedField
from sbrdf_jax.resampling.guided.fit import GuidedFit, solve_field
from sbrdf_jax.resampling.guided.inverse import Whitener
from sbrdf_jax.resampling.guided.lanes import join_fits, spread, take_fit, with_dead_wavelengths
from sbrdf_jax.resampling.guided.lobe_model import lobe_terms
from sbrdf_jax.resampling.guided.reading import read_nodes

__all__ = [
    "Centres",
    "Estimates",
    "GuidedField",
    "describe_fit",
    "estimate_whole",
    "fit_field",
    "place_centres",
    "resample_guided",
]


CONTRADICTED = 1.2  # growth of the left-out errors from which reciprocity is doubted
MIRROR_TERM = 1  # of the lobe model
RESOLVED = 4  # directions within the mirror image, for each incident angle, that would tell its shape
SPIKE_THETA = np.pi / 4  # where the mirror image is compared with the other terms
DOUBTED = 1.5  # noise variance, relative, of a direction that is said to have lost weight


def estimate_whole(
    samples: RawSamples, options: ResampleOptions, centres: Centres, report: Callable[[str], None] | None = None
) -> Estimates:
    """Estimate what depends on the whole measurement, from the wavelengths that are finite and hold light."""
    weight = None if isinstance(options.smoothness_weight, str) else float(options.smoothness_weight)
    return estimate(live_part(samples), weight, centres, report)


def fit_field(
    samples: RawSamples,
    options: ResampleOptions,
    report: Callable[[str], None] | None = None,
    centres: Centres | None = None,
    *,
    needed: np.ndarray | None = None,
    estimates: Estimates | None = None,
    known: GuidedFit | None = None,
    precision: Precision = "float64",
) -> GuidedFit:
    """Fit the guided field to cleaned samples, whatever their wavelengths hold.

    Args:
        samples: Cleaned measurement; a wavelength with a non-finite value ends as such a lane, one without a
            positive value is 0.
        options: `smoothness_weight` ("data" or the noise variance relative to the prior's) and `tolerance`.
        report: Told of each step.
        centres: Where the samples are; several fits may share what depends on angles alone.
        needed: Mask of the wavelengths that are wanted, which change nothing of each other; None: all.
        estimates: Of the whole measurement, where they have been made.
        known: A fit to the same samples, whose wavelengths need not be solved again.
        precision: Of the bounded solver's first steps.
    """
    centres = centres or place_centres(samples)
    estimates = estimates or estimate_whole(samples, options, centres, report)
    needed = np.ones(len(samples.wavelength_nm), bool) if needed is None else needed
    finite, live = np.isfinite(samples.value).all(axis=0), live_wavelengths(samples)
    wanted = samples.wavelength_nm[needed & live]
    held = np.zeros(0) if known is None else np.intersect1d(wanted, known.field.wavelength_nm)
    fresh = np.isin(estimates.wavelength_nm, wanted) & ~np.isin(estimates.wavelength_nm, held)
    if report is not None:
        report(f"bounded least squares, {fresh.sum()} wavelengths")
    fit = solve_field(estimates, centres, fresh, float(options.tolerance), precision)
    if known is not None and len(held):
        fit = join_fits(take_fit(known, np.isin(known.field.wavelength_nm, held)), fit)
    wavelength_nm, finite, live = samples.wavelength_nm[needed], finite[needed], live[needed]
    missing = np.where(finite, 0.0, np.nan)
    is_finite = np.isfinite(np.asarray(fit.field.half)).all(axis=(0, 1, 2))
    status = np.where(finite, int(Status.OK), int(Status.NONFINITE))
    status[live] = np.where(is_finite, fit.status, int(Status.NONFINITE))
    num_steps = np.zeros(len(live), int)
    num_steps[live] = fit.num_steps
    return GuidedFit(
        field=with_dead_wavelengths(fit.field, wavelength_nm, live, missing),
        kkt_residual=spread(fit.kkt_residual, live, missing),
        num_steps=num_steps,
        status=status,
        whiten=fit.whiten,
    )


def resample_guided(
    samples: RawSamples,
    grid: Grid,
    options: ResampleOptions,
    report: Callable[[str], None] | None = None,
    centres: Centres | None = None,
    *,
    estimates: Estimates | None = None,
    needs: Needs | None = None,
    known: GriddedBRDF | None = None,
    precision: Precision = "float64",
) -> GriddedBRDF:
    """Fit the guided field, and read it and its standard error off at the grid's nodes.

    Args:
        samples: As for `fit_field`.
        grid: Nodes; bilateral.
        options: As for `fit_field`.
        report: Told of each step.
        centres: As for `fit_field`.
        estimates: As for `fit_field`.
        needs: Which wavelengths and nodes; None: all. Skipped incident angles and wavelengths have no place in
            the answer, other skipped nodes are nan.
        known: An earlier answer for the same samples and options, of which what is needed is taken over.
        precision: As for `fit_field`.
    """
    needs = needs or everything(grid, len(samples.wavelength_nm))
    centres = centres or place_centres(samples, grid.reciprocal)
    estimates = estimates or estimate_whole(samples, options, centres, report)
    earlier = None if known is None else fit_of(known, estimates.whiten)
    parts = {"needed": needs.wavelength, "estimates": estimates, "known": earlier, "precision": precision}
    fit = fit_field(samples, options, report, centres, **parts)
    if report is not None:
        report("nodes")
    held = estimates.node_variance, centres.node_covariance
    nodes = read_nodes(fit.field, grid, fit.whiten, needs.node, known, *held)
    if grid.key not in centres.node_flags:
        centres.node_flags[grid.key] = extrapolated_nodes(samples, grid)
    flags, theta_i = centres.node_flags[grid.key], needs.theta_i
    return GriddedBRDF(
        theta_i=grid.theta_i[theta_i],
        theta_o=grid.theta_o,
        phi_o=grid.phi_o,
        wavelength_nm=samples.wavelength_nm[needs.wavelength],
        brdf=nodes.value,
        extrapolated=flags[theta_i],
        kkt_residual=fit.kkt_residual,
        num_steps=fit.num_steps,
        status=fit.status,
        method="guided",
        window=options.window,
        bilateral=True,
        interpolate_theta_i=grid.interpolate_theta_i,
        standard_error=nodes.standard_error,
        residual_variance=nodes.variance,
        field=fit.field,
        needed=None if needs.node[theta_i].all() else needs.node[theta_i],
    )


def fit_of(gridded: GriddedBRDF, whiten: Whitener) -> GuidedFit:
    """Return the fit behind a grid: the wavelengths at which it ended as it should."""
    proof = (np.asarray(gridded.kkt_residual), np.asarray(gridded.num_steps), np.asarray(gridded.status))
    fit = GuidedFit(gridded.field, *proof, whiten)
    return take_fit(fit, np.asarray(gridded.status) == int(Status.OK))


def describe_fit(field: GuidedField) -> tuple[str, ...]:
    """Sentences on what a user should know of a fit."""
    lines = []
    doubted = int(np.sum(np.asarray(field.noise_factor) > DOUBTED))
    if doubted:
        total = int(np.sum(np.asarray(field.noise) < PADDING_NOISE))
        lines.append(f"guided: {doubted} of {total} directions contradict their neighbours and lost weight")
    cost = float(field.reciprocity_cost)
    if cost > CONTRADICTED:
        lines.append(f"grid.reciprocal: the measurement contradicts it, left-out errors grow {cost:.1f} times")
    lines += describe_spike(field)
    return tuple(lines)


def describe_spike(field: GuidedField) -> list[str]:
    """Say where the mirror image of the source outshines all else, and too few directions see it to tell its shape."""
    field = jax.tree.map(np.asarray, field)
    angle = np.asarray(SPIKE_THETA)
    at = guided_coordinates(angle, angle, np.asarray(np.pi), field.theta_limit)
    term = lobe_terms(field.lobe.shape, at, field.lobe.mirror_power)[:, None] * np.exp(field.lobe.log_amplitude)
    spiky = term[MIRROR_TERM] > np.delete(term, MIRROR_TERM, axis=0).sum(axis=0)
    width = np.rad2deg(np.arctan(np.exp(field.lobe.shape[1])))
    centres = guided_coordinates(*field.centre, field.theta_limit)
    near = (np.expm1(centres.half) < width) & (field.noise < PADDING_NOISE)
    if not spiky.any() or near.sum() >= RESOLVED * len(near):
        return []
    return [
        f"guided: a mirror spike of about {width:.1f} degrees at {spiky.sum()} of {len(spiky)} wavelengths, seen by "
        f"{near.sum()} directions: too few for its shape; the lobe model alone carries it"
    ]
