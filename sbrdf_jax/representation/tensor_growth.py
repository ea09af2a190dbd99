"""Which ranks a lobe tensor has: grown one at a time, by the error that each stored number takes away."""

from collections.abc import Callable

import numpy as np

from sbrdf_jax.representation.tensor_fit import Factors, TensorFit

MOST_CELLS = 700  # of the core for one channel; its normal equations have so many unknowns
LEAST_GAIN = 2e-3  # of the squared error; a step that gains less is noise, and growth ends
FIRST_SWEEPS, LAST_SWEEPS = 3, 4
NO_ERROR = 1e-24  # squared, relative; below it is rounding


def grow(
    fit: TensorFit,
    numbers: Callable[[int, int, int, int], int],
    budget: float,
    is_enough: Callable[[Factors], bool],
    *,
    first_channels: int,
) -> Factors:
    """Grow ranks and channels until the factors are enough, or nothing more fits or gains.

    Args:
        fit: The problem; its channels are in the order in which they are taken.
        numbers: Stored numbers by the ranks a, b, q and the number of channels.
        budget: Most numbers.
        is_enough: Asked after each step; the first that is enough is polished and returned.
        first_channels: Channels to start with.
    """
    energy = fit.normal.energy
    factors, channels = fit.start(), first_channels
    for _ in range(FIRST_SWEEPS):
        factors = fit.sweep(factors, channels)
    while True:
        core, gain = fit.solve_core(*factors)
        error = energy - gain[:channels].sum()
        if error <= NO_ERROR * energy or is_enough(Factors(*factors, core[..., :channels])):
            break
        size = [f.shape[1] for f in factors]
        held = numbers(*size, channels)
        best, step = 0.0, None
        if channels < len(gain) and numbers(*size, channels + 1) <= budget:
            best = _gain(error, gain[channels], numbers(*size, channels + 1) - held)
            step = factors, channels + 1, gain[channels]
        for wide in fit.widened(factors, core[..., :channels]):
            if wide is None:
                continue
            ranks = [f.shape[1] for f in wide]
            if np.prod(ranks) > MOST_CELLS or numbers(*ranks, channels) > budget:
                continue
            gained = fit.solve_core(*wide)[1][:channels].sum() - gain[:channels].sum()
            score = _gain(error, gained, numbers(*ranks, channels) - held)
            if score > best:
                best, step = score, (wide, channels, gained)
        if step is None or step[2] < LEAST_GAIN * error:
            break
        factors, channels = fit.sweep(*step[:2]), step[1]
    for _ in range(LAST_SWEEPS):
        factors = fit.sweep(factors, channels)
    return Factors(*factors, fit.solve_core(*factors)[0][..., :channels])


def _gain(error: float, gained: float, cost: int) -> float:
    """Return how far the logarithm of the error falls for each number."""
    return np.log(error / max(error - gained, NO_ERROR * error)) / cost
