"""Batched non-negative least squares with a certificate; knows nothing of BRDFs.

Every lane (column) minimises |A x - b|^2 over x >= 0 with the same A. A problem is given
by its normal equations: an operator that multiplies by A'A, and A'b. The solver is a
projected Newton method: conjugate gradients on the unknowns that are free, then a step
back over the bound, until the free set is right; accelerated projected gradients finish
the lanes where that fails. Its first part may run in float32, at half of the bytes a step.
Whatever a method reports, `kkt_residual` proves the answer.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sbrdf_jax.devices import over_lanes
from sbrdf_jax.records import Status, pytree

ROUND_STEPS = 100  # steps between two looks from the host
POWER_STEPS = 50
LIPSCHITZ_MARGIN = 1.03  # the power iteration approaches the largest eigenvalue from below
FACE_ACCURACY = 0.3  # conjugate gradients stop where the free unknowns' gradient is this share of the bound's violation
FACE_STEPS = 1_000  # conjugate gradients on one set of free unknowns, at most
MAX_STRIKES = 5  # faces that did not lower the objective, before the accelerated gradient takes over
FLOAT32_TOLERANCE = 3e-5  # residual down to which float32 carries; rounding hides what is below

Precision = Literal["float64", "float32"]


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
class ProjectedNewton:
    """Projected Newton with conjugate gradients on the diagonally scaled problem, safeguarded.

    On the unknowns that are free (positive, or pulled off the bound by their gradient) the
    quadratic is minimised as far as the bounds' violation deserves, the point is projected
    on x >= 0, and the free set is taken anew (Bertsekas, 1982). A lane whose objective stops
    falling goes on by accelerated projected gradients, which always converge. A lane
    stops at its own relative KKT residual, so that its answer does not depend on its neighbours.
    """

    tolerance: float = 1e-8
    max_steps: int = 20_000  # of each part
    precision: Precision = "float64"  # "float32": first in float32, as far as it carries; then in that of A'b


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


class NewtonState(NamedTuple):
    """A point of every lane in the scaled unknowns, and how it moves next.

    Along conjugate directions the point may pass the bound; a lane that is `returning`
    takes a full step back to it.
    """

    point: Float[Array, "unknown lane"]
    gradient: Float[Array, "unknown lane"]
    direction: Float[Array, "unknown lane"]
    free: Bool[Array, "unknown lane"]
    returning: Bool[Array, " lane"]
    descent: Float[Array, " lane"]  # squared length of the free gradient
    lowest: Float[Array, " lane"]  # objective
    residual: Float[Array, " lane"]
    strikes: Int[Array, " lane"]
    face_steps: Int[Array, " lane"]
    num_steps: Int[Array, " lane"]


def begin_newton(
    operator: NormalOperator, rhs: Float[Array, "unknown lane"], start: Float[Array, "unknown lane"]
) -> NewtonState:
    """Return the state before the first step from a non-negative start (unscaled)."""
    scale = scale_of(operator)[:, None]
    target, point = rhs / scale, start * scale
    gradient = operator.multiply(start) / scale - target
    free = (point > 0) | (gradient < 0)
    direction = jnp.where(free, -gradient, 0.0)
    count = jnp.zeros(rhs.shape[1], jnp.int32)
    return NewtonState(
        point=point,
        gradient=gradient,
        direction=direction,
        free=free,
        returning=jnp.zeros(rhs.shape[1], bool),
        descent=jnp.sum(direction**2, axis=0),
        lowest=_objective(point, gradient, target),
        residual=_residual(point, gradient, target),
        strikes=count,
        face_steps=count,
        num_steps=count,
    )


def is_moving(state: NewtonState, tolerance: Float[Array, ""], last_step: Int[Array, ""]) -> Bool[Array, " lane"]:
    """Lanes that have neither converged nor been given up nor used their steps."""
    return (state.residual > tolerance) & (state.strikes <= MAX_STRIKES) & (state.num_steps < last_step)


def advance_newton(
    operator: NormalOperator,
    rhs: Float[Array, "unknown lane"],
    state: NewtonState,
    tolerance: Float[Array, ""],
    last_step: Int[Array, ""],
) -> NewtonState:
    """Take steps, one product each, until no lane moves; a lane that has converged stands still."""
    scale = scale_of(operator)[:, None]
    target = rhs / scale
    size = jnp.max(jnp.abs(target), axis=0)
    face_limit = min(FACE_STEPS, 4 * rhs.shape[0] + 20)

    def take_step(state: NewtonState) -> NewtonState:
        moving = is_moving(state, tolerance, last_step)
        image = operator.multiply(state.direction / scale) / scale
        curvature = jnp.sum(state.direction * image, axis=0)
        curved = curvature > 0
        length = jnp.where(curved, state.descent / jnp.where(curved, curvature, 1.0), 0.0)
        length = jnp.where(moving, jnp.where(state.returning, 1.0, length), 0.0)[None, :]
        point = state.point + length * state.direction
        point = jnp.where(state.returning[None, :], jnp.maximum(point, 0.0), point)  # a sum may miss 0 by rounding
        gradient = state.gradient + length * image

        inside = jnp.max(jnp.where(state.free, jnp.abs(gradient), 0.0), axis=0)
        below = jnp.max(jnp.where(state.free, -point, 0.0), axis=0)
        pulled = jnp.max(jnp.where(state.free, 0.0, -gradient), axis=0)
        residual = jnp.where(below > 0, jnp.inf, jnp.maximum(inside, pulled) / size)
        done = residual <= tolerance

        value = _objective(point, gradient, target)
        arrived = moving & state.returning
        face_steps = state.face_steps + 1
        stuck = ~state.returning & (~curved | (face_steps >= face_limit))
        good_enough = (inside <= FACE_ACCURACY * jnp.maximum(below, pulled)) | (inside <= 0.5 * tolerance * size)
        stop = moving & ~state.returning & (good_enough | stuck)
        returning = stop & (below > 0)
        anew = arrived | (stop & (below <= 0))
        free = jnp.where(anew[None, :], (point > 0) | (gradient < 0), state.free)
        descent_direction = jnp.where(free, -gradient, 0.0)
        descent = jnp.sum(descent_direction**2, axis=0)
        weight = jnp.where(anew | (state.descent == 0), 0.0, descent / jnp.where(state.descent > 0, state.descent, 1.0))
        direction = descent_direction + weight[None, :] * state.direction
        direction = jnp.where(returning[None, :], jnp.maximum(point, 0.0) - point, direction)
        strike = (arrived & ~(value < state.lowest)) | (moving & stuck)
        return NewtonState(
            point=point,
            gradient=gradient,
            direction=direction,
            free=free,
            returning=returning,
            descent=descent,
            lowest=jnp.where(arrived, jnp.minimum(value, state.lowest), state.lowest),
            residual=jnp.where(moving, residual, state.residual),
            strikes=state.strikes + (strike & ~done).astype(jnp.int32),
            face_steps=jnp.where(anew | returning, 0, face_steps),
            num_steps=state.num_steps + moving.astype(jnp.int32),
        )

    return jax.lax.while_loop(lambda s: jnp.any(is_moving(s, tolerance, last_step)), take_step, state)


class ProjectedGradientState(NamedTuple):
    """Iterate and momentum point of every lane, in the scaled unknowns, with their images under the matrix."""

    iterate: Float[Array, "unknown lane"]
    image: Float[Array, "unknown lane"]
    point: Float[Array, "unknown lane"]
    point_image: Float[Array, "unknown lane"]
    momentum: Float[Array, " lane"]
    residual: Float[Array, " lane"]
    num_steps: Int[Array, " lane"]


def begin_gradient(
    operator: NormalOperator,
    rhs: Float[Array, "unknown lane"],
    start: Float[Array, "unknown lane"],
    num_steps: Int[Array, " lane"],
) -> ProjectedGradientState:
    """Return the state before the first step from a non-negative start (unscaled), with the steps taken before."""
    scale = scale_of(operator)[:, None]
    iterate = start * scale
    image = operator.multiply(start) / scale
    return ProjectedGradientState(
        iterate=iterate,
        image=image,
        point=iterate,
        point_image=image,
        momentum=jnp.ones(rhs.shape[1], rhs.dtype),
        residual=_residual(iterate, image - rhs / scale, rhs / scale),
        num_steps=num_steps,
    )


def advance_gradient(
    operator: NormalOperator,
    rhs: Float[Array, "unknown lane"],
    state: ProjectedGradientState,
    lipschitz: Float[Array, " lane"],
    tolerance: Float[Array, ""],
    last_step: Int[Array, ""],
) -> ProjectedGradientState:
    """Take Nesterov's steps until every lane has converged or used its steps.

    A lane's momentum restarts where its step opposes the move (O'Donoghue and Candes, 2015).
    """
    scale = scale_of(operator)[:, None]
    target = rhs / scale

    def is_active(state: ProjectedGradientState) -> Bool[Array, " lane"]:
        return (state.residual > tolerance) & (state.num_steps < last_step)

    def take_step(state: ProjectedGradientState) -> ProjectedGradientState:
        active = is_active(state)[None, :]
        iterate = jnp.maximum(state.point - (state.point_image - target) / lipschitz[None, :], 0.0)
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
            residual=jnp.where(active[0], _residual(iterate, image - target, target), state.residual),
            num_steps=state.num_steps + active[0].astype(jnp.int32),
        )

    return jax.lax.while_loop(lambda s: jnp.any(is_active(s)), take_step, state)


def _objective(
    point: Float[Array, "unknown lane"], gradient: Float[Array, "unknown lane"], target: Float[Array, "unknown lane"]
) -> Float[Array, " lane"]:
    return 0.5 * jnp.sum(point * (gradient - target), axis=0)


def _residual(
    iterate: Float[Array, "unknown lane"], gradient: Float[Array, "unknown lane"], target: Float[Array, "unknown lane"]
) -> Float[Array, " lane"]:
    size = jnp.max(jnp.abs(target), axis=0)
    worst = jnp.max(jnp.abs(projected_gradient(iterate, gradient)), axis=0)
    return jnp.where(worst == 0, 0.0, worst / size)


def solve_nnls(
    operator: NormalOperator,
    rhs: Float[Array, "unknown lane"],
    method: ProjectedNewton | JaxoptProjectedGradient | None = None,
    start: Float[Array, "unknown lane"] | None = None,
) -> NNLSResult:
    """Minimise |A x - b|^2 over x >= 0 for every lane; may be used under `jit`, `vmap` and `grad`.

    Args:
        operator: A'A, shared by all lanes.
        rhs: A'b, a column per lane.
        method: `ProjectedNewton` (the default) or `JaxoptProjectedGradient`.
        start: Where to start, non-negative; 0 unless given. Not used by jaxopt's method.

    Returns:
        Value, status, steps and relative KKT residual of every lane. A lane whose A'b is
        not finite is nan with status NONFINITE; one that runs out of steps is MAX_STEPS.

    Numerics:
        The derivative is that of the solution, by the implicit function theorem on the
        unknowns that are not at their bound (conjugate gradients), not that of the steps.
    """
    method = ProjectedNewton() if method is None else method
    finite, safe = _finite_part(rhs)
    start, begun = _feasible(start, safe), jnp.zeros(rhs.shape[1], jnp.int32)
    if isinstance(method, ProjectedNewton) and method.precision == "float32":
        single = jax.lax.stop_gradient(_in_float32(operator, safe, start))
        start, begun = _out_of_float32(*_solution(*single, _float32_method(method)), safe)
    value, num_steps = _solution(operator, safe, start, method)
    residual = jnp.where(finite, kkt_residual(operator, rhs, value), jnp.nan)
    return _judged(value, begun + num_steps, residual, method.tolerance)


def _float32_method(method: ProjectedNewton) -> ProjectedNewton:
    tolerance = max(method.tolerance, FLOAT32_TOLERANCE)
    return dataclasses.replace(method, tolerance=tolerance, precision="float64")


def _lane_size(rhs):
    size = jnp.max(jnp.abs(rhs), axis=0)
    return jnp.where(size > 0, size, 1.0)


@jax.jit
def _in_float32(operator, rhs, start):
    """Return a problem in float32 with lanes of size 1, which neither overflow nor vanish."""
    size = _lane_size(rhs)[None, :]
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if leaf.dtype == rhs.dtype else leaf, operator)
    return single, (rhs / size).astype(jnp.float32), (start / size).astype(jnp.float32)


@jax.jit
def _out_of_float32(value, num_steps, rhs):
    """Return a start for the problem as it was, and the steps that were taken for it."""
    return _feasible(value.astype(rhs.dtype) * _lane_size(rhs)[None, :], rhs), num_steps


def _finite_part(rhs):
    finite = jnp.all(jnp.isfinite(rhs), axis=0)
    return finite, jnp.where(finite[None, :], rhs, 0.0)


def _feasible(start, rhs):
    if start is None:
        return jnp.zeros_like(rhs)
    return jax.lax.stop_gradient(jnp.where(jnp.isfinite(start), jnp.maximum(start, 0.0), 0.0))


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def _solution(operator, rhs, start, method):
    scale = scale_of(operator)
    if isinstance(method, JaxoptProjectedGradient):
        return _jaxopt_solution(operator, rhs, scale, largest_eigenvalue(operator, scale), method)
    tolerance, last_step = jnp.asarray(method.tolerance, rhs.dtype), jnp.asarray(method.max_steps, jnp.int32)
    newton = advance_newton(operator, rhs, begin_newton(operator, rhs, start), tolerance, last_step)
    state, lipschitz = _hand_over(operator, rhs, newton, tolerance)
    state = advance_gradient(operator, rhs, state, lipschitz, tolerance, last_step)
    return state.iterate / scale[:, None], state.num_steps


def _hand_over(operator, rhs, newton, tolerance):
    """Judge the Newton point by a fresh product; what it lacks is left to the accelerated gradient.

    Returns:
        Its state, and the Lipschitz constant for each lane: the largest eigenvalue, 1 where all have converged.
    """
    scale = scale_of(operator)
    state = begin_gradient(operator, rhs, jnp.maximum(newton.point, 0.0) / scale[:, None], newton.num_steps)
    lipschitz = jax.lax.cond(
        jnp.all(state.residual <= tolerance),
        lambda: jnp.ones((), rhs.dtype),
        lambda: largest_eigenvalue(operator, scale),
    )
    return state, jnp.broadcast_to(lipschitz, rhs.shape[1:])


def _solution_forward(operator, rhs, start, method):
    value, num_steps = _solution(operator, rhs, start, method)
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
    return pull(-adjoint)[0], adjoint, jnp.zeros_like(value)


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
    method: ProjectedNewton,
    report: Callable[[int, int], None] | None = None,
    start: Float[Array, "unknown lane"] | None = None,
) -> NNLSResult:
    """`solve_nnls` driven from the host: tells how many lanes have converged as it goes.

    The steps, and so the answer, are those of `solve_nnls`.

    Args:
        operator: A'A, shared by all lanes.
        rhs: A'b, a column per lane.
        method: Tolerance and step limit.
        report: Called after each round with the number of lanes done and of all lanes.
        start: Where to start, non-negative; 0 unless given.
    """
    rhs = jnp.asarray(rhs)
    if method.precision == "float32":
        _, safe = _finite_part(rhs)
        single = _in_float32(operator, safe, _feasible(start, safe))
        none_yet = None if report is None else (lambda _, total: report(0, total))
        first = solve_in_rounds(*single[:2], _float32_method(method), none_yet, single[2])
        start, begun = _out_of_float32(first.value, first.num_steps, safe)
        found = solve_in_rounds(operator, rhs, dataclasses.replace(method, precision="float64"), report, start)
        return found._replace(num_steps=found.num_steps + begun)
    tolerance = jnp.asarray(method.tolerance, rhs.dtype)
    state, safe = _begin(operator, rhs, start)
    limits = [min(n + ROUND_STEPS, method.max_steps) for n in range(0, method.max_steps, ROUND_STEPS)]

    def tell(state) -> np.ndarray:
        done = np.asarray(state.residual <= tolerance)
        if report is not None:
            report(int(done.sum()), len(done))
        return done

    for limit in limits:
        state = _newton_round(operator, safe, state, tolerance, jnp.asarray(limit, jnp.int32))
        if not np.any(is_moving(state, tolerance, jnp.asarray(method.max_steps, jnp.int32))):
            break
        tell(state)
    state, lipschitz = _checked(operator, safe, state, tolerance)
    for limit in limits:
        if np.all(tell(state)):
            break
        state = _gradient_round(operator, safe, state, lipschitz, tolerance, jnp.asarray(limit, jnp.int32))
    return _end(operator, rhs, state, tolerance)


@functools.partial(over_lanes, axis=-1, shared=(0,))
def _begin(operator, rhs, start):
    _, safe = _finite_part(rhs)
    return begin_newton(operator, safe, _feasible(start, safe)), safe


_newton_round = over_lanes(advance_newton, axis=-1, shared=(0, 3, 4))
_gradient_round = over_lanes(advance_gradient, axis=-1, shared=(0, 4, 5))
_checked = over_lanes(_hand_over, axis=-1, shared=(0, 3))


@functools.partial(over_lanes, axis=-1, shared=(0, 3))
def _end(operator, rhs, state, tolerance):
    finite, _ = _finite_part(rhs)
    value = state.iterate / scale_of(operator)[:, None]
    residual = jnp.where(finite, kkt_residual(operator, rhs, value), jnp.nan)
    return _judged(value, state.num_steps, residual, tolerance)


def _judged(value, num_steps, residual, tolerance) -> NNLSResult:
    finite = jnp.isfinite(residual) & jnp.all(jnp.isfinite(value), axis=0)
    status = jnp.where(residual <= tolerance, int(Status.OK), int(Status.MAX_STEPS))
    status = jnp.where(finite, status, int(Status.NONFINITE)).astype(jnp.int32)
    return NNLSResult(jnp.where(finite[None, :], value, jnp.nan), status, num_steps, residual)
