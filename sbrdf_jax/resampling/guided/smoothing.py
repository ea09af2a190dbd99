"""How smooth: chosen by the data, by closed-form leave-one-out."""

from typing import NamedTuple

import numpy as np
import scipy.linalg.blas
import scipy.linalg.lapack

from sbrdf_jax.resampling.guided.centres import Centres
from sbrdf_jax.resampling.guided.nodes import ModeVariance, Term, mode_variance

CONSTANT = 1e-2  # variance of a constant, relative to the half-angle term's
_WIDE = Term("half", 1.5, 1.0, (3.0, 1.0, 1.0))
_LONG = Term("azimuth", 0.5, 0.3, (10.0, 3.3, 3.3))
_FINE = Term("azimuth", 0.5, 0.06, (3.0, 0.4, 1.0))
PRIORS = {"fine": (_WIDE, _LONG, _FINE), "smooth": (_WIDE, _LONG)}  # candidates
NOISE_LADDER = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 3e-1)  # noise variance relative to the half-angle term's
FIRST_NOISE = 3e-3
PADDING_NOISE = 1e12


class Choice(NamedTuple):
    """A prior and a noise level, and the curve that led to them: (prior, noise, score) each."""

    name: str
    variance: ModeVariance
    noise: float
    curve: tuple[tuple[str, float, float], ...]
    left_out: np.ndarray  # [centre, wavelength] leave-one-out residuals


def lower_inverse(prior: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Lower triangle of the inverse of prior covariance [centre, centre] plus noise [centre]; nan where it has none."""
    total = np.array(prior, order="F")
    total[np.diag_indices_from(total)] += noise
    factor, failed = scipy.linalg.lapack.dpotrf(total, lower=1, overwrite_a=1)
    if failed:
        return np.full_like(total, np.nan)
    return scipy.linalg.lapack.dpotri(factor, lower=1, overwrite_c=1)[0]


def invert(prior: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Inverse of prior covariance plus noise."""
    lower = np.tril(lower_inverse(prior, noise))
    return lower + np.tril(lower, -1).T


def leave_one_out(prior: np.ndarray, noise: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Exact leave-one-out residuals [centre, wavelength]: with C the inverse of prior plus noise, (C r)_i / C_ii."""
    lower = lower_inverse(prior, noise)
    return scipy.linalg.blas.dsymm(1.0, lower, residual, lower=1) / np.diag(lower)[:, None]


def leave_group_out(inverse: np.ndarray, dual: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact residuals of leaving whole groups out, and their variances: C_gg^-1 (C r)_g, diagonal of C_gg^-1.

    Args:
        inverse: C, the inverse of prior plus noise.
        dual: C r [centre, wavelength].
        group: Group number per centre; negative ones are left in always, and get zeros.
    """
    out, variance = np.zeros_like(dual), np.zeros(len(dual))
    for number in np.unique(group[group >= 0]):
        rows = np.flatnonzero(group == number)
        block = np.linalg.inv(inverse[np.ix_(rows, rows)])
        out[rows], variance[rows] = block @ dual[rows], np.diag(block)
    return out, variance


def noise_of(level: float, number: np.ndarray) -> np.ndarray:
    """Noise variance [centre] of centres that stand for `number` samples each; without effect where there is none."""
    return np.where(number > 0, level / np.maximum(number, 1), PADDING_NOISE)


def choose_smoothing(centres: Centres, residual: np.ndarray, number: np.ndarray, noise: float | None) -> Choice:
    """Choose the prior and the noise by the mean root of the leave-one-out residuals, squared: outliers count little.

    The noise climbs a ladder with the first prior; the others are tried at its best step.

    Args:
        centres: Where the samples are.
        residual: z minus the lobe model's [centre, wavelength].
        number: Samples that each centre stands for.
        noise: Fixed relative noise variance; None: chosen.
    """
    curve: list[tuple[str, float, float]] = []
    left_out: dict[tuple[str, float], np.ndarray] = {}
    used = number > 0

    def score(name: str, level: float) -> float:
        prior = np.asarray(centres.prior(mode_variance(PRIORS[name], CONSTANT)))
        out = leave_one_out(prior, noise_of(level, number), residual)
        left_out[name, level] = out
        value = float(np.mean(np.sqrt(np.abs(out[used]))) ** 2)
        curve.append((name, level, value if np.isfinite(value) else np.inf))
        return curve[-1][2]

    first, *others = PRIORS
    if noise is None:
        step = NOISE_LADDER.index(FIRST_NOISE)
        best = score(first, NOISE_LADDER[step])
        for direction in (1, -1):
            start = step
            while 0 <= step + direction < len(NOISE_LADDER):
                value = score(first, NOISE_LADDER[step + direction])
                if not value < best:
                    break
                best, step = value, step + direction
            if step != start:
                break
        noise = NOISE_LADDER[step]
    else:
        best = score(first, noise)
    name = first
    for other in others:
        value = score(other, noise)
        if value < best:
            name, best = other, value
    return Choice(name, mode_variance(PRIORS[name], CONSTANT), noise, tuple(curve), left_out[name, noise])
