"""Solvers and interpolators of other packages, where they are installed (extra `bench`), and which are not."""

from collections.abc import Callable
from importlib.util import find_spec

import numpy as np

PEERS = {"optax": "optax", "osqp": "osqp", "sklearn": "scikit-learn"}
OSQP_SECONDS = 60.0
KERNEL_POINTS = 400  # that a Gaussian process' kernel is fitted to


def missing() -> list[str]:
    """Packages of the extra `bench` that are not installed."""
    return [package for module, package in PEERS.items() if find_spec(module) is None]


def optax_solver(triangle: np.ndarray, target: np.ndarray) -> Callable[[int], np.ndarray] | None:
    """Return optax.nnls of |R x - t|, all lanes at once, as a function of its number of steps; None without optax."""
    if find_spec("optax") is None:
        return None
    import jax
    import jax.numpy as jnp
    import optax

    solve = jax.jit(optax.nnls, static_argnums=2)
    factor, lanes = jnp.asarray(triangle), jnp.asarray(target)
    return lambda steps: np.asarray(solve(factor, lanes, steps))


def osqp_solver(matrix: np.ndarray, rhs: np.ndarray) -> Callable[[float], np.ndarray] | None:
    """Return OSQP of 1/2 x'A'A x - x'A'b, lane after lane, as a function of its tolerance; None without OSQP.

    A lane ends after `OSQP_SECONDS` wherever it is; its residual says where that was.
    """
    if find_spec("osqp") is None:
        return None
    import osqp
    import scipy.sparse

    size = len(matrix)
    upper = scipy.sparse.triu(scipy.sparse.csc_matrix(matrix), format="csc")
    identity = scipy.sparse.identity(size, format="csc")

    def solve(tolerance: float) -> np.ndarray:
        columns = []
        for column in rhs.T:
            problem = osqp.OSQP()
            limits = {"l": np.zeros(size), "u": np.full(size, np.inf)}
            settings = {"eps_abs": tolerance, "eps_rel": tolerance, "max_iter": 20_000, "verbose": False}
            settings["time_limit"] = OSQP_SECONDS
            problem.setup(P=upper, q=-column, A=identity, **limits, **settings)
            found = problem.solve()
            columns.append(np.where(-found.y > found.x, 0.0, found.x))  # at the bound, where its multiplier says so
        return np.stack(columns, axis=1)

    return solve


def gaussian_process() -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None:
    """Return scikit-learn's Gaussian process (points, values, queries) -> values; None without scikit-learn.

    Its kernel is fitted to the mean of the columns at some of the points: at all of them, and to 31 columns at once,
    it takes minutes. All points and columns are then predicted from with this kernel.
    """
    if find_spec("sklearn") is None:
        return None
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    def predict(points: np.ndarray, values: np.ndarray, queries: np.ndarray) -> np.ndarray:
        kernel = ConstantKernel(1.0) * RBF(np.full(points.shape[1], 0.3), (0.03, 30.0)) + WhiteKernel(1e-3)
        some = slice(None, None, -(-len(points) // KERNEL_POINTS))
        fitted = GaussianProcessRegressor(kernel, normalize_y=True).fit(points[some], values[some].mean(axis=1))
        model = GaussianProcessRegressor(fitted.kernel_, optimizer=None, normalize_y=True)
        return model.fit(points, values).predict(queries)

    return predict
