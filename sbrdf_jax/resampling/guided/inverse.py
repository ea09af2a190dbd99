"""The inverse of prior covariance plus noise, on the host, and the closed forms that it gives."""

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg.blas
import scipy.linalg.lapack

from sbrdf_jax.host_blas import mirrored, one_blas_thread

Blocks = list[tuple[np.ndarray, np.ndarray]]


class Whitener(NamedTuple):
    """Factors of the inverse of prior plus noise, W'W - V'V."""

    lower: Any  # W [centre, centre] inverse Cholesky factor, lower triangular, of prior plus equal noise
    doubt: Any  # V [doubted, centre] what more noise of a few centres takes from it


def lower_inverse(prior: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Lower triangle of the inverse of prior covariance [centre, centre] plus noise [centre]; nan where it has none."""
    return lower_product(whitener(prior, noise))


def whitener(prior: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Inverse W of the lower Cholesky factor of prior plus noise: the inverse is W'W; nan where there is none."""
    total = np.array(prior, order="F")
    total[np.diag_indices_from(total)] += noise
    with one_blas_thread():
        factor, failed = scipy.linalg.lapack.dpotrf(total, lower=1, overwrite_a=1)  # zeros above the diagonal
        if failed:
            return np.full_like(total, np.nan)
        return scipy.linalg.lapack.dtrtri(factor, lower=1, overwrite_c=1)[0]


def lower_product(whiten: np.ndarray) -> np.ndarray:
    """Lower triangle of W'W; what is above is not to be read."""
    with one_blas_thread():
        return scipy.linalg.lapack.dlauum(whiten, lower=1)[0]


def doubted(lower: np.ndarray, extra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give a few centres more noise, by Woodbury's formula: at a cost that grows with how many they are.

    Args:
        lower: Lower triangle of C, the inverse of prior plus noise.
        extra: Noise variance that is added [centre].

    Returns:
        V [doubted, centre], and the lower triangle of the new inverse, C - V'V; nan where there is none.
    """
    rows = np.flatnonzero(extra)
    if not len(rows):
        return np.zeros((0, len(lower))), lower
    across = np.where(np.arange(len(lower)) >= rows[:, None], lower[:, rows].T, lower[rows])
    whiten = whitener(across[:, rows], 1 / extra[rows])
    with one_blas_thread():
        doubt = whiten @ across
        return doubt, scipy.linalg.blas.dsyrk(-1.0, doubt, beta=1.0, c=lower, trans=1, lower=1)


def mirror_lower(lower: np.ndarray) -> np.ndarray:
    """Symmetric matrix from its lower triangle; what is above is not read."""
    return mirrored(np.array(lower))


def leave_one_out(lower: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact leave-one-out residuals [centre, wavelength], (C r)_i / C_ii, and C r.

    Args:
        lower: Lower triangle of C, the inverse of prior plus noise.
        residual: r [centre, wavelength].
    """
    with one_blas_thread():
        dual = scipy.linalg.blas.dsymm(1.0, lower, residual, lower=1)
    return dual / np.diag(lower)[:, None], dual


def group_blocks(lower: np.ndarray, group: np.ndarray) -> Blocks:
    """Rows of each group, and the lower triangle of C_gg^-1.

    Args:
        lower: Lower triangle of C, the inverse of prior plus noise.
        group: Group number per centre; negative ones are in none.
    """
    members = [np.flatnonzero(group == number) for number in np.unique(group[group >= 0])]
    inside = [mirror_lower(lower[np.ix_(rows, rows)]) for rows in members]
    return [(rows, lower_inverse(block, np.zeros(len(rows)))) for rows, block in zip(members, inside, strict=True)]


def leave_group_out(blocks: Blocks, dual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact residuals of leaving whole groups out, and their variances: C_gg^-1 (C r)_g, diagonal of C_gg^-1.

    Args:
        blocks: From `group_blocks`; centres in none are left in always, and get zeros.
        dual: C r [centre, wavelength].
    """
    out, variance = np.zeros_like(dual), np.zeros(len(dual))
    for rows, block in blocks:
        with one_blas_thread():
            out[rows] = scipy.linalg.blas.dsymm(1.0, block, dual[rows], lower=1)
        variance[rows] = np.diag(block)
    return out, variance
