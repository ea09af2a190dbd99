"""Smoothness as covariance: three Matern terms, one in half-angle and two in azimuth coordinates.

Regularised least squares on a uniform grid with an energy x' E x and samples A x has the
Gram matrix A E^-1 A'. This module gives the limit of that matrix for ever finer grids, in
closed form, so that no interpolation error is left and no grid has to be stored. A second
difference energy in three dimensions is the radial exponential; the half-angle term is one
order smoother. All wavelengths share the matrix.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sbrdf_jax.records import pytree
from sbrdf_jax.resampling.guided.coordinates import Coordinates

CONSTANT = 1e-2  # variance of a constant, relative to the half-angle term
EXACT_ZERO = 1e-18  # squared distance added under the root, for finite gradients


@pytree()
class Kernel:
    """Amplitudes and length scales; terms: half-angle (Matern 3/2), azimuth (1/2), fine azimuth (1/2)."""

    amplitude: Any  # [3] variances
    scale: Any  # [3, 3] lengths in (half or azimuth, theta_i, theta_o)


def make_kernel(amplitude: tuple[float, float, float], scale: tuple[tuple[float, float, float], ...]) -> Kernel:
    """Return a kernel from numbers."""
    return Kernel(amplitude=jnp.asarray(amplitude, dtype=float), scale=jnp.asarray(scale, dtype=float))


_LONG, _FINE = (10.0, 3.3, 3.3), (3.0, 0.3, 1.0)
MEASURED_KERNELS = {  # candidates for directions near measured incident angles
    "wide": make_kernel((1.0, 0.3, 0.06), ((3.0, 1.0, 1.0), _LONG, _FINE)),
    "wide_smooth": make_kernel((1.0, 0.3, 0.0), ((3.0, 1.0, 1.0), _LONG, _FINE)),
}
BETWEEN_KERNELS = {  # candidates between incident angles: longer in theta_i
    "long": make_kernel((1.0, 0.3, 0.0), ((3.0, 2.0, 1.0), (10.0, 6.6, 3.3), _FINE)),
    "long_azimuth": make_kernel((1.0, 1.0, 0.0), ((3.0, 2.0, 1.0), (10.0, 6.6, 3.3), _FINE)),
}


def covariance(kernel: Kernel, a: Coordinates, b: Coordinates) -> Float[Array, "a b"]:
    """Covariance of the residual between two lists of directions."""
    step_i = (a.theta_i[:, None] - b.theta_i[None, :]) ** 2
    step_o = (a.theta_o[:, None] - b.theta_o[None, :]) ** 2
    step_half = (a.half[:, None] - b.half[None, :]) ** 2
    step_azimuth = (a.azimuth[:, None] - b.azimuth[None, :]) ** 2
    total = jnp.full_like(step_i, CONSTANT)
    for term, first in enumerate((step_half, step_azimuth, step_azimuth)):
        squares = 1 / kernel.scale[term] ** 2
        distance = jnp.sqrt(first * squares[0] + step_i * squares[1] + step_o * squares[2] + EXACT_ZERO)
        if term == 0:
            distance = np.sqrt(3.0) * distance
            shape = (1 + distance) * jnp.exp(-distance)
        else:
            shape = jnp.exp(-distance)
        total = total + kernel.amplitude[term] * shape
    return total


def prior_variance(kernel: Kernel) -> Float[Array, ""]:
    """Variance of the residual at one direction before any sample."""
    return CONSTANT + kernel.amplitude.sum()


@jax.jit
def factorise(kernel: Kernel, at: Coordinates, noise: Float[Array, " sample"]) -> Float[Array, "sample sample"]:
    """Lower Cholesky factor of covariance plus noise."""
    return jnp.linalg.cholesky(covariance(kernel, at, at) + jnp.diag(noise))


@jax.jit
def solve_dual(
    factor: Float[Array, "sample sample"], residual: Float[Array, "sample wavelength"]
) -> Float[Array, "sample wavelength"]:
    """Dual coefficients: (covariance + noise)^-1 residual."""
    return jax.scipy.linalg.cho_solve((factor, True), residual)


@jax.jit
def leave_one_out(
    factor: Float[Array, "sample sample"], dual: Float[Array, "sample wavelength"]
) -> tuple[Float[Array, "sample wavelength"], Float[Array, " sample"]]:
    """Exact leave-one-out residuals, and the variance that each was predicted with (noise included).

    With C the inverse of covariance plus noise: e_i = (C r)_i / C_ii, of variance 1 / C_ii.
    """
    inverse = jax.scipy.linalg.solve_triangular(factor, jnp.eye(len(factor)), lower=True)
    diagonal = jnp.sum(inverse**2, axis=0)
    return dual / diagonal[:, None], 1 / diagonal


@jax.jit
def invert(factor: Float[Array, "sample sample"]) -> Float[Array, "sample sample"]:
    """Inverse of covariance plus noise, for leave-group-out."""
    inverse = jax.scipy.linalg.solve_triangular(factor, jnp.eye(len(factor)), lower=True)
    return inverse.T @ inverse
