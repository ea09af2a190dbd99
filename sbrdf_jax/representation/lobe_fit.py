"""Height and width of one lobe by Levenberg-Marquardt, from the best of a bank of widths (section 4.2)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from sbrdf_jax.records import Status

BANK_SIZE = 48
WIDEST = 30.0  # beyond it a lobe is a constant to the eye of any grid
NARROWEST_DROP = 1000.0  # the narrowest lobe falls by this factor within one step of the grid
MAX_STEPS = 64
# Multiplies the residuals, whose largest is about 1: Levenberg-Marquardt starts with damping 1,
# which is far too much for a start that lies beside the optimum.
RESIDUAL_SCALE = 1e4
STATIONARY = 1e-6  # cosine between the residual and each column of the Jacobian


class Lobe(NamedTuple):
    """One fitted lobe, or many in arrays of equal shape."""

    height: Float[Array, "*shape"]
    width: Float[Array, "*shape"]
    status: Int[Array, "*shape"]  # Status
    num_steps: Int[Array, "*shape"]


def width_bank(exponent_of_step: float) -> Float[np.ndarray, " width"]:
    """Return log-spaced widths from the narrowest that a grid shows, by s(alpha) at one step of it."""
    return np.geomspace(exponent_of_step / np.log(NARROWEST_DROP), WIDEST, BANK_SIZE)


def best_start(
    target: Float[Array, " direction"],
    weight: Float[Array, " direction"],
    exponent: Float[Array, " direction"],
    widths: Float[Array, " width"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return height and width of the bank's best lobe; for each width, the best height is a ratio of two sums."""
    shape = jnp.exp(-exponent[None, :] / widths[:, None])
    along, energy = shape @ (weight * target), (shape * shape) @ weight
    height = along / jnp.where(energy > 0, energy, 1.0)
    best = jnp.argmax(height * along)
    return height[best], widths[best]


def fit_lobe(
    target: Float[Array, " direction"],
    weight: Float[Array, " direction"],
    exponent: Float[Array, " direction"],
    widths: Float[Array, " width"],
) -> Lobe:
    """Fit eqs. (14) to (16) to one lane: target ~ height * exp(-exponent / width).

    Args:
        target: What the background leaves, about 1 at its largest.
        weight: How often each direction counts, 0 outside the critical angle.
        exponent: s(alpha) of the lobe's kind.
        widths: From `width_bank`; its ends bound the width.

    Returns:
        The lobe, no worse than the best of the bank. Status CLAMPED where the width is the
        narrowest one, MAX_STEPS where the residual is not yet orthogonal to the Jacobian.

    Numerics:
        The unknowns are the height, of any sign, and the logarithm of the width, clipped. What
        the solver says of itself is not believed: at the rounding level it rejects steps until
        it runs out of them, so the status follows from the gradient.
    """
    narrowest, widest = jnp.log(widths[0]), jnp.log(widths[-1])
    root_weight = jnp.sqrt(weight)

    def residual(unknown, _):
        height, log_width = unknown
        lobe = height * jnp.exp(-exponent / jnp.exp(jnp.clip(log_width, narrowest, widest)))
        return RESIDUAL_SCALE * root_weight * (lobe - target)

    height, width = best_start(target, weight, exponent, widths)
    start = (height, jnp.log(width))
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8, linear_solver=lx.QR())
    solution = optx.least_squares(residual, solver, start, max_steps=MAX_STEPS, throw=False)
    before, after = (jnp.sum(residual(x, None) ** 2) for x in (start, solution.value))
    height, log_width = jax.tree.map(lambda a, b: jnp.where(after <= before, a, b), solution.value, start)
    log_width = jnp.clip(log_width, narrowest, widest)
    left = residual((height, log_width), None)
    status = _certify(height, log_width, left, root_weight, exponent, narrowest, widest)
    return Lobe(height, jnp.exp(log_width), status, solution.stats["num_steps"])


def _certify(height, log_width, left, root_weight, exponent, narrowest, widest):
    """Return the status of a lane from its gradient."""
    scaled = exponent / jnp.exp(log_width)
    by_height = root_weight * jnp.exp(-scaled)
    by_width = by_height * scaled
    size = jnp.sqrt(jnp.sum(left**2)) + RESIDUAL_SCALE * 1e-9

    def is_orthogonal(column):
        return jnp.abs(column @ left) <= STATIONARY * jnp.sqrt(jnp.sum(column**2)) * size

    is_narrowest, is_widest = log_width <= narrowest, log_width >= widest
    is_done = is_orthogonal(by_height) & (is_orthogonal(by_width) | is_narrowest | is_widest)
    status = jnp.where(is_done, int(Status.OK), int(Status.MAX_STEPS))
    status = jnp.where(is_done & is_narrowest, int(Status.CLAMPED), status)
    return jnp.where(jnp.isfinite(left).all() & jnp.isfinite(height), status, int(Status.NONFINITE))
