"""The real harmonics against SciPy's complex ones, their orthonormality and their poles."""

import jax
import numpy as np
import pytest
from scipy.special import roots_legendre, sph_harm_y
from tolerances import ROUNDING, tolerance

from sbrdf_jax.harmonics import harmonic_orders, real_harmonics

TIGHT = tolerance(ROUNDING, np.float64)
MAX_DEGREE = 12


def scipy_harmonics(theta, phi, max_degree):
    """The plain twin: real parts and imaginary parts of SciPy's, Condon-Shortley phase taken out."""
    values = []
    for l, m in harmonic_orders(max_degree):  # noqa: E741
        value = sph_harm_y(l, abs(m), theta, phi) * (-1) ** m * (np.sqrt(2) if m else 1)
        values.append(value.imag if m < 0 else value.real)
    return np.stack(values, axis=-1)


def test_they_are_scipys(rng):
    theta, phi = rng.uniform(0, np.pi, (2, 50)), rng.uniform(0, 2 * np.pi, (2, 50))
    theta[0, :2] = 0, np.pi
    found = real_harmonics(theta, phi, MAX_DEGREE)
    assert found.shape == (2, 50, (MAX_DEGREE + 1) ** 2)
    np.testing.assert_allclose(found, scipy_harmonics(theta, phi, MAX_DEGREE), rtol=0, atol=TIGHT)


def test_they_are_orthonormal_on_the_sphere():
    cos_theta, weight = roots_legendre(MAX_DEGREE + 1)  # exact for products of two of them
    phi = np.arange(2 * MAX_DEGREE + 1) * 2 * np.pi / (2 * MAX_DEGREE + 1)
    theta, phi = np.meshgrid(np.arccos(cos_theta), phi, indexing="ij")
    value = np.asarray(real_harmonics(theta, phi, MAX_DEGREE))
    gram = np.einsum("i,ijk,ijl->kl", weight * 2 * np.pi / phi.shape[1], value, value)
    np.testing.assert_allclose(gram, np.eye(len(gram)), rtol=0, atol=TIGHT)


def test_order_and_sign_are_as_documented():
    assert harmonic_orders(1) == [(0, 0), (1, -1), (1, 0), (1, 1)]
    theta, phi = np.array(0.7), np.array(2.1)
    x, y, z = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
    expected = np.sqrt(3 / (4 * np.pi)) * np.array([1 / np.sqrt(3), y, z, x])
    np.testing.assert_allclose(real_harmonics(theta, phi, 1), expected, rtol=0, atol=TIGHT)
    sign = np.array([1.0 if m >= 0 else -1.0 for _, m in harmonic_orders(4)])
    mirrored = sign * np.asarray(real_harmonics(theta, -phi, 4))
    np.testing.assert_allclose(mirrored, real_harmonics(theta, phi, 4), rtol=0, atol=TIGHT)


@pytest.mark.parametrize("theta", [0.0, np.pi])
def test_gradients_at_the_poles_are_those_of_the_smooth_function(theta):
    def values(theta, phi):
        return real_harmonics(theta, phi, 6)

    def twin(step):  # along the great circle through the pole, whose far side has the opposite azimuth
        beyond = step < 0 if theta == 0 else step > 0
        polar = abs(step) if theta == 0 else np.pi - abs(step)
        return scipy_harmonics(polar, 0.3 + np.pi * beyond, 6)

    slope = jax.jacfwd(values, argnums=(0, 1))(np.array(theta), np.array(0.3))
    np.testing.assert_allclose(slope[0], (twin(1e-5) - twin(-1e-5)) / 2e-5, rtol=0, atol=1e-7)
    np.testing.assert_allclose(slope[1], 0, rtol=0, atol=TIGHT)


def test_float32_stays_close(rng):
    theta, phi = rng.uniform(0, np.pi, 50), rng.uniform(0, 2 * np.pi, 50)
    found = real_harmonics(theta.astype(np.float32), phi.astype(np.float32), 8)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, real_harmonics(theta, phi, 8), rtol=0, atol=tolerance(ROUNDING, np.float32))
