"""Plain ways to store a field, for comparison: what numbers they take and what they give back.

Each takes the grid's spectra [theta_i, theta_o, phi_o, wavelength], which incident angles count,
and a budget of numbers; each returns the numbers used and the field, or None where nothing fits.
Mirror images are stored once, and incident angles that do not count not at all.
"""

import numpy as np
import scipy.fft

from sbrdf_jax.harmonics import harmonic_orders, real_harmonics


def _half(brdf, known):
    """Return one side of the plane of incidence of what counts, scaled to equal energy, and the scales."""
    half = brdf[known][:, :, : brdf.shape[2] // 2 + 1]
    scale = np.sqrt((half**2).sum(axis=(1, 2, 3), keepdims=True))
    return half / scale, scale


def _whole(half, known, shape):
    found = np.zeros(shape)
    found[known] = np.concatenate([half, half[:, :, -2::-1]], axis=2)
    return found


def truncated_svd(brdf, known, budget):
    """Directions times wavelengths, incident angles scaled to equal energy."""
    half, scale = _half(brdf, known)
    matrix = half.reshape(-1, brdf.shape[3])
    rank = int((budget - len(scale)) // sum(matrix.shape))
    if rank < 1:
        return 0, None
    u, s, v = np.linalg.svd(matrix, full_matrices=False)
    found = ((u[:, :rank] * s[:rank]) @ v[:rank]).reshape(half.shape) * scale
    return rank * sum(matrix.shape) + len(scale), _whole(found, known, brdf.shape)


def tucker(brdf, known, budget):
    """HOSVD without a lobe, incident angles scaled to equal energy, ranks grown by energy for each number."""
    half, scale = _half(brdf, known)
    factors = []
    for mode in range(4):
        unfolded = np.moveaxis(half, mode, 0).reshape(half.shape[mode], -1)
        factors.append(np.linalg.svd(unfolded, full_matrices=False)[0])
    core = np.einsum("iopw,ia,ob,pc,wd->abcd", half, *factors, optimize=True)

    def count(ranks):
        return int(np.prod(ranks)) + sum(r * n for r, n in zip(ranks, half.shape, strict=True)) + len(scale)

    held = core**2  # of ranks up to an entry's place, once it is summed over all modes
    for mode in range(4):
        held = held.cumsum(axis=mode)

    def energy(ranks):
        return held[tuple(rank - 1 for rank in ranks)]

    ranks = [1, 1, 1, 1]
    while True:
        best = 0.0, None
        for mode in range(4):
            trial = [r + (k == mode) for k, r in enumerate(ranks)]
            if trial[mode] > half.shape[mode] or count(trial) > budget:
                continue
            gain = (energy(trial) - energy(ranks)) / (count(trial) - count(ranks))
            best = max(best, (gain, trial), key=lambda found: found[0])
        if best[1] is None:
            break
        ranks = best[1]
    kept = core[tuple(slice(r) for r in ranks)]
    found = np.einsum("abcd,ia,ob,pc,wd->iopw", kept, *(f[:, :r] for f, r in zip(factors, ranks, strict=True)))
    return count(ranks), _whole(found * scale, known, brdf.shape)


def harmonics(brdf, known, budget):
    """Even spherical harmonics of each incident angle and spectral vector, no lobe: the best degree that fits."""
    half, scale = _half(brdf, known)
    count_i, count_o, count_phi, count_w = half.shape
    theta, phi = np.meshgrid(np.linspace(0, np.pi / 2, count_o), np.linspace(0, np.pi, count_phi), indexing="ij")
    vectors = np.linalg.svd(half.reshape(-1, count_w), full_matrices=False)[2]
    best = 0, None, np.inf
    for degree in range(1, 13):
        even = [m >= 0 for _, m in harmonic_orders(degree)]
        function = np.asarray(real_harmonics(theta, phi, degree))[..., even].reshape(-1, sum(even))
        for rank in range(1, min(8, count_w) + 1):
            numbers = count_i * function.shape[1] * rank + rank * count_w + count_i
            if numbers > budget:
                continue
            wanted = (half @ vectors[:rank].T).reshape(count_i, -1, rank)
            fitted = function @ np.linalg.lstsq(function, wanted.transpose(1, 0, 2).reshape(len(function), -1))[0]
            found = fitted.reshape(count_o, count_phi, count_i, rank).transpose(2, 0, 1, 3) @ vectors[:rank]
            error = ((found - half) ** 2).sum()
            if error < best[2]:
                best = numbers, found, error
    return (0, None) if best[1] is None else (best[0], _whole(best[1] * scale, known, brdf.shape))


def cosine_transform(brdf, known, budget):
    """The largest coefficients of a 4-D DCT, each with its index as a second number."""
    half, scale = _half(brdf, known)
    coefficient = scipy.fft.dctn(half, norm="ortho")
    count = int(budget - len(scale)) // 2
    kept = np.zeros(coefficient.size)
    largest = np.argpartition(-np.abs(coefficient).ravel(), count)[:count]
    kept[largest] = coefficient.ravel()[largest]
    found = scipy.fft.idctn(kept.reshape(half.shape), norm="ortho") * scale
    return 2 * count + len(scale), _whole(found, known, brdf.shape)


BASELINES = {"svd": truncated_svd, "tucker": tucker, "harmonics": harmonics, "dct": cosine_transform}
