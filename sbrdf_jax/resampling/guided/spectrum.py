"""Noise that is each wavelength's own: spectra are kept in the components that predict directions left out."""

from typing import NamedTuple

import numpy as np
import scipy.linalg

from sbrdf_jax.host_blas import one_blas_thread

MOST_COMPONENTS = 64
DIRECTIONS_A_COMPONENT = 4  # fewer say nothing of what is noise
CALM_SHARE = 0.1  # of the directions, from which on their errors count against them


class SpectralFilter(NamedTuple):
    """A projection of spectra, row @ to_component @ from_component; without components it leaves them as they are."""

    to_component: np.ndarray  # [wavelength, component]
    from_component: np.ndarray  # [component, wavelength]

    def __call__(self, spectra: np.ndarray) -> np.ndarray:
        """Project spectra [direction, wavelength]."""
        with one_blas_thread():
            return (spectra @ self.to_component) @ self.from_component if self.to_component.size else spectra


def spectral_filter(z: np.ndarray, left_out: np.ndarray) -> SpectralFilter:
    """Find the components of the spectra that are worth keeping.

    Principal components of the predictions, each wavelength in units of its own error; a component is
    kept where predictions of directions left out are nearer to it than 0 is: |c - p|^2 < |c|^2.

    Args:
        z: Generalised logarithms [direction, wavelength].
        left_out: What they differ by from predictions that did not see the direction.
    """
    count = min(z.shape[1], MOST_COMPONENTS)
    size = np.sqrt(np.mean(left_out**2, axis=1))
    if len(z) < DIRECTIONS_A_COMPONENT * count or not np.all(np.isfinite(size)) or not size.any():
        return _keep_all(z.shape[1])
    weight = 1 / np.maximum(size / np.maximum(np.quantile(size, CALM_SHARE), 1e-3 * size.max()), 1.0)[:, None]
    error = np.sqrt(np.mean((weight * left_out) ** 2, axis=0))
    error = np.maximum(error, 1e-6 * error.max())
    spectra, predicted = weight * z / error, weight * (z - left_out) / error
    with one_blas_thread():
        last = z.shape[1] - 1
        of_largest = [last - count + 1, last]
        component = scipy.linalg.eigh(predicted.T @ predicted, subset_by_index=of_largest)[1]
        found, guess = spectra @ component, predicted @ component
    kept = np.sum((found - guess) ** 2, axis=0) < np.sum(found**2, axis=0)
    if not kept.any() or kept.sum() == z.shape[1]:
        return _keep_all(z.shape[1])
    return SpectralFilter(component[:, kept] / error[:, None], component[:, kept].T * error)


def _keep_all(wavelengths: int) -> SpectralFilter:
    return SpectralFilter(np.zeros((wavelengths, 0)), np.zeros((0, wavelengths)))
