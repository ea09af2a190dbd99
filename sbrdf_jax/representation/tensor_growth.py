"""Which ranks a lobe tensor has: grown one at a time, by the error that each stored number takes away."""

from collections.abc import Callable

import numpy as np

from sbrdf_jax.representation.tensor_fit import Factors, TensorFit

MOST_CELLS = 900  # of the core for one channel; its normal equations have so many unknowns
LEAST_GAIN = 2e-3  # of the squared error; a step that gains less is noise, and growth ends
MOST_SWEEPS, SWEEP_GAIN = 30, 0.02  # before and after the growth; of the squared error
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
    factors, channels = _settle(fit, fit.start(), first_channels), first_channels
    while True:
        solved = fit.solve_core(*factors[:2], fit.project(factors[2]))
        error = energy - solved.gain[:channels].sum()
        found = Factors(*factors, solved.value[..., :channels])
        enough = is_enough(found)
        if error <= NO_ERROR * energy or enough:
            break
        held = numbers(*[f.shape[1] for f in factors], channels)
        steps = []  # score, the error taken away, what it leads to
        for mode, wide in enumerate(fit.widened(factors, found.core)):
            if wide is None:
                continue
            trial = [wide if k == mode else f for k, f in enumerate(factors)]
            ranks = [f.shape[1] for f in trial]
            cost = numbers(*ranks, channels) - held
            if np.prod(ranks) > MOST_CELLS or held + cost > budget:
                continue
            gained = fit.added_gain(solved, factors, mode, wide)[:channels].sum()
            steps.append((_score(error, gained, cost), gained, trial, channels))
        if channels < len(solved.gain):
            cost = numbers(*[f.shape[1] for f in factors], channels + 1) - held
            if held + cost <= budget:
                gained = solved.gain[channels]
                steps.append((_score(error, gained, cost), gained, factors, channels + 1))
        _, gained, wider, wider_channels = max(steps, key=lambda step: step[0], default=(0.0, 0.0, factors, channels))
        if gained < LEAST_GAIN * error:
            break
        factors, channels = fit.sweep(wider, wider_channels)[0], wider_channels
    factors = _settle(fit, factors, channels)
    settled = Factors(*factors, fit.solve_core(*factors[:2], fit.project(factors[2])).value[..., :channels])
    return found if enough and not is_enough(settled) else settled  # settled for all, not for the worst


def _settle(fit: TensorFit, factors, channels: int) -> list[np.ndarray]:
    """Sweep until the error hardly falls any more."""
    before = np.inf
    for _ in range(MOST_SWEEPS):
        factors, gained = fit.sweep(factors, channels)
        error = fit.normal.energy - gained
        if before - error <= SWEEP_GAIN * error:
            break
        before = error
    return factors


def _score(error: float, gained: float, cost: int) -> float:
    """Return how far the logarithm of the error falls for each number."""
    return np.log(error / max(error - gained, NO_ERROR * error)) / cost
