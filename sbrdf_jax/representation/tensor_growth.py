"""Which ranks a lobe tensor has: grown step by step, by the error that each stored number takes away.

Growth counts a part of the core's cells; at its end those that matter least are left out.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sbrdf_jax.representation.tensor_fit import Factors, SolvedCore, TensorFit
from sbrdf_jax.representation.tensor_pruning import num_words, prune

KEPT = 0.5  # of the core's cells, as growth counts them: what pruning takes away costs hardly any error
LESS_KEPT, LARGE = 0.05, 8000  # so much less than that of so many cells or more, which can be pruned better
MOST_CELLS = 1800  # of the core for one channel; its normal equations have so many unknowns
ALIKE = 0.8  # of the best step's score: such steps are taken with it
LEAST_GAIN = 2e-3  # of the squared error; a step that gains less is noise, and growth ends
MOST_SWEEPS, START_GAIN = 30, 0.02  # before the growth; of the squared error: a sweep that gains less is the last
BALANCE = (2.0, 1.0)  # powers of the errors, one after the other, by which each incident angle counts in the end
NO_ERROR = 1e-24  # squared, relative; below it is rounding


def grow(
    fit: TensorFit,
    numbers: Callable[[int, int, int, int, int], int],
    budget: float,
    is_enough: Callable[[Factors], bool],
    errors: Callable[[Factors], Float[np.ndarray, " i"]],
    *,
    first_channels: int,
) -> Factors:
    """Grow ranks and channels until the factors are enough, or nothing more fits or gains.

    Args:
        fit: The problem; its channels are in the order in which they are taken.
        numbers: Stored numbers by the ranks a, b, q, the number of channels and that of the core's numbers.
        budget: Most numbers.
        is_enough: Asked after each step; the first that is enough is polished and pruned as far as it stays so.
        errors: Asked in the end, to balance incident angles: the error at each row of theta_i, relative to that of all.
        first_channels: Channels to start with.
    """
    channels = first_channels
    factors, solved = _start(fit, channels)

    def expected(factors, channels: int) -> int:
        ranks = [f.shape[1] for f in factors]
        cells = int(np.prod(ranks)) * channels
        kept = KEPT - LESS_KEPT * min(1.0, cells / LARGE)
        return numbers(*ranks, channels, int(kept * cells) + num_words(cells))

    def fits(factors, channels: int) -> bool:
        return bool(np.prod([f.shape[1] for f in factors]) <= MOST_CELLS and expected(factors, channels) <= budget)

    while True:
        error = fit.error(solved, channels)
        found = Factors(*factors, solved.value[..., :channels])
        enough = is_enough(found)
        if error <= NO_ERROR * fit.energy or enough:
            break
        held, steps = expected(factors, channels), []
        for step in _steps(fit, found, len(solved.gain)):
            trial = step.taken(factors, channels)
            if not fits(*trial):
                continue
            if step.factor is None:
                core, gained = solved.value, solved.gain[channels]
            else:
                core, gain = fit.widened_core(solved, factors, step.mode, step.factor)
                gained = gain[:channels].sum()
            if gained >= LEAST_GAIN * error:
                steps.append((_score(error, gained, expected(*trial) - held), step, core))
        if not steps:
            break
        alike = ALIKE * max(score for score, _, _ in steps)
        steps = [each for each in steps if each[0] >= alike]
        steps.sort(key=lambda each: (each[1].factor is not None, -each[0]))  # each column makes a channel dearer
        wider = []
        for _, step, core in steps:
            trial = step.taken(factors, channels)
            if fits(*trial):
                factors, channels = trial
                if step.factor is not None:
                    wider.append(core)
        if len(wider) > 1:
            solved = _core(fit, factors)
            core, projection = solved.value, solved.projection
        else:
            core, projection = wider[0] if wider else solved.value, fit.project(factors[2])
        factors = fit.sweep(factors, core[..., :channels], projection)
        solved = _core(fit, factors)
    settled, grown = found, fit
    for power in BALANCE:
        fit = fit.weighted(errors(settled) ** power)
        factors = fit.sweep(settled[:3], settled.core, fit.project(settled.direction))
        settled = Factors(*factors, _core(fit, factors).value[..., :channels])
    if enough and not is_enough(settled):
        fit, settled = grown, found  # settled for all, not for the worst
    cells = np.size(settled.core)
    most = min(cells, budget - numbers(*settled.ranks, channels, num_words(cells)))
    return prune(fit, settled, max(int(most), 1), is_enough if enough else None)


class _Step(NamedTuple):
    """One rank or one channel more."""

    mode: int = -1
    factor: np.ndarray | None = None  # of the mode, its new column last; None: a channel

    def taken(self, factors, channels: int) -> tuple[list[np.ndarray], int]:
        """Return factors and channels after it."""
        if self.factor is None:
            return list(factors), channels + 1
        return [self.factor if k == self.mode else f for k, f in enumerate(factors)], channels


def _steps(fit: TensorFit, found: Factors, most_channels: int) -> list[_Step]:
    """Return the steps that there are."""
    wide = fit.widened(found[:3], found.core)
    steps = [_Step(mode, factor) for mode, factor in enumerate(wide) if factor is not None]
    return steps if found.core.shape[3] == most_channels else [*steps, _Step()]


def _start(fit: TensorFit, channels: int) -> tuple[list[np.ndarray], SolvedCore]:
    """Return the smallest factors, swept until the error hardly falls any more, and their core."""
    factors = fit.start()
    solved = _core(fit, factors)
    error = fit.error(solved, channels)
    for _ in range(MOST_SWEEPS):
        before = error
        factors = fit.sweep(factors, solved.value[..., :channels], solved.projection)
        solved = _core(fit, factors)
        error = fit.error(solved, channels)
        if before - error <= START_GAIN * error:
            break
    return factors, solved


def _core(fit: TensorFit, factors) -> SolvedCore:
    """Return the best core of three factors."""
    return fit.solve_core(*factors[:2], fit.project(factors[2]))


def _score(error: float, gained: float, cost: int) -> float:
    """Return how far the logarithm of the error falls for each number."""
    return np.log(error / max(error - gained, NO_ERROR * error)) / cost
