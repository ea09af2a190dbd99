"""The search of section 4.2 over critical angles and kinds of lobe, all lanes in equal-shaped batches.

A pair is one coefficient of one incident angle; a lane is a pair with one critical angle and
one kind of lobe. Batches have fixed shapes, so another material of the same geometry compiles
nothing, however many pairs it has.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from sbrdf_jax.angles import MIRROR_AZIMUTH, angle_between
from sbrdf_jax.devices import over_lanes
from sbrdf_jax.lobes import lobe_exponents
from sbrdf_jax.records import Status
from sbrdf_jax.representation.background import fit_background
from sbrdf_jax.representation.critical_angle import critical_candidates
from sbrdf_jax.representation.directions import DirectionSet
from sbrdf_jax.representation.lobe_bank import STEPS, fit_lobe_bank
from sbrdf_jax.representation.lobe_fit import NOISE_POWER, STATIONARY, Lobe, fit_lobe, width_bank

PAIR_BLOCK = 64  # searched before the next ones, to bound the memory
PAIR_BATCH = 16  # in one call
LANE_BATCH = 64  # in one call: arrays of so many lanes stay in the processor's cache
POLISH_ROUNDS = 40


class LobeKinds(NamedTuple):
    """The kinds of lobe that are tried."""

    index: tuple[int, ...]  # places in LOBE_KINDS
    widths: Float[np.ndarray, "kind width"]  # bank of each, from the least width to the greatest


class Functions(NamedTuple):
    """The harmonics at the directions, made orthonormal over their weights."""

    even: Float[np.ndarray, "direction even"]
    odd: Float[np.ndarray, "direction odd"]
    weight: Float[np.ndarray, " direction"]  # how often each direction counts


class Pairs(NamedTuple):
    """What a search starts from; NumPy on the host."""

    value: Float[np.ndarray, "pair direction"]  # the part that is even in phi_o, about 1 at its largest
    odd: Float[np.ndarray, "pair direction"]  # the other part
    alpha: Float[np.ndarray, "pair direction"]  # rad, from the lobe's peak
    exponent: Float[np.ndarray, "pair kind direction"]  # s(alpha) of each kind


class Lanes(NamedTuple):
    """What a search found, for every candidate and kind."""

    critical_angle: Float[np.ndarray, "pair candidate"]  # rad
    even: Float[np.ndarray, "pair candidate even"]  # background, of `Functions`
    odd: Float[np.ndarray, "pair candidate odd"]
    odd_error: Float[np.ndarray, "pair candidate"]  # weighted sum of squares, which no lobe changes
    target: Float[np.ndarray, "pair candidate direction"]  # what the even background leaves
    inside: Bool[np.ndarray, "pair candidate direction"]  # directions within the critical angle
    lobe: Lobe  # arrays [pair, candidate, kind]


class Winners(NamedTuple):
    """The best lane of each pair."""

    critical_angle: Float[np.ndarray, " pair"]  # rad
    even: Float[np.ndarray, "pair even"]
    odd: Float[np.ndarray, "pair odd"]
    kind: Int[np.ndarray, " pair"]  # place in LOBE_KINDS
    lobe: Lobe  # arrays [pair]
    error: Float[np.ndarray, " pair"]  # weighted sum of squares, of both parts


def lobe_kinds(index: tuple[int, ...], grid_step: float) -> LobeKinds:
    """Return the kinds to try on a grid of a step [rad] that bounds their widths from below."""
    of_step = np.asarray(_exponents(np.array([grid_step])))[:, 0]
    return LobeKinds(index, np.stack([width_bank(of_step[k]) for k in index]))


def lobe_geometry(
    peak_theta: Float[np.ndarray, " peak"], directions: DirectionSet
) -> tuple[Float[np.ndarray, "peak direction"], Float[np.ndarray, "peak kind direction"]]:
    """Return the angle of every direction from each peak [rad] at the mirror azimuth, and s of all `LOBE_KINDS`."""
    axes = (directions.theta_o, directions.phi_o)
    alpha, exponent = _in_batches(lambda peak: _geometry(peak, *axes), LANE_BATCH, (peak_theta,))
    return alpha, exponent


def search_lanes(pairs: Pairs, kinds: LobeKinds, functions: Functions) -> Lanes:
    """Fit background and lobe for every candidate and kind of every pair.

    Args:
        pairs: Coefficients, finite, scaled so that each is about 1 at its largest.
        kinds: Which lobes.
        functions: The harmonics.
    """
    weight = functions.weight
    critical_angle = critical_candidates(pairs.value, pairs.alpha, pairs.exponent, functions.even.shape[1])
    even, *lobe = _in_batches(
        lambda *pair: _search_pairs(*pair, kinds.widths, functions.even, weight),
        PAIR_BATCH,
        (pairs.value, pairs.alpha, pairs.exponent, critical_angle),
    )
    odd = np.zeros((*critical_angle.shape, functions.odd.shape[1]))
    if pairs.odd.any() and odd.size:
        odd, *_ = _in_batches(
            lambda *pair: (_fit_backgrounds(*pair, functions.odd, weight),),
            PAIR_BATCH,
            (pairs.odd, pairs.alpha, critical_angle),
        )
    odd_error = (pairs.odd[:, None] - odd @ functions.odd.T) ** 2 @ weight
    target = pairs.value[:, None] - even @ functions.even.T
    inside = pairs.alpha[:, None] <= critical_angle[..., None]
    return Lanes(critical_angle, even, odd, odd_error, target, inside, Lobe(*lobe))


def fit_lanes(
    target: Float[np.ndarray, "pair candidate direction"],
    inside: Bool[np.ndarray, "pair candidate direction"],
    exponent: Float[np.ndarray, " pair #candidate kind direction"],
    start: tuple[np.ndarray, np.ndarray],
    kinds: LobeKinds,
    weight: Float[np.ndarray, " direction"],
    only: np.ndarray | None = None,
) -> Lobe:
    """Fit lobes by Levenberg-Marquardt, all in batches of one shape.

    Args:
        target: What the background leaves.
        inside: Directions within the critical angle.
        exponent: s(alpha) of each kind.
        start: Heights and widths to start from, [pair, candidate, kind].
        kinds: Which lobes.
        weight: How often each direction counts.
        only: Fit these places of the flattened [pair, candidate, kind] alone.

    Returns:
        Arrays [pair, candidate, kind], or as `only`.
    """
    shape = start[0].shape
    exponent = np.broadcast_to(exponent, (*shape, target.shape[-1]))
    place = np.arange(start[0].size) if only is None else only

    def fit(place):
        pair, candidate, kind = np.unravel_index(place, shape)
        lane = target[pair, candidate], inside[pair, candidate], exponent[pair, candidate, kind]
        height, width = (array.ravel()[place] for array in start)
        return _fit_batch(*lane, weight, (height, width), kinds.widths[kind][:, [0, -1]])

    found = _in_batches(fit, LANE_BATCH, (place,))
    return Lobe(*(array.reshape(shape) if only is None else array for array in found))


def search(pairs: Pairs, kinds: LobeKinds, functions: Functions) -> Winners:
    """Return the best lane of each pair; `search_lanes`, a block of pairs at a time to bound the memory."""
    blocks = []
    for start in range(0, len(pairs.value), PAIR_BLOCK):
        block = Pairs(*(array[start : start + PAIR_BLOCK] for array in pairs))
        blocks.append(best_lanes(search_lanes(block, kinds, functions), block, kinds, functions.weight))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *blocks)


def best_lanes(lanes: Lanes, pairs: Pairs, kinds: LobeKinds, weight: Float[np.ndarray, " direction"]) -> Winners:
    """Return the lane of each pair with the least error over all directions.

    The winners that the search left before they were stationary are fitted on until they are.
    """
    shape = lanes.lobe.error.shape
    pair = np.arange(shape[0])
    best = least(lanes.lobe.error + lanes.odd_error[..., None]) + pair * (shape[1] * shape[2])
    flat = Lobe(*(array.ravel() for array in lanes.lobe))
    for _ in range(POLISH_ROUNDS):
        unfinished = best[flat.status[best] == Status.MAX_STEPS]
        if not unfinished.size:
            break
        start = flat.height.reshape(shape), flat.width.reshape(shape)
        again = fit_lanes(lanes.target, lanes.inside, pairs.exponent[:, None], start, kinds, weight, only=unfinished)
        for whole, part in zip(flat, again, strict=True):
            whole[unfinished] = part
    _, candidate, kind = np.unravel_index(best, shape)
    lobe = Lobe(*(array[best] for array in flat))
    return Winners(
        lanes.critical_angle[pair, candidate],
        lanes.even[pair, candidate],
        lanes.odd[pair, candidate],
        np.array(kinds.index)[kind],
        lobe,
        lobe.error + lanes.odd_error[pair, candidate],
    )


@jax.jit
def _geometry(peak_theta, theta_o, phi_o):
    def one(peak):
        same = jnp.ones_like(theta_o)
        return angle_between(theta_o, phi_o, peak * same, MIRROR_AZIMUTH * same)

    alpha = jax.vmap(one)(peak_theta)
    return alpha, jnp.moveaxis(lobe_exponents(alpha), 0, 1)


@functools.partial(over_lanes, axis=0, shared=(4, 5, 6))
def _search_pairs(value, alpha, exponent, critical_angle, widths, functions, weight):
    """Return even background [pair, candidate, even], then the fields of `Lobe` [pair, candidate, kind]."""

    def candidate(value, alpha, critical_angle):
        outside = alpha > critical_angle
        background = fit_background(value, outside, functions, weight)
        return background, value - functions @ background, jnp.where(outside, 0.0, weight)

    of_pair = jax.vmap(candidate, (None, None, 0))
    background, target, inside_weight = jax.vmap(of_pair)(value, alpha, critical_angle)
    found = []
    for kind in range(widths.shape[0]):
        bank = jnp.broadcast_to(widths[kind], (value.shape[0], widths.shape[1]))
        height, width, left, promised = fit_lobe_bank(target, inside_weight, exponent[:, kind], bank)
        shape = jnp.exp(-exponent[:, kind, None] / width[..., None])
        error = ((target - height[..., None] * shape) ** 2) @ weight
        noise = jnp.finfo(error.dtype).eps ** (2 * NOISE_POWER)
        ended = jnp.where(width <= widths[kind, 0], int(Status.CLAMPED), int(Status.OK))
        status = jnp.where(promised <= STATIONARY * left + noise, ended, int(Status.MAX_STEPS))
        status = jnp.where(jnp.isfinite(error), status, int(Status.NONFINITE))
        found.append((height, width, status, jnp.full_like(status, STEPS), error))
    return background, *(jnp.stack(parts, axis=-1) for parts in zip(*found, strict=True))


@functools.partial(over_lanes, axis=0, shared=(3, 4))
def _fit_backgrounds(value, alpha, critical_angle, functions, weight):
    """Return backgrounds [pair, candidate, function]."""

    def candidate(value, alpha, critical_angle):
        return fit_background(value, alpha > critical_angle, functions, weight)

    return jax.vmap(jax.vmap(candidate, (None, None, 0)))(value, alpha, critical_angle)


_exponents = jax.jit(lobe_exponents)
_fit_batch = over_lanes(jax.vmap(fit_lobe, in_axes=(0, 0, 0, None, 0, 0)), axis=0, shared=(3,))


def least(error: Float[np.ndarray, " pair *choice"]) -> Int[np.ndarray, " pair"]:
    """Return the place of each pair's least error among its flattened choices; NaN loses to everything."""
    return np.where(np.isnan(error), np.inf, error).reshape(len(error), -1).argmin(axis=1)


def _in_batches(function, size, arrays):
    """Call a function on batches of the leading axis, the last one filled with copies; NumPy arrays, joined."""
    count = len(arrays[0])
    answers = []
    for start in range(0, count, size):
        rows = np.minimum(np.arange(start, start + size), count - 1)
        answers.append(function(*(array[rows] for array in arrays)))
    return tuple(np.concatenate(parts)[:count] for parts in zip(*answers, strict=True))
