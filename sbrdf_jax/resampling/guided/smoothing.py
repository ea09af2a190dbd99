"""How smooth: chosen by the data, by closed-form leave-one-out and leave-one-incident-angle-out."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from sbrdf_jax.resampling.guided.coordinates import Coordinates
from sbrdf_jax.resampling.guided.kernel import (
    BETWEEN_KERNELS,
    MEASURED_KERNELS,
    Kernel,
    factorise,
    invert,
    leave_one_out,
    solve_dual,
)

NOISE_LADDER = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 3e-1)  # noise variance relative to the half-angle term's
FIRST_NOISE = 1e-3
PADDING_NOISE = 1e12


class Choice(NamedTuple):
    """A kernel and a noise level, and the curve that led to them: (kernel, noise, score) each."""

    name: str
    kernel: Kernel
    noise: float
    curve: tuple[tuple[str, float, float], ...]


def choose_smoothing(
    at: Coordinates, residual: np.ndarray, count: np.ndarray, padding: np.ndarray, noise: float | None
) -> Choice:
    """Choose the kernel and the noise by the mean root of the leave-one-out residuals, squared: outliers count little.

    The noise climbs a ladder with the first kernel; the other kernels are tried at its best step.

    Args:
        at: Coordinates of the centres.
        residual: z minus the lobe model's [centre, wavelength].
        count: Samples that each centre stands for.
        padding: True where a centre is none.
        noise: Fixed relative noise variance; None: chosen.
    """
    curve: list[tuple[str, float, float]] = []

    def score(name: str, level: float) -> float:
        variance = jnp.asarray(np.where(padding, PADDING_NOISE, level / count))
        factor = factorise(MEASURED_KERNELS[name], at, variance)
        out, _ = leave_one_out(factor, solve_dual(factor, jnp.asarray(residual)))
        value = float(np.mean(np.sqrt(np.abs(np.asarray(out)[~padding]))) ** 2)
        curve.append((name, level, value if np.isfinite(value) else np.inf))
        return curve[-1][2]

    first = next(iter(MEASURED_KERNELS))
    if noise is None:
        at_step = NOISE_LADDER.index(FIRST_NOISE)
        best = score(first, NOISE_LADDER[at_step])
        for direction in (1, -1):
            moved = False
            while 0 <= at_step + direction < len(NOISE_LADDER):
                value = score(first, NOISE_LADDER[at_step + direction])
                if not value < best:
                    break
                best, at_step, moved = value, at_step + direction, True
            if moved:
                break
        noise = NOISE_LADDER[at_step]
    else:
        best = score(first, noise)
    name = first
    for other in list(MEASURED_KERNELS)[1:]:
        value = score(other, noise)
        if value < best:
            name, best = other, value
    return Choice(name, MEASURED_KERNELS[name], noise, tuple(curve))


def leave_group_out(inverse: np.ndarray, dual: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact residuals of leaving whole groups out, and their variances: C_gg^-1 (C r)_g, diagonal of C_gg^-1.

    Args:
        inverse: C, the inverse of covariance plus noise.
        dual: C r [centre, wavelength].
        group: Group number per centre; negative ones are left in always, and get zeros.
    """
    out, variance = np.zeros_like(dual), np.zeros(len(dual))
    for number in np.unique(group[group >= 0]):
        rows = np.flatnonzero(group == number)
        block = np.linalg.inv(inverse[np.ix_(rows, rows)])
        out[rows], variance[rows] = block @ dual[rows], np.diag(block)
    return out, variance


class BetweenChoice(NamedTuple):
    """The kernel between incident angles, its dual coefficients, its group residuals and their variances."""

    name: str
    kernel: Kernel
    dual: np.ndarray
    residual: np.ndarray
    variance: np.ndarray
    curve: tuple[tuple[str, float, float], ...]


def choose_between(
    at: Coordinates, residual: np.ndarray, variance: np.ndarray, group: np.ndarray, noise: float
) -> BetweenChoice:
    """Choose the kernel between incident angles by the median absolute leave-one-incident-angle-out residual."""
    best = None
    curve = []
    for name, kernel in BETWEEN_KERNELS.items():
        factor = factorise(kernel, at, jnp.asarray(variance))
        dual = np.asarray(solve_dual(factor, jnp.asarray(residual)))
        out, spread = leave_group_out(np.asarray(invert(factor)), dual, group)
        value = float(np.median(np.abs(out[group >= 0])))
        curve.append((name, noise, value))
        if best is None or value < best[0]:
            best = (value, BetweenChoice(name, kernel, dual, out, spread, ()))
    assert best is not None  # there is at least one candidate
    return best[1]._replace(curve=tuple(curve))
