"""Which cells of a lobe tensor's core are stored: those whose loss would raise the error most.

Factors are first turned so that the core's energy gathers in few cells; then cells are taken away in
rounds, and what is left is solved anew after each. A bit for each cell says where the stored ones lie.
"""

import itertools
from collections.abc import Callable

import numpy as np
import scipy.linalg.lapack
from jaxtyping import Bool, Float

from sbrdf_jax.representation.tensor_fit import Factors, TensorFit

ROUND = 0.84  # of its cells keeps a core in one round: the losses of cells change with the cells that are left
WORD = 64  # cells of which one stored number says whether they are there


def stored_cells(core: Float[np.ndarray, "a b q channel"]) -> int:
    """Count the numbers that a core stores: its cells that are not 0, and the words of bits that say which."""
    return int(np.count_nonzero(core)) + num_words(np.size(core))


def num_words(cells: int) -> int:
    """Count the words with a bit for each cell."""
    return -(-cells // WORD)


def prune(fit: TensorFit, factors: Factors, most: int, is_enough: Callable[[Factors], bool]) -> Factors:
    """Take cells off the core.

    Args:
        fit: The problem.
        factors: What is to be pruned; its core is the best one for its factors.
        most: Most cells that may be left.
        is_enough: Asked after each round below `most`; the last that is enough is returned.
    """
    thinning = _Thinning(fit, _turned(factors))
    while thinning.count > most:
        thinning.thin(max(int(ROUND * thinning.count), most))
    found = thinning.factors()
    while thinning.count > 1:
        thinning.thin(int(ROUND * thinning.count))
        fewer = thinning.factors()
        if not is_enough(fewer):
            break
        found = fewer
    return found


def _turned(factors: Factors) -> Factors:
    """Turn the columns of each factor to the principal axes of the core, largest first."""
    turned, core = list(factors[:3]), factors.core
    for mode in range(3):
        unfolded = np.moveaxis(core, mode, 0).reshape(core.shape[mode], -1)
        axes = np.linalg.eigh(unfolded @ unfolded.T)[1][:, ::-1]
        turned[mode] = turned[mode] @ axes
        core = np.moveaxis(np.tensordot(axes.T, core, (1, mode)), 0, mode)
    return Factors(*turned, core)


class _Thinning:
    """A core that loses cells; `kept` says which it has."""

    kept: Bool[np.ndarray, "cell channel"]

    def __init__(self, fit: TensorFit, factors: Factors):
        self._factors, self._problem = factors, fit.core_problem(factors)
        self.kept = np.ones((len(self._problem.scale), factors.core.shape[3]), bool)
        self._value = factors.core.reshape(self.kept.shape) / self._problem.scale[:, None]
        self._roots = [_cholesky(self._problem.matrix)]  # of each channel's cells that are left; one for all at first

    @property
    def count(self) -> int:
        """Number of cells left."""
        return int(self.kept.sum())

    def thin(self, count: int) -> None:
        """Keep the `count` cells whose loss is greatest, and solve for them again."""
        loss = self._losses()
        self.kept = np.zeros(loss.shape, bool)
        np.put(self.kept, np.argpartition(loss, -count, axis=None)[-count:], True)
        self._value, self._roots = np.zeros(loss.shape), []
        for channel, kept in enumerate(self.kept.T):
            root = np.zeros((0, 0))
            if kept.any():
                root = _cholesky(self._problem.matrix[np.ix_(kept, kept)])
                right = self._problem.right[kept, channel]
                self._value[kept, channel] = scipy.linalg.lapack.dpotrs(root, right, lower=1)[0]
            self._roots.append(root)

    def _losses(self) -> Float[np.ndarray, "cell channel"]:
        """Return by how much the squared error grows without each cell, all others solved anew; -1 without it now."""
        inverse = [np.diag(scipy.linalg.lapack.dpotri(root, lower=1)[0]) if root.size else [] for root in self._roots]
        loss = np.full(self.kept.shape, -1.0)
        for channel, (kept, diagonal) in enumerate(zip(self.kept.T, itertools.cycle(inverse), strict=False)):
            loss[kept, channel] = self._value[kept, channel] ** 2 / diagonal
        return loss

    def factors(self) -> Factors:
        """Return the factors with the core as it is now."""
        core = self._value * self._problem.scale[:, None]
        return self._factors._replace(core=core.reshape(self._factors.core.shape))


def _cholesky(matrix):
    root, failed = scipy.linalg.lapack.dpotrf(matrix, lower=1)
    if failed:
        raise np.linalg.LinAlgError("normal equations are not positive definite")
    return root
