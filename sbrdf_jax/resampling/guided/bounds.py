"""The bound of the paper's family: the generalised logarithm z is not negative where it was measured.

Xu, eq. (10): minimise |A x - b|^2 with x >= 0. Here the nodes are free and z = z_lobe + A x
is bounded at the centres. With multipliers v >= 0 the answer is that of the data raised by
N v, and v solves min 1/2 v' G v + v' z_0, v >= 0: z_0 is z of the unbounded answer, and
G = N - N (K + N)^-1 N the posterior covariance at the centres, well conditioned where the
nodes' own normal matrix is not.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sbrdf_jax.devices import over_lanes
from sbrdf_jax.nnls import DenseNormal, ProjectedNewton, solve_nnls
from sbrdf_jax.records import Status
from sbrdf_jax.resampling.guided.centres import PADDING_NOISE


class Bounded(NamedTuple):
    """The bounded answer at the centres, and what proves it."""

    dual: jax.Array  # [centre, wavelength] (K + N)^-1 (r + N v)
    multiplier: jax.Array  # [centre, wavelength] N^1/2 v
    kkt_residual: jax.Array  # [wavelength] of the bounded problem, and of the linear system under it
    num_steps: jax.Array  # [wavelength]
    status: jax.Array  # [wavelength]


@functools.partial(over_lanes, axis=-1, shared=(0, 1, 2), static=(5,))
def solve_bounded(
    prior: Float[Array, "centre centre"],
    inverse: Float[Array, "centre centre"],
    noise: Float[Array, " centre"],
    residual: Float[Array, "centre wavelength"],
    model: Float[Array, "centre wavelength"],
    method: ProjectedNewton,
) -> Bounded:
    """Solve for the dual coefficients of the field with z >= 0 at the centres.

    Args:
        prior: K, the prior covariance.
        inverse: (K + N)^-1.
        noise: Diagonal of N; a centre without samples has `PADDING_NOISE`, and no bound.
        residual: r, z minus the lobe model's.
        model: z of the lobe model.
        method: The solver and its tolerance on the relative KKT residual.
    """
    is_bound = noise < PADDING_NOISE
    root = jnp.where(is_bound, jnp.sqrt(noise), 0.0)
    covariance = jnp.eye(len(root)) - root[:, None] * inverse * root[None, :]
    free = inverse @ residual
    unbounded = model + residual - (root**2)[:, None] * free
    rhs = jnp.where(is_bound[:, None], -unbounded / jnp.where(is_bound, root, 1.0)[:, None], 0.0)
    found = solve_nnls(DenseNormal(covariance), rhs, method)
    raised = residual + root[:, None] * found.value
    dual = inverse @ raised
    # what the linear system is left with, beside what the bound is left with
    misfit = jnp.max(jnp.abs(prior @ dual + noise[:, None] * dual - raised), axis=0)
    size = jnp.max(jnp.abs(raised), axis=0)
    kkt_residual = jnp.maximum(found.residual, misfit / jnp.where(size > 0, size, 1.0))
    status = jnp.where(kkt_residual <= method.tolerance, found.status, jnp.maximum(found.status, int(Status.MAX_STEPS)))
    return Bounded(dual, found.value, kkt_residual, found.num_steps, status)
