"""The bound of the paper's family: the generalised logarithm z is not negative where it was measured.

Xu, eq. (10): minimise |A x - b|^2 with x >= 0. Here the nodes are free and z = z_lobe + A x
is bounded at the centres. With multipliers v >= 0 the answer is that of the data raised by
N v, and v solves min 1/2 v' G v + v' z_0, v >= 0: z_0 is z of the unbounded answer, and
G = N - N (K + N)^-1 N the posterior covariance at the centres, well conditioned where the
nodes' own normal matrix is not.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sbrdf_jax.devices import over_lanes
from sbrdf_jax.host_blas import one_blas_thread
from sbrdf_jax.nnls import DenseNormal, NNLSResult, ProjectedNewton, solve_nnls
from sbrdf_jax.records import Status
from sbrdf_jax.resampling.guided.centres import PADDING_NOISE


class Bounded(NamedTuple):
    """The bounded answer at the centres, and what proves it."""

    dual: np.ndarray  # [centre, wavelength] (K + N)^-1 (r + N v)
    multiplier: np.ndarray  # [centre, wavelength] N^1/2 v
    kkt_residual: np.ndarray  # [wavelength] of the bounded problem, and of the linear system under it
    num_steps: np.ndarray  # [wavelength]
    status: np.ndarray  # [wavelength]


def solve_bounded(
    prior: Float[np.ndarray, "centre centre"],
    inverse: Float[np.ndarray, "centre centre"],
    noise: Float[np.ndarray, " centre"],
    residual: Float[np.ndarray, "centre wavelength"],
    model: Float[np.ndarray, "centre wavelength"],
    method: ProjectedNewton,
) -> Bounded:
    """Solve for the dual coefficients of the field with z >= 0 at the centres.

    Where the unbounded answer keeps the bound at every wavelength it is the answer, and no solver is compiled.

    Args:
        prior: K, the prior covariance.
        inverse: (K + N)^-1.
        noise: Diagonal of N; a centre without samples has `PADDING_NOISE`, and no bound.
        residual: r, z minus the lobe model's.
        model: z of the lobe model.
        method: The solver and its tolerance on the relative KKT residual.
    """
    lanes = residual.shape[1]
    is_bound = noise < PADDING_NOISE
    root = np.where(is_bound, np.sqrt(noise), 0.0)
    with one_blas_thread():
        raised, dual = residual, inverse @ residual
        unbounded = model + residual - (root**2)[:, None] * dual
        found = NNLSResult(np.zeros_like(residual), *np.zeros((2, lanes), int), np.zeros(lanes))
        if not np.all(unbounded[is_bound] >= 0):
            covariance = np.eye(len(root)) - root[:, None] * inverse * root[None, :]
            rhs = np.where(is_bound[:, None], -unbounded / np.where(is_bound, root, 1.0)[:, None], 0.0)
            found = NNLSResult(*map(np.asarray, _solve_lanes(covariance, rhs, method)))
            raised = residual + root[:, None] * found.value
            dual = inverse @ raised
        # what the linear system is left with, beside what the bound is left with
        misfit = np.abs(prior @ dual + noise[:, None] * dual - raised).max(axis=0)
    size = np.abs(raised).max(axis=0)
    kkt_residual = np.maximum(found.residual, misfit / np.where(size > 0, size, 1.0))
    status = np.where(kkt_residual <= method.tolerance, found.status, np.maximum(found.status, int(Status.MAX_STEPS)))
    return Bounded(dual, found.value, kkt_residual, found.num_steps, status)


def _solve_lanes_on_one_device(covariance, rhs, method: ProjectedNewton) -> NNLSResult:
    return solve_nnls(DenseNormal(covariance), rhs, method)


_solve_lanes = over_lanes(_solve_lanes_on_one_device, axis=-1, shared=(0,), static=(2,))
