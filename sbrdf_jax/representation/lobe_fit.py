"""Height and width of lobes by Levenberg-Marquardt (section 4.2), from what a bank of widths found."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sbrdf_jax.records import Status

BANK_SIZE = 48
WIDEST = 30.0  # beyond it no grid tells a lobe from a constant and a slope
NARROWEST_DROP = 1000.0  # the narrowest lobe falls by this factor within one step of the grid
MAX_STEPS = 12
TOLERANCE = 1e-7  # of the largest target
# Levenberg-Marquardt starts with damping 1: too much beside an optimum for residuals of size 1,
# while 1e3 would take a dozen rejected steps before damping is felt at all.
RESIDUAL_SCALE = 1e2
STATIONARY = 1e-6  # share of the squared error that one more step may promise
NOISE_POWER = 0.6  # a residual below epsilon to this power (4e-10 in float64), of the largest target, is noise


class Lobe(NamedTuple):
    """One fitted lobe, or many in arrays of equal shape; JAX or NumPy."""

    height: Any
    width: Any
    status: Any  # Status
    num_steps: Any
    error: Any  # weighted sum of squares over all directions


def width_bank(exponent_of_step: float) -> Float[np.ndarray, " width"]:
    """Return log-spaced widths from the narrowest that a grid shows, by s(alpha) at one step of it."""
    return np.geomspace(exponent_of_step / np.log(NARROWEST_DROP), WIDEST, BANK_SIZE)


@jax.custom_jvp
def _weighted_lobe(height, log_width, root_weight, exponent):
    return height * root_weight * jnp.exp(-exponent * jnp.exp(-log_width))


@_weighted_lobe.defjvp
def _weighted_lobe_jvp(primals, tangents):
    # the two columns written out: a third less work in each step of the solver than by autodiff
    height, log_width, root_weight, exponent = primals
    scaled = exponent * jnp.exp(-log_width)
    by_height = root_weight * jnp.exp(-scaled)
    value = height * by_height
    return value, by_height * tangents[0] + value * scaled * tangents[1]


def fit_lobe(
    target: Float[Array, " direction"],
    inside: Bool[Array, " direction"],
    exponent: Float[Array, " direction"],
    weight: Float[Array, " direction"],
    start: tuple[Float[Array, ""], Float[Array, ""]],
    width_range: Float[Array, "2"],
) -> Lobe:
    """Fit eqs. (14) to (16) to one lane: target ~ height * exp(-exponent / width) inside the critical angle.

    Args:
        target: What the background leaves, about 1 at its largest.
        inside: Directions that take part.
        exponent: s(alpha) of the lobe's kind.
        weight: How often each direction counts.
        start: Height and width to start from.
        width_range: Least and greatest width.

    Returns:
        The lobe, no worse than its start. Status CLAMPED where the width is the least one,
        MAX_STEPS where one more step promises a lower error, NONFINITE.

    Numerics:
        The unknowns are the height, of any sign, and the logarithm of the width, clipped. What
        the solver says of itself is not believed: at the rounding level it rejects steps until
        it runs out of them, so the status follows from the gradient.
    """
    import lineax as lx  # half a second that most runs need not wait for
    import optimistix as optx

    narrowest, widest = jnp.log(width_range[0]), jnp.log(width_range[1])
    root_weight = RESIDUAL_SCALE * jnp.sqrt(jnp.where(inside, weight, 0.0))
    weighted_target = root_weight * target

    def residual(unknown, _):
        height, log_width = unknown
        log_width = jnp.clip(log_width, narrowest, widest)
        return _weighted_lobe(height, log_width, root_weight, exponent) - weighted_target

    start = (start[0], jnp.log(start[1]))
    solver = optx.LevenbergMarquardt(TOLERANCE, TOLERANCE * RESIDUAL_SCALE, linear_solver=lx.Normal(lx.Cholesky()))
    solution = optx.least_squares(residual, solver, start, max_steps=MAX_STEPS, throw=False)
    before, after = (jnp.sum(residual(x, None) ** 2) for x in (start, solution.value))
    height, log_width = (jnp.where(after <= before, a, b) for a, b in zip(solution.value, start, strict=True))
    log_width = jnp.clip(log_width, narrowest, widest)
    width = jnp.exp(log_width)
    error = jnp.sum(weight * (target - height * jnp.exp(-exponent / width)) ** 2)
    status = _certify(residual, height, log_width, narrowest, widest)
    return Lobe(height, width, status, solution.stats["num_steps"], error)


def _certify(residual, height, log_width, narrowest, widest):
    """Return the status of a lane: how much of its squared error would one Gauss-Newton step take off?"""
    one = jnp.ones_like(height)
    left, by_height = jax.jvp(lambda x: residual((x, log_width), None), (height,), (one,))
    by_width = jax.jvp(lambda x: residual((height, x), None), (log_width,), (one,))[1]
    squared = jnp.sum(left**2)
    eps = jnp.finfo(squared.dtype).eps

    # the part of `left` along both columns, by Gram-Schmidt; at an edge the width has no say
    is_narrowest = log_width <= narrowest
    along_height = _share(by_height, left)
    by_width = by_width - by_height * (by_height @ by_width) / jnp.maximum(jnp.sum(by_height**2), eps)
    along_width = jnp.where(is_narrowest | (log_width >= widest), 0.0, _share(by_width, left))
    noise = (RESIDUAL_SCALE * eps**NOISE_POWER) ** 2
    is_done = along_height + along_width <= STATIONARY * squared + noise
    status = jnp.where(is_done, int(Status.OK), int(Status.MAX_STEPS))
    status = jnp.where(is_done & is_narrowest, int(Status.CLAMPED), status)
    return jnp.where(jnp.isfinite(squared), status, int(Status.NONFINITE))


def _share(column, vector):
    """Return the squared length of a vector's part along a column."""
    squared = jnp.sum(column**2)
    return (column @ vector) ** 2 / jnp.where(squared > 0, squared, 1.0)
