"""Batched non-negative least squares with a certificate; knows nothing of BRDFs.

Every lane (column) minimises |A x - b|^2 over x >= 0 with the same A. A problem is given
by its normal equations: an operator that multiplies by A'A, and A'b. Two methods answer
to the same call; whatever they report, `kkt_residual` proves the answer.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sbrdf_jax.records import Status, pytree

ROUND_STEPS = 100  # steps between two looks from the host
POWER_STEPS = 50
LIPSCHITZ_MARGIN = 1.03  # the power iteration approaches the largest eigenvalue from below


@runtime_checkable
class NormalOperator(Protocol):
    """A symmetric positive semi-definite A'A; a pytree, so that one compilation serves many."""

    def multiply(self, x: Float[Array, "unknown lane"]) -> Float[Array, "unknown lane"]:
        """Return A'A x."""
        ...

    def diagonal(self) -> Float[Array, " unknown"]:
        """Return the diagonal of A'A; 0 for an unknown that no row touches."""
        ...


class NNLSResult(NamedTuple):
    """Answer of `solve_nnls`, a column or entry per lane."""

    value: Float[Array, "unknown lane"]
    status: Int[Array, " lane"]
    num_steps: Int[Array, " lane"]
    residual: Float[Array, " lane"]


@pytree(static=())
class DenseNormal:
    """A'A held as a matrix."""

    matrix: Any  # [unknown, unknown]

    def multiply(self, x: Float[Array, "unknown lane"]) -> Float[Array, "unknown lane"]:
        """Return A'A x."""
        return self.matrix @ x

    def diagonal(self) -> Float[Array, " unknown"]:
        """Return the diagonal of A'A."""
        return jnp.diagonal(self.matrix)


@dataclasses.dataclass(frozen=True)
class AcceleratedProjectedGradient:
    """Nesterov's projected gradient on the diagonally scaled problem, restarted lane by lane.

    A lane's momentum restarts where its step opposes the move (O'Donoghue and Candes,
    2015), and a lane stops at its own relative KKT residual, so that its answer does not
    depend on its neighbours.
    """

    tolerance: float = 1e-8
    max_steps: int = 20_000


@dataclasses.dataclass(frozen=True)
class JaxoptProjectedGradient:
    """`jaxopt.ProjectedGradient` on the same scaled problem, one lane at a time under `vmap`.

    Its tolerance is on its own measure, the length of a projected step, not on the KKT residual.
    """

    tolerance: float = 1e-8
    max_steps: int = 3_000


def scale_of(operator: NormalOperator) -> Float[Array, " unknown"]:
    """Return d = sqrt(diag A'A), 1 for an unknown that no row touches."""
    diagonal = operator.diagonal()
    return jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))


def projected_gradient(
    x: Float[Array, "unknown lane"], gradient: Float[Array, "unknown lane"]
) -> Float[Array, "unknown lane"]:
    """Return the gradient where x > 0, and only its negative part where x = 0."""
    return jnp.where(x > 0, gradient, jnp.minimum(gradient, 0.0))


def kkt_residual(
    operator: NormalOperator, rhs: Float[Array, "unknown lane"], x: Float[Array, "unknown lane"]
) -> Float[Array, " lane"]:
    """Relative KKT residual of stored solutions: max |p_j| / d_j over max |(A'b)_j| / d_j; 0 where b = 0.

    p is the projected gradient of 1/2 |A x - b|^2 and d = sqrt(diag A'A). An infeasible
    or non-finite x gives infinity or nan: nothing is clipped before it is judged.
    """
    scale = scale_of(operator)[:, None]
    size = jnp.max(jnp.abs(rhs) / scale, axis=0)
    worst = jnp.max(jnp.abs(projected_gradient(x, operator.multiply(x) - rhs)) / scale, axis=0)
    worst = jnp.where(jnp.any(x < 0, axis=0), jnp.inf, worst)
    return jnp.where((size == 0) & (worst == 0), 0.0, worst / size)


def largest_eigenvalue(operator: NormalOperator, scale: Float[Array, " unknown"]) -> Float[Array, ""]:
    """Largest eigenvalue of the diagonally scaled A'A by power iteration with a small margin."""
    start = 1.0 + 0.5 * jnp.cos(jnp.arange(scale.shape[0], dtype=scale.dtype) * 2.39996)

    def step(_, carry):
        vector, _ = carry
        image = operator.multiply((vector / scale)[:, None])[:, 0] / scale
        norm = jnp.linalg.norm(image)
        return image / jnp.where(norm > 0, norm, 1.0), norm

    _, norm = jax.lax.fori_loop(0, POWER_STEPS, step, (start / jnp.linalg.norm(start), jnp.zeros((), scale.dtype)))
    return jnp.where(norm > 0, norm, 1.0) * LIPSCHITZ_MARGIN


class ProjectedGradientState(NamedTuple):
    """Iterate and momentum point of every lane, in the scaled unknowns, with their images under the matrix."""

    iterate: Float[Array, "unknown lane"]
    image: Float[Array, "unknown lane"]
    point: Float[Array, "unknown lane"]
    point_image: Float[Array, "unknown lane"]
    momentum: Float[Array, " lane"]
    residual: Float[Array, " lane"]
    num_steps: Int[Array, " lane"]
    step: Int[Array, ""]


def start_state(
    operator: NormalOperator, rhs: Float[Array, "unknown lane"], start: Float[Array, "unknown lane"]
) -> ProjectedGradientState:
    """Return the state before the first step from a non-negative start (unscaled)."""
    scale = scale_of(operator)[:, None]
    iterate = start * scale
    image = operator.multiply(start) / scale
    lanes = rhs.shape[1]
    return ProjectedGradientState(
        iterate=iterate,
        image=image,
        point=iterate,
        point_image=image,
        momentum=jnp.ones(lanes, rhs.dtype),
        residual=_residual(iterate, image, rhs / scale),
        num_steps=jnp.zeros(lanes, jnp.int32),
        step=jnp.zeros((), jnp.int32),
    )


def advance(
    operator: NormalOperator,
    rhs: Float[Array, "unknown lane"],
    state: ProjectedGradientState,
    lipschitz: Float[Array, ""],
    tolerance: Float[Array, ""],
    last_step: Int[Array, ""],
) -> ProjectedGradientState:
    """Take steps until every lane has converged or `last_step` is reached; lanes that have converged stand still."""
    scale = scale_of(operator)[:, None]
    target = rhs / scale

    def wanted(state: ProjectedGradientState) -> Bool[Array, ""]:
        return (state.step < last_step) & jnp.any(state.residual > tolerance)

    def take_step(state: ProjectedGradientState) -> ProjectedGradientState:
        active = (state.residual > tolerance)[None, :]
        iterate = jnp.maximum(state.point - (state.point_image - target) / lipschitz, 0.0)
        iterate = jnp.where(active, iterate, state.iterate)
        image = operator.multiply(iterate / scale) / scale
        image = jnp.where(active, image, state.image)
        move = iterate - state.iterate
        opposed = jnp.sum((state.point - iterate) * move, axis=0) > 0
        momentum = jnp.where(opposed, 1.0, (1 + jnp.sqrt(1 + 4 * state.momentum**2)) / 2)
        weight = jnp.where(opposed, 0.0, (state.momentum - 1) / momentum)[None, :]
        return ProjectedGradientState(
            iterate=iterate,
            image=image,
            point=iterate + weight * move,
            point_image=image + weight * (image - state.image),
            momentum=momentum,
            residual=jnp.where(active[0], _residual(iterate, image, target), state.residual),
            num_steps=state.num_steps + active[0].astype(jnp.int32),
            step=state.step + 1,
        )

    return jax.lax.while_loop(wanted, take_step, state)


def _residual(
    iterate: Float[Array, "unknown lane"], image: Float[Array, "unknown lane"], target: Float[Array, "unknown lane"]
) -> Float[Array, " lane"]:
    size = jnp.max(jnp.abs(target), axis=0)
    worst = jnp.max(jnp.abs(projected_gradient(iterate, image - target)), axis=0)
    return jnp.where(worst == 0, 0.0, worst / size)


def solve_nnls(
    operator: NormalOperator,
    rhs: Float[Array, "unknown lane"],
    method: AcceleratedProjectedGradient | JaxoptProjectedGradient | None = None,
) -> NNLSResult:
    """Minimise |A x - b|^2 over x >= 0 for every lane; may be used under `jit`, `vmap` and `grad`.

    Args:
        operator: A'A, shared by all lanes.
        rhs: A'b, a column per lane.
        method: `AcceleratedProjectedGradient` (the default) or `JaxoptProjectedGradient`.

    Returns:
        Value, status, steps and relative KKT residual of every lane. A lane whose A'b is
        not finite is nan with status NONFINITE; one that runs out of steps is MAX_STEPS.

    Numerics:
        The derivative is that of the solution, by the implicit function theorem on the
        unknowns that are not at their bound (conjugate gradients), not that of the steps.
    """
    method = AcceleratedProjectedGradient() if method is None else method
    finite = jnp.all(jnp.isfinite(rhs), axis=0)
    value, num_steps = _solution(operator, jnp.where(finite[None, :], rhs, 0.0), method)
    residual = jnp.where(finite, kkt_residual(operator, rhs, value), jnp.nan)
    return _judged(value, num_steps, residual, method.tolerance)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _solution(operator, rhs, method):
    scale = scale_of(operator)
    lipschitz = largest_eigenvalue(operator, scale)
    if isinstance(method, JaxoptProjectedGradient):
        return _jaxopt_solution(operator, rhs, scale, lipschitz, method)
    state = start_state(operator, rhs, jnp.zeros_like(rhs))
    last_step = jnp.asarray(method.max_steps, jnp.int32)
    state = advance(operator, rhs, state, lipschitz, jnp.asarray(method.tolerance, rhs.dtype), last_step)
    return state.iterate / scale[:, None], state.num_steps


def _solution_forward(operator, rhs, method):
    value, num_steps = _solution(operator, rhs, method)
    return (value, num_steps), (operator, value)


def _solution_backward(method, saved, cotangent):
    # On the free unknowns A'A x = A'b; so d(A'b) solves A'A d = cotangent there, and d(A'A) = -d x'.
    operator, value = saved
    free = (value > 0).astype(value.dtype)
    scale = scale_of(operator)[:, None]

    def restricted(scaled):
        return free * operator.multiply(free * scaled / scale) / scale + (1 - free) * scaled

    adjoint, _ = jax.scipy.sparse.linalg.cg(restricted, free * cotangent[0] / scale, tol=1e-13, maxiter=10_000)
    adjoint = free * adjoint / scale
    _, pull = jax.vjp(lambda op: op.multiply(value), operator)
    return pull(-adjoint)[0], adjoint


_solution.defvjp(_solution_forward, _solution_backward)


def _jaxopt_solution(operator, rhs, scale, lipschitz, method):
    from jaxopt import ProjectedGradient
    from jaxopt.projection import projection_non_negative

    def objective(scaled, target):
        image = operator.multiply((scaled / scale)[:, None])[:, 0] / scale
        return 0.5 * jnp.vdot(scaled, image) - jnp.vdot(scaled, target)

    solver = ProjectedGradient(
        objective,
        projection_non_negative,
        stepsize=lambda _step: 1 / lipschitz,  # a number must be concrete there, a function need not
        tol=method.tolerance,
        maxiter=method.max_steps,
        implicit_diff=False,
    )

    def solve_lane(target):
        size = jnp.max(jnp.abs(target))
        found = solver.run(jnp.zeros_like(target), target=target / jnp.where(size > 0, size, 1.0))
        return found.params * size, found.state.iter_num.astype(jnp.int32)

    scaled, steps = jax.vmap(solve_lane, in_axes=1, out_axes=(1, 0))(rhs / scale[:, None])
    return scaled / scale[:, None], steps


def solve_in_rounds(
    operator: NormalOperator,
    rhs: Float[Array, "unknown lane"],
    method: AcceleratedProjectedGradient,
    report: Callable[[int, int], None] | None = None,
) -> NNLSResult:
    """`solve_nnls` driven from the host: tells how many lanes have converged as it goes.

    The steps, and so the answer, are those of `solve_nnls`.

    Args:
        operator: A'A, shared by all lanes.
        rhs: A'b, a column per lane.
        method: Tolerance and step limit.
        report: Called after each round with the number of lanes done and of all lanes.
    """
    rhs = jnp.asarray(rhs)
    finite = np.isfinite(np.asarray(rhs)).all(axis=0)
    tolerance = jnp.asarray(method.tolerance, rhs.dtype)
    state, lipschitz, safe = _begin(operator, rhs)
    for last_step in range(ROUND_STEPS, method.max_steps + ROUND_STEPS, ROUND_STEPS):
        limit = jnp.asarray(min(last_step, method.max_steps), jnp.int32)
        state = _round(operator, safe, state, lipschitz, tolerance, limit)
        done = np.asarray(state.residual <= tolerance)
        if report is not None:
            report(int(done.sum()), len(done))
        if np.all(done | ~np.asarray(state.residual > tolerance)):
            break
    return _end(operator, rhs, state, jnp.asarray(finite), tolerance)


@jax.jit
def _begin(operator, rhs):
    safe = jnp.where(jnp.all(jnp.isfinite(rhs), axis=0, keepdims=True), rhs, 0.0)
    state = start_state(operator, safe, jnp.zeros_like(safe))
    return state, largest_eigenvalue(operator, scale_of(operator)), safe


_round = jax.jit(advance)


@jax.jit
def _end(operator, rhs, state, finite, tolerance):
    value = state.iterate / scale_of(operator)[:, None]
    residual = jnp.where(finite, kkt_residual(operator, rhs, value), jnp.nan)
    return _judged(value, state.num_steps, residual, tolerance)


def _judged(value, num_steps, residual, tolerance) -> NNLSResult:
    finite = jnp.isfinite(residual) & jnp.all(jnp.isfinite(value), axis=0)
    status = jnp.where(residual <= tolerance, int(Status.OK), int(Status.MAX_STEPS))
    status = jnp.where(finite, status, int(Status.NONFINITE)).astype(jnp.int32)
    return NNLSResult(jnp.where(finite[None, :], value, jnp.nan), status, num_steps, residual)
