"""Height and width of very many lobes at once: a bank of widths by matrix products, then guarded Newton steps.

For a width, the best height is a ratio of two sums, so only the width is sought. The bank finds
the best of all local optima; the steps that follow are few, the same number for every lane, so
that no lane waits for another. A lane never ends worse than its best width of the bank.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

STEPS = 4  # the first to the vertex of a parabola through the bank's best, then Newton's
SMALLEST = 1e-300
ROUNDING = 8  # machine epsilons of a gain by which a step may lose


class BankLobes(NamedTuple):
    """Fitted lobes."""

    height: Float[Array, "group lane"]
    width: Float[Array, "group lane"]
    error: Float[Array, "group lane"]  # weighted sum of squares that the lobe leaves
    promised: Float[Array, "group lane"]  # what one more step would take off it


@jax.jit
def fit_lobe_bank(
    target: Float[Array, "group lane direction"],
    weight: Float[Array, "group lane direction"],
    exponent: Float[Array, "group direction"],
    widths: Float[Array, "group width"],
) -> BankLobes:
    """Fit target ~ height * exp(-exponent / width) in every lane, by weighted least squares.

    Args:
        target: What is to be fitted, of any sign.
        weight: 0 or more; 0 where a direction takes no part.
        exponent: s(alpha) of eqs. (14) to (16), the same for all lanes of a group.
        widths: The bank, log-spaced; the width stays between its ends.

    Numerics:
        With A = sum of weight * target * shape and G = sum of weight * shape^2, the error falls by
        A^2 / G, whose logarithm is maximised over the logarithm of the width by Newton's method
        between the neighbours of the bank's best; a step that loses is halved. A lane of
        zeros, or without weight, has height 0; one that is not finite stays so and harms no other.
    """
    return jax.lax.map(lambda group: _fit_group(*group), (target, weight, exponent, widths))


def _fit_group(target, weight, exponent, widths):
    shapes = jnp.exp(-exponent[None] / widths[:, None])
    moment = weight * target
    along, energy = moment @ shapes.T, weight @ (shapes**2).T
    gain = along**2 / jnp.maximum(energy, SMALLEST)
    last = widths.shape[0] - 1
    best = jnp.argmax(gain, axis=1)
    three = jnp.clip(jnp.stack([best - 1, best, best + 1], axis=1), 0, last)
    bank = jnp.log(widths)
    low, log_width, high = bank[three].T
    below, top, above = jnp.take_along_axis(gain, three, axis=1).T
    bend = below - 2 * top + above  # a parabola through the three, where there are three
    is_inside = (best > 0) & (best < last) & (bend < 0)
    move = jnp.where(is_inside, (below - above) / jnp.where(is_inside, bend, 1.0) * (high - low) / 4, 0.0)
    move = jnp.where(best == 0, (high - low) / 2, jnp.where(best == last, (low - high) / 2, move))

    def step(state, _):
        log_width, at, move = state
        trial = jnp.clip(log_width + move, low, high)
        found = _gain(trial, moment, weight, exponent)
        better = found.gain >= at.gain * (1 - ROUNDING * jnp.finfo(found.gain.dtype).eps)  # flat at the top
        at = jax.tree.map(lambda new, old: jnp.where(better, new, old), found, at)
        log_width = jnp.where(better, trial, log_width)
        return (log_width, at, jnp.where(better, _newton(at, high - low), move / 2)), None

    height = jnp.take_along_axis(along / jnp.maximum(energy, SMALLEST), best[:, None], axis=1)[:, 0]
    start = _Gain(top, height, jnp.full_like(top, jnp.inf), -jnp.ones_like(top))  # a slope that no step has shown
    (log_width, at, _), _ = jax.lax.scan(step, (log_width, start, move), None, length=STEPS)
    error = jnp.maximum(jnp.sum(moment * target, axis=1) - at.gain, 0.0)
    outward = ((log_width <= bank[0]) & (at.slope <= 0)) | ((log_width >= bank[-1]) & (at.slope >= 0))
    promised = at.gain * at.slope**2 / jnp.maximum(2 * jnp.abs(at.bend), SMALLEST)
    return BankLobes(at.height, jnp.exp(log_width), error, jnp.where(outward, 0.0, promised))


class _Gain(NamedTuple):
    """What a lobe of one width takes off a lane's error, its height, and two derivatives of log gain by log width."""

    gain: Any
    height: Any
    slope: Any
    bend: Any


def _newton(at, span):
    """Return the step to the maximum of a parabola, or uphill where it opens upwards."""
    is_peak = at.bend < 0
    return jnp.where(is_peak, -at.slope / jnp.where(is_peak, at.bend, 1.0), jnp.sign(at.slope) * span / 4)


def _gain(log_width, moment, weight, exponent) -> _Gain:
    """Return A^2 / G and its like, by one pass over the directions."""
    scaled = exponent[None] * jnp.exp(-log_width)[:, None]
    shape = jnp.exp(-scaled)
    first = moment * shape
    second = weight * shape * shape
    a, a_1, a_2 = first.sum(axis=1), (first * scaled).sum(axis=1), (first * scaled * scaled).sum(axis=1)
    g, g_1, g_2 = second.sum(axis=1), (second * scaled).sum(axis=1), (second * scaled * scaled).sum(axis=1)
    safe_a, safe_g = jnp.where(a == 0, 1.0, a), jnp.maximum(g, SMALLEST)
    slope = 2 * a_1 / safe_a - 2 * g_1 / safe_g
    bend = 2 * ((a_2 - a_1) / safe_a - (a_1 / safe_a) ** 2)
    bend -= (4 * g_2 - 2 * g_1) / safe_g - (2 * g_1 / safe_g) ** 2
    return _Gain(a * a / safe_g, a / safe_g, slope, bend)
