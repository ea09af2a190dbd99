"""Problems with known answers, shared by tests and benchmarks."""

import dataclasses

import numpy as np

from sbrdf_jax.records import RawSamples


@dataclasses.dataclass(frozen=True)
class LeastSquaresProblem:
    """min 1/2 |A x - b|^2, x >= 0, a column of b per lane; `solution` where it is unique and known."""

    name: str
    matrix: np.ndarray  # [row, unknown]
    target: np.ndarray  # [row, lane]
    solution: np.ndarray | None  # [unknown, lane]


def _planted(name: str, rng: np.random.Generator, matrix: np.ndarray, lanes: int, share_active: float):
    """Choose the solution x and multipliers w >= 0 with x w = 0, then b such that A'(A x - b) = w."""
    unknowns = matrix.shape[1]
    active = rng.random((unknowns, lanes)) < share_active
    solution = np.where(active, 0.0, rng.uniform(0.5, 2.0, (unknowns, lanes)))
    multiplier = np.where(active, rng.uniform(0.5, 2.0, (unknowns, lanes)), 0.0)
    residual = np.linalg.pinv(matrix.T) @ multiplier
    return LeastSquaresProblem(name, matrix, matrix @ solution - residual, solution)


def least_squares_problems() -> list[LeastSquaresProblem]:
    """Random, badly scaled, correlated, rank-deficient, all-active, all-free, zero and single-unknown problems."""
    rng = np.random.default_rng(7)
    tall = rng.standard_normal((60, 25))
    scaled = tall * np.logspace(-3, 3, 25)
    smooth = np.exp(-((np.linspace(0, 1, 40)[:, None] - np.linspace(0, 1, 12)) ** 2) / 0.02)
    wide = rng.standard_normal((15, 40))
    twin = np.concatenate([tall[:, :12], tall[:, :12]], axis=1)
    positive = rng.uniform(0.0, 1.0, (30, 10))
    return [
        _planted("planted", rng, tall, 4, 0.4),
        _planted("planted, columns over six decades", rng, scaled, 3, 0.3),
        _planted("planted, correlated columns", rng, smooth, 3, 0.5),
        _planted("planted, none active", rng, tall, 2, 0.0),
        _planted("planted, all active", rng, tall, 2, 1.0),
        LeastSquaresProblem("random", tall, rng.standard_normal((60, 5)), None),
        LeastSquaresProblem("more unknowns than rows", wide, rng.standard_normal((15, 3)), None),
        LeastSquaresProblem("every column twice", twin, rng.standard_normal((60, 3)), None),
        LeastSquaresProblem("negative data: all active", positive, -rng.uniform(0, 1, (30, 3)), np.zeros((10, 3))),
        LeastSquaresProblem("zero data", tall, np.zeros((60, 2)), np.zeros((25, 2))),
        LeastSquaresProblem("one unknown", tall[:, :1], tall[:, :1] * np.array([[2.0, -1.0]]), np.array([[2.0, 0.0]])),
    ]


def singular_problem(condition: float, *, rows: int = 40, unknowns: int = 20, lanes: int = 3) -> LeastSquaresProblem:
    """A planted problem whose A'A, diagonally scaled, has about a condition number; some unknowns are at their bound.

    The columns are of unit length but for rounding: the singular values decay evenly, and a rotation spreads them.
    """
    rng = np.random.default_rng(13)
    left, right = (np.linalg.qr(rng.standard_normal((n, unknowns)))[0] for n in (rows, unknowns))
    matrix = left * np.geomspace(1.0, condition**-0.5, unknowns) @ right.T
    return _planted(f"condition number {condition:.0e}", rng, matrix / np.linalg.norm(matrix, axis=0), lanes, 0.3)


def scattered_samples(
    rng: np.random.Generator, theta_i_deg: list[float], num_directions: int, num_wavelengths: int, *, half: bool = False
) -> RawSamples:
    """A smooth positive field at random directions for each incident angle; `half`: azimuths in [180, 360] only."""
    theta_i = np.repeat(np.deg2rad(theta_i_deg), num_directions)
    theta_o = rng.uniform(0.0, np.deg2rad(85), theta_i.size)
    phi_o = rng.uniform(np.pi if half else 0.0, 2 * np.pi, theta_i.size)
    wavelength = np.linspace(400.0, 700.0, num_wavelengths)
    lobe = np.exp(-((theta_o - theta_i) ** 2 + (1 + np.cos(phi_o)) * np.sin(theta_o) ** 2) / 0.3)
    value = 0.1 + lobe[:, None] * (1 + 0.3 * np.sin(wavelength / 50)) + 0.02 * rng.standard_normal((theta_i.size, 1))
    return RawSamples(
        theta_i, theta_o, phi_o, wavelength, value, np.arange(theta_i.size), "brdf", "scattered", "builtin", "0" * 64
    )
