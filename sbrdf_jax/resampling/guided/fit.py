"""From the estimates of a whole measurement to the field at the wavelengths that are needed."""

import dataclasses
from typing import NamedTuple

import numpy as np

from sbrdf_jax.host_blas import one_blas_thread
from sbrdf_jax.nnls import Precision, ProjectedNewton
from sbrdf_jax.resampling.guided.bounds import solve_bounded
from sbrdf_jax.resampling.guided.centres import Centres
from sbrdf_jax.resampling.guided.covariance import node_values
from sbrdf_jax.resampling.guided.estimates import Estimates
from sbrdf_jax.resampling.guided.field import GuidedField, WholeSpectrum
from sbrdf_jax.resampling.guided.inverse import Whitener
from sbrdf_jax.resampling.guided.nodes import mirror


class GuidedFit(NamedTuple):
    """A fitted field, and how well each wavelength was solved."""

    field: GuidedField
    kkt_residual: np.ndarray  # [wavelength] relative, of the bounded problem
    num_steps: np.ndarray  # [wavelength]
    status: np.ndarray  # [wavelength] Status
    whiten: Whitener  # of prior plus noise, for standard errors


def solve_field(
    estimates: Estimates, centres: Centres, needed: np.ndarray, tolerance: float, precision: Precision = "float64"
) -> GuidedFit:
    """Solve the bounded problem at some wavelengths, which do not depend on each other.

    Args:
        estimates: Of the whole measurement.
        centres: Where the samples are.
        needed: Which of the estimates' wavelengths: a mask.
        tolerance: Relative KKT residual to reach.
        precision: Of the bounded solver's first steps.
    """
    prior = centres.prior(estimates.variance)
    parts = (estimates.inverse, estimates.noise, estimates.residual[:, needed], estimates.model[:, needed])
    bounded = solve_bounded(prior, *parts, ProjectedNewton(tolerance=tolerance, precision=precision))
    with one_blas_thread():
        nodes = node_values(estimates.variance, centres.node_rows, bounded.dual)
    amplitude = estimates.lobe.log_amplitude
    shape = (3, centres.num_groups, centres.num_members)
    field = GuidedField(
        wavelength_nm=estimates.wavelength_nm[needed],
        floor=np.asarray(estimates.floor),
        lobe=dataclasses.replace(estimates.lobe, log_amplitude=amplitude[:, needed]),
        theta_limit=centres.theta_limit,
        centre=centres.angles.reshape(shape),
        noise=estimates.noise.reshape(shape[1:]),
        noise_factor=estimates.factor.reshape(shape[1:]),
        noise_level=np.asarray(estimates.noise_level),
        variance=estimates.variance,
        scale=estimates.scale,
        multiplier=bounded.multiplier.reshape(*shape[1:], -1),
        model_residual=estimates.model_residual[needed],
        reciprocity_cost=np.asarray(estimates.reciprocity_cost),
        curve=np.transpose(estimates.curve),
        measured=WholeSpectrum(
            estimates.wavelength_nm, amplitude, estimates.model_residual, *estimates.spectral_filter
        ),
        **{name: mirror(values) for name, values in nodes.items()},
    )
    return GuidedFit(field, bounded.kkt_residual, bounded.num_steps, bounded.status, estimates.whiten)
