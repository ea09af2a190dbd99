"""Alternating least squares of a Tucker decomposition whose third factor is a function of both directions.

    value[i, o, p, c] = sum of u[i, a] v[o, b] w[i, o, p, q] core[a, b, q, c],

u and v splines of theta_i and theta_o, w a combination of functions of a pair of directions
(so no index of the grid). Azimuths enter by two sums for each (i, o) only, which makes a step
independent of how many there are. NumPy in float64 on the host: ranks change from step to step,
and each would compile anew.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg.lapack
from jaxtyping import Float

from sbrdf_jax.host_blas import mirrored

NOTHING = 1e-30  # of the largest diagonal element: a column that has died out, whose unknowns become 0
WIDER = 6  # columns of a factor for each one more that a step adds to it
RIDGE = 1e-6  # relative to the diagonal: what no value shows stays small, and directions between run not wild


class Factors(NamedTuple):
    """Coefficients of the factors' functions, and the core."""

    theta_i: Float[np.ndarray, "theta_i_function a"]
    theta_o: Float[np.ndarray, "theta_o_function b"]
    direction: Float[np.ndarray, "direction_function q"]
    core: Float[np.ndarray, "a b q channel"]

    @property
    def ranks(self) -> tuple[int, int, int]:
        """Ranks a, b, q."""
        a, b, q, _ = self.core.shape
        return a, b, q


class Normal(NamedTuple):
    """What least squares needs to know of the values, for every pair (i, o) of polar angles."""

    gram: Float[np.ndarray, "i o direction_function direction_function"]
    moment: Float[np.ndarray, "i o direction_function channel"]
    energy: Float[np.ndarray, " i"]  # weighted sum of squares of the values
    theta_i: Float[np.ndarray, "i theta_i_function"]  # the functions of theta_i at its rows
    theta_o: Float[np.ndarray, "o theta_o_function"]


class Projection(NamedTuple):
    """Sums over azimuths for a directional factor, for every pair (i, o)."""

    gram: Float[np.ndarray, "i o q q"]
    moment: Float[np.ndarray, "i o q channel"]


class CoreProblem(NamedTuple):
    """Normal equations of a core, their diagonal scaled to 1 and the ridge on it."""

    matrix: Float[np.ndarray, "cell cell"]
    right: Float[np.ndarray, "cell channel"]
    scale: Float[np.ndarray, " cell"]  # the core is this times the solution


class SolvedCore(NamedTuple):
    """The best core for given factors, and what tells how much another column would add."""

    value: Float[np.ndarray, "a b q channel"]
    gain: Float[np.ndarray, " channel"]  # by how much each channel lowers the error
    at: tuple[np.ndarray, np.ndarray]  # [i, a] and [o, b]: the factors at the rows
    projection: Projection
    root: Float[np.ndarray, "cell cell"]  # lower Cholesky factor of the scaled normal matrix
    scale: Float[np.ndarray, " cell"]
    right: Float[np.ndarray, "cell channel"]  # scaled right side


class WidenedCore(NamedTuple):
    """The best core for factors of which one has more columns."""

    value: Float[np.ndarray, "a b q channel"]
    gain: Float[np.ndarray, " channel"]  # by how much each channel lowers the error further


class TensorFit:
    """The problem, and its partial solutions: each of the four parts, the others held fixed."""

    def __init__(self, normal: Normal):
        self.normal = normal
        self.energy = float(normal.energy.sum())
        total = normal.gram.sum(axis=(0, 1))
        size = len(total)
        shift = RIDGE * np.trace(total) / size * np.eye(size)
        self.roots = (
            np.linalg.qr(normal.theta_i)[1],
            np.linalg.qr(normal.theta_o)[1],
            np.linalg.cholesky(total + shift).T,
        )

    def weighted(self, weight: Float[np.ndarray, " i"]) -> "TensorFit":
        """Return the problem in which squared errors at each row of theta_i count `weight` times as much."""
        gram, moment = (array * weight[:, None, None, None] for array in self.normal[:2])
        return TensorFit(self.normal._replace(gram=gram, moment=moment, energy=weight * self.normal.energy))

    def orthonormal(self, mode: int, factor):
        """Make the columns of a factor orthonormal over the rows of its mode, as far as they are independent.

        Returns:
            The factor, and the change of basis that undoes it: their product is what was given.
        """
        change = np.linalg.qr(self.roots[mode] @ factor)[1]
        return factor @ np.linalg.pinv(change, rcond=1e-10), change

    def start(self) -> list[np.ndarray]:
        """Return factors of rank 2: constant and linear in both polar angles, the leading lobes in direction."""
        n = self.normal
        moment = n.moment.transpose(2, 0, 1, 3).reshape(n.moment.shape[2], -1)
        scaled = scipy.linalg.solve_triangular(self.roots[2], moment, trans="T")
        lobes = scipy.linalg.solve_triangular(self.roots[2], np.linalg.eigh(scaled @ scaled.T)[1][:, :-3:-1])
        lines = (np.vander(np.linspace(-1, 1, f.shape[1]), 2)[:, : f.shape[1]] for f in (n.theta_i, n.theta_o))
        return [self.orthonormal(mode, factor)[0] for mode, factor in enumerate((*lines, lobes))]

    def project(self, w) -> Projection:
        """Return what the directional factor makes of Gram matrices and moments."""
        return Projection(w.T @ self.normal.gram @ w, w.T @ self.normal.moment)

    def solve_core(self, u, v, projection: Projection) -> SolvedCore:
        """Return the core that fits best."""
        at = self.normal.theta_i @ u, self.normal.theta_o @ v
        matrix, right = _core_matrix(at, at, projection.gram), _core_right(at, projection.moment)
        core, root, scale = _solve(matrix, right)
        right, known = scale[:, None] * right, core / scale[:, None]
        gain = (known * (right + RIDGE * known)).sum(axis=0)
        value = core.reshape(u.shape[1], v.shape[1], projection.moment.shape[2], -1)
        return SolvedCore(value, gain, at, projection, root, scale, right)

    def core_problem(self, factors: Factors) -> CoreProblem:
        """Return what decides on the core of given factors, for the channels that it has."""
        projection = self.project(factors.direction)
        at = self.normal.theta_i @ factors.theta_i, self.normal.theta_o @ factors.theta_o
        right = _core_right(at, projection.moment[..., : factors.core.shape[3]])
        return _scaled(_core_matrix(at, at, projection.gram), right)

    def solve_cells(self, factors: Factors) -> tuple[Factors, float]:
        """Return the best values of the cells that a core has, those that are not 0, and the squared error left."""
        matrix, right, scale = self.core_problem(factors)
        old = factors.core.reshape(len(scale), -1)
        core, gain = np.zeros_like(old), 0.0
        for channel in range(old.shape[1]):
            cells = np.flatnonzero(old[:, channel])
            if len(cells):
                found = scipy.linalg.solve(matrix[np.ix_(cells, cells)], right[cells, channel], assume_a="pos")
                gain += found @ (right[cells, channel] + RIDGE * found)
                core[cells, channel] = found * scale[cells]
        return factors._replace(core=core.reshape(factors.core.shape)), self.energy - float(gain)

    def widened_core(self, solved: SolvedCore, factors, mode: int, wide) -> WidenedCore:
        """Return the best core if one factor has more columns, and by how much each channel lowers the error further.

        The unknowns that they bring are solved for by their Schur complement; what is factorised stays.

        Args:
            solved: The core of `factors`.
            factors: The factors.
            mode: Which factor is widened.
            wide: The widened factor, its new columns last.
        """
        n, column = self.normal, wide[:, factors[mode].shape[1] :]
        new, held, gram, moment = list(solved.at), solved.at, solved.projection.gram, solved.projection.moment
        if mode < 2:
            new[mode] = (n.theta_i, n.theta_o)[mode] @ column
            own = gram
        else:
            along = column.T @ n.gram  # [i, o, new, direction_function]
            gram, own, moment = along @ factors[2], along @ column, column.T @ n.moment
        across = _core_matrix(new, held, gram) * solved.scale
        block, right = _core_matrix(new, new, own), _core_right(new, moment)
        diagonal = RIDGE * _living(np.diag(block))
        known = solved.value.reshape(len(solved.scale), -1) / solved.scale[:, None]
        explained = scipy.linalg.solve_triangular(solved.root, across.T, lower=True, check_finite=False)
        schur = block + np.diag(diagonal) - explained.T @ explained
        added = _solve(schur, right - across @ known, ridge=0.0)[0]  # it is on the diagonal already
        known -= scipy.linalg.solve_triangular(
            solved.root, explained @ added, lower=True, trans="T", check_finite=False
        )
        both = (known * (solved.right + RIDGE * known)).sum(axis=0)
        gain = both + (added * (right + diagonal[:, None] * added)).sum(axis=0) - solved.gain
        shape = list(solved.value.shape)
        shape[mode] = column.shape[1]
        parts = (known * solved.scale[:, None]).reshape(solved.value.shape), added.reshape(shape)
        return WidenedCore(np.concatenate(parts, axis=mode), gain)

    def error(self, solved: SolvedCore, channels: int) -> float:
        """Return the squared error that a core leaves, of its first `channels`."""
        return float(self.energy - solved.gain[:channels].sum())

    def sweep(self, factors, core, projection: Projection) -> list[np.ndarray]:
        """Renew each factor once, by the channels that `core` has; `projection` is that of the direction's factor."""
        u, change = self.orthonormal(0, self._best_theta_i(factors[1], core, projection))
        core = np.tensordot(change, core, (1, 0))
        v, change = self.orthonormal(1, self._best_theta_o(u, core, projection))
        core = np.tensordot(change, core, (1, 1)).transpose(1, 0, 2, 3)
        return [u, v, self.orthonormal(2, self._best_direction(u, v, core))[0]]

    def renewed(self, factors: Factors) -> Factors:
        """Renew each factor once, and keep the core as it is."""
        core, projection = factors.core, self.project(factors.direction)
        u = self._best_theta_i(factors.theta_o, core, projection)
        v = self._best_theta_o(u, core, projection)
        return Factors(u, v, self._best_direction(u, v, core), core)

    def _best_theta_i(self, v, core, projection: Projection):
        """Return the best factor of theta_i for given others."""
        gram, moment, a = projection.gram, projection.moment[..., : core.shape[3]], core.shape[0]
        part = np.tensordot(self.normal.theta_o @ v, core, (1, 1)).transpose(0, 2, 3, 1)  # [o, q, c, a]
        matrix = gram.reshape(len(gram), -1) @ _channel_pairs(part).reshape(-1, a * a)
        right = moment.reshape(len(moment), -1) @ part.reshape(-1, a)
        return _solve_mode(self.normal.theta_i, matrix, right)

    def _best_theta_o(self, u, core, projection: Projection):
        """Return the best factor of theta_o for given others."""
        gram, moment = (np.swapaxes(array, 0, 1) for array in projection)
        b, moment = core.shape[1], moment[..., : core.shape[3]]
        part = np.tensordot(self.normal.theta_i @ u, core, (1, 0)).transpose(0, 2, 3, 1)  # [i, q, c, b]
        matrix = gram.reshape(len(gram), -1) @ _channel_pairs(part).reshape(-1, b * b)
        right = moment.reshape(len(moment), -1) @ part.reshape(-1, b)
        return _solve_mode(self.normal.theta_o, matrix, right)

    def _best_direction(self, u, v, core):
        """Return the best factor of direction for given others."""
        n, q, part = self.normal, core.shape[2], self.amplitudes(u, v, core)  # [i, o, q, c]
        squares = (part @ np.swapaxes(part, 2, 3)).reshape(-1, q * q)
        size = n.gram.shape[-1]
        matrix = _unpair(n.gram.reshape(-1, size * size).T @ squares, size, q)
        right = np.tensordot(n.moment[..., : core.shape[3]], part, ((0, 1, 3), (0, 1, 3)))
        return _solve(matrix, right.reshape(-1, 1))[0].reshape(size, q)

    def amplitudes(self, u, v, core) -> Float[np.ndarray, "i o q channel"]:
        """Return what multiplies the directional factor at every pair of polar angles."""
        at_i, at_o = self.normal.theta_i @ u, self.normal.theta_o @ v
        return np.tensordot(np.tensordot(at_i, core, (1, 0)), at_o, (1, 1)).transpose(0, 3, 1, 2)

    def widened(self, factors, core) -> list[np.ndarray | None]:
        """Return each factor with more columns, the leading ones of the residual; None at its limit."""
        u, v, w = factors
        n, channels = self.normal, core.shape[3]
        rest = n.moment[..., :channels] - n.gram @ (w @ self.amplitudes(u, v, core))
        at_i, at_o, along = n.theta_i @ u, n.theta_o @ v, w.T @ rest
        steepest = (
            n.theta_i.T @ np.tensordot(along, at_o, (1, 0)).reshape(len(at_i), -1),
            n.theta_o.T @ np.tensordot(along, at_i, (0, 0)).reshape(len(at_o), -1),
            np.tensordot(np.tensordot(rest, at_i, (0, 0)), at_o, (0, 0)).reshape(len(w), -1),
        )
        found: list[np.ndarray | None] = []
        for mode, (matrix, root) in enumerate(zip(steepest, self.roots, strict=True)):
            others = [f.shape[1] for k, f in enumerate(factors) if k != mode]
            held = factors[mode].shape[1]
            more = min(1 + held // WIDER, len(matrix) - held, others[0] * others[1] * channels - held)
            if more < 1:
                found.append(None)
                continue
            scaled = scipy.linalg.solve_triangular(root, matrix, trans="T")
            leading = np.linalg.eigh(scaled @ scaled.T)[1][:, -more:]
            turned = root @ factors[mode]  # orthonormal
            columns = scipy.linalg.solve_triangular(root, leading - turned @ (turned.T @ leading))
            found.append(np.concatenate([factors[mode], self.orthonormal(mode, columns)[0]], axis=1))
        return found


def _pairs(x, y):
    """Return all products of a column of each, [row, column * column]."""
    return (x[:, :, None] * y[:, None, :]).reshape(len(x), -1)


def _core_matrix(one, other, gram):
    """Return the normal matrix [a b q, a b q] of the cells of two cores, by their polar factors at the rows.

    `gram` [i, o, q, q] holds the products of the one's and the other's directional factors.
    """
    by_i, by_o = (_pairs(x, y) for x, y in zip(one, other, strict=True))
    matrix = np.tensordot(np.tensordot(by_i, gram.reshape(*gram.shape[:2], -1), (0, 0)), by_o, (1, 0))  # [aa, qq, bb]
    a, b = ((x.shape[1], y.shape[1]) for x, y in zip(one, other, strict=True))
    cells = a[0] * b[0] * gram.shape[2]
    return matrix.reshape(*a, *gram.shape[2:], *b).transpose(0, 4, 2, 1, 5, 3).reshape(cells, -1)


def _core_right(at, moment):
    """Return the right side [a b q, channel] of a core's normal equations."""
    right = np.tensordot(np.tensordot(at[0], moment, (0, 0)), at[1], (1, 0))  # [a, q, c, b]
    return right.transpose(0, 3, 1, 2).reshape(-1, moment.shape[3])


def _channel_pairs(part):
    """Return sum over channels of all products: [x, q, c, a] to [x, q q, a a]."""
    x, q, c, a = part.shape
    rows = part.transpose(0, 1, 3, 2).reshape(x, q * a, c)
    return (rows @ np.swapaxes(rows, 1, 2)).reshape(x, q, a, q, a).transpose(0, 1, 3, 2, 4).reshape(x * q * q, a * a)


def _unpair(matrix, m, n):
    """Return [m m, n n] as the square matrix [m n, m n]."""
    return matrix.reshape(m, m, n, n).transpose(0, 2, 1, 3).reshape(m * n, m * n)


def _solve_mode(functions, matrix, right):
    """Solve for the coefficients of a factor's functions, from normal equations [row, rank rank] of its rows."""
    size, rank = functions.shape[1], right.shape[1]
    whole = _unpair(_pairs(functions, functions).T @ matrix, size, rank)
    return _solve(whole, (functions.T @ right).reshape(-1, 1))[0].reshape(size, rank)


def _living(diagonal):
    """Return a diagonal with 1 for columns that have died out."""
    return np.where(diagonal > NOTHING * diagonal.max(), diagonal, 1.0)


def _scaled(matrix, right, ridge: float = RIDGE) -> CoreProblem:
    """Scale the diagonal of normal equations to 1, and add a small ridge, in place: a core's matrix takes 26 MB."""
    scale = 1 / np.sqrt(_living(np.diag(matrix)))
    matrix *= scale[:, None]
    matrix *= scale
    matrix[np.diag_indices_from(matrix)] += ridge
    return CoreProblem(matrix, scale[:, None] * right, scale)


def _solve(matrix, right, ridge: float = RIDGE):
    """Solve normal equations; their matrix, symmetric, is overwritten.

    Returns:
        The solution, the lower Cholesky factor of the scaled matrix, and the scale.
    """
    scaled, right, scale = _scaled(matrix, right, ridge)
    root, found, failed = scipy.linalg.lapack.dposv(scaled.T, right, lower=1, overwrite_a=1, overwrite_b=1)
    if failed:
        raise np.linalg.LinAlgError("normal equations are not positive definite")
    return scale[:, None] * found, root, scale


def inverse_of(matrix: Float[np.ndarray, "cell cell"]) -> Float[np.ndarray, "cell cell"]:
    """Return the inverse of a symmetric positive definite matrix, which is overwritten."""
    return mirrored(scipy.linalg.lapack.dpotri(lower_root(matrix), lower=1, overwrite_c=1)[0])


def lower_root(matrix: Float[np.ndarray, "cell cell"]) -> Float[np.ndarray, "cell cell"]:
    """Return the lower Cholesky factor of a symmetric matrix, which is overwritten.

    Raises:
        LinAlgError: It is not positive definite.
    """
    root, failed = scipy.linalg.lapack.dpotrf(matrix.T, lower=1, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("normal equations are not positive definite")
    return root
