"""Which cells of a lobe tensor's core are stored: those whose loss would raise the error most.

Factors are first turned so that the core's energy gathers in few cells; then cells are taken away in
rounds, and what is left is solved anew after each. In the end the factors are fitted to the cells that are
left, as far as that pays. A bit for each cell says where the stored ones lie.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg.blas
from jaxtyping import Bool, Float, Int

from sbrdf_jax.representation.tensor_fit import Factors, TensorFit, inverse_of, lower_root

MOST_POLISHED = 1100  # cells of one channel; factors of larger cores are settled when they are pruned
POLISHES, POLISH_GAIN = 20, 0.02  # most; of the squared error: one that gains less is the last
ROUND = 0.84  # of its cells keeps a core in one round: the losses of cells change with the cells that are left
WORD = 64  # cells of which one stored number says whether they are there


def stored_cells(core: Float[np.ndarray, "a b q channel"]) -> int:
    """Count the numbers that a core stores: its cells that are not 0, and the words of bits that say which."""
    return int(np.count_nonzero(core)) + num_words(np.size(core))


def num_words(cells: int) -> int:
    """Count the words with a bit for each cell."""
    return -(-cells // WORD)


def prune(fit: TensorFit, factors: Factors, most: int, is_enough: Callable[[Factors], bool] | None) -> Factors:
    """Take cells off the core.

    Args:
        fit: The problem.
        factors: What is to be pruned; its core is the best one for its factors.
        most: Most cells that may be left.
        is_enough: Asked after each round below `most`; the last that is enough is returned. None: there is none below.
    """
    factors = _turned(factors)
    while True:
        thinning = _Thinning(fit, factors)
        while thinning.count > most:
            thinning.thin(max(int(ROUND * thinning.count), most))
        found = thinning.factors()
        while is_enough is not None and thinning.count > 1:
            thinning.thin(int(ROUND * thinning.count))
            fewer = thinning.factors()
            if not is_enough(fewer):
                break
            found = fewer
        polished = _polished(fit, found)
        if is_enough is None or polished is found:
            return polished
        if not is_enough(polished):  # better for all, not for the worst
            return found
        if np.count_nonzero(found.core) == np.count_nonzero(factors.core):
            return polished
        factors = polished


def _polished(fit: TensorFit, factors: Factors) -> Factors:
    """Fit factors and the cells that the core has in turn, until that hardly gains any more."""
    if np.prod(factors.core.shape[:3]) > MOST_POLISHED:
        return factors
    factors, error = fit.solve_cells(factors)
    for _ in range(POLISHES):
        fewer, less = fit.solve_cells(fit.renewed(factors))
        if not less < error:
            break
        factors, error, gain = fewer, less, error - less
        if gain < POLISH_GAIN * (error + gain):
            break
    return factors


def _turned(factors: Factors) -> Factors:
    """Turn the columns of each factor to the principal axes of the core, largest first."""
    turned, core = list(factors[:3]), factors.core
    for mode in range(3):
        unfolded = np.moveaxis(core, mode, 0).reshape(core.shape[mode], -1)
        axes = np.linalg.eigh(unfolded @ unfolded.T)[1][:, ::-1]
        turned[mode] = turned[mode] @ axes
        core = np.moveaxis(np.tensordot(axes.T, core, (1, mode)), 0, mode)
    return Factors(*turned, core)


class _Channel(NamedTuple):
    """The cells that a channel has left, and how their inverse matrix differs from that of all cells.

    A lost cell is a pivot of an incomplete Cholesky factorisation of the inverse: with its columns `pivot`,
    the inverse without the lost cells is the whole one less `pivot @ pivot.T`.
    """

    cells: Int[np.ndarray, " left"]
    value: Float[np.ndarray, " left"]  # of the scaled problem
    pivot: Float[np.ndarray, "left lost"]

    def loss(self, inverse: Float[np.ndarray, "cell cell"]) -> Float[np.ndarray, " left"]:
        """By how much the squared error grows without each cell, all others solved anew."""
        diagonal = np.diag(inverse)[self.cells] - np.einsum("cl,cl->c", self.pivot, self.pivot)
        return self.value**2 / diagonal

    def without(self, lost: Bool[np.ndarray, " left"], inverse: Float[np.ndarray, "cell cell"]) -> "_Channel":
        """Take cells away and solve for the others anew, by a Schur complement of the inverse."""
        left, lost = np.flatnonzero(~lost), np.flatnonzero(lost)
        kept, gone = self.pivot[left], self.pivot[lost]
        if not len(left):
            return _Channel(self.cells[left], self.value[left], kept)
        rows = inverse.take(self.cells[lost], axis=0)
        root = lower_root(rows.take(self.cells[lost], axis=1) - gone @ gone.T)
        solve = functools.partial(scipy.linalg.blas.dtrsm, 1.0, root, lower=1)
        across, value = solve(rows.take(self.cells[left], axis=1) - gone @ kept.T), solve(self.value[lost, None])
        return _Channel(
            self.cells[left], self.value[left] - (value.T @ across)[0], np.concatenate([kept, across.T], axis=1)
        )


class _Thinning:
    """A core that loses cells."""

    def __init__(self, fit: TensorFit, factors: Factors):
        matrix, _, self._scale = fit.core_problem(factors)
        self._factors = factors
        self._inverse = inverse_of(matrix).T  # symmetric; rows are taken of it, and lie together here
        values = factors.core.reshape(len(matrix), -1) / self._scale[:, None]
        whole = (_Channel(np.arange(len(matrix)), value, np.zeros((len(matrix), 0))) for value in values.T)
        self._channels = [
            channel if channel.value.all() else channel.without(channel.value == 0, self._inverse) for channel in whole
        ]

    @property
    def count(self) -> int:
        """Number of cells left."""
        return sum(len(channel.cells) for channel in self._channels)

    def thin(self, count: int) -> None:
        """Keep the `count` cells whose loss is greatest."""
        loss = np.concatenate([channel.loss(self._inverse) for channel in self._channels])
        lost = np.ones(len(loss), bool)
        lost[np.argpartition(loss, -count)[-count:]] = False
        ends = np.cumsum([len(channel.cells) for channel in self._channels])[:-1]
        pairs = zip(self._channels, np.split(lost, ends), strict=True)
        self._channels = [channel.without(gone, self._inverse) if gone.any() else channel for channel, gone in pairs]

    def factors(self) -> Factors:
        """Return the factors with the core as it is now."""
        core = np.zeros((len(self._scale), len(self._channels)))
        for column, channel in zip(core.T, self._channels, strict=True):
            column[channel.cells] = channel.value * self._scale[channel.cells]
        return self._factors._replace(core=core.reshape(self._factors.core.shape))
