"""Analytic models: hand values, energy, poles and grazing directions; fits against planted parameters and SciPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares, nnls

from sbrdf_jax.models import MODELS, model_value
from sbrdf_jax.models.fitting import Samples, equal_weights, fit_each_wavelength, fit_jointly, predict, project
from sbrdf_jax.models.model import cosines
from sbrdf_jax.records import Status

PLANTED = {
    "lambert": [],
    "phong": [20.0],
    "blinn_phong": [60.0],
    "lafortune": [15.0, 0.8],
    "ward": [0.2],
    "cook_torrance": [0.25, 0.1],
    "ggx": [0.2, 0.1],
    "strauss": [0.2, 0.2],
}
HAND = {  # the specular term at theta_i = theta_o = 60 degrees, mirror direction, of the parameters above
    "phong": 22 / (2 * np.pi),
    "blinn_phong": 62 * 64 / (8 * np.pi * (2.0**-30 + 60)),
    "lafortune": 17 / (2 * np.pi) * (2 * (0.75 + 0.8 * 0.25) / 1.8) ** 15,
    "ward": 1 / (4 * np.pi * 0.04 * 0.5),
    "cook_torrance": (0.1 + 0.9 * 0.5**5) / (np.pi * 0.0625),  # G = 1, 4 cos_i cos_o = 1
    "ggx": (0.1 + 0.9 * 0.5**5) / (np.pi * 0.04) * 0.5 / np.sqrt(0.04 + 0.96 * 0.25),
}


@functools.cache
def specular(name):
    model = MODELS[name]
    return jax.jit(lambda i, o, p, shape: model_value(model, i, o, p, shape, jnp.array([0.0, 1.0])))


QUICK = ("lambert", "ward", "ggx")  # one of each number of parameters; compiling a fit takes some ten seconds


@pytest.fixture
def scattered(rng):
    """Directions [rad] at three incident angles."""
    theta_i = np.repeat(np.radians([10.0, 35.0, 60.0]), 80)
    return theta_i, rng.uniform(0, 1.45, 240), rng.uniform(0, 2 * np.pi, 240)


def planted_samples(name, directions, scale=1.0):
    """Samples of a model at four wavelengths, and the amplitudes."""
    amplitude = np.array([[0.3, 0.2, 0.1, 0.4], [0.5, 0.6, 0.2, 0.1]])[: 1 if name == "lambert" else 2] * scale
    c = cosines(*(jnp.asarray(a) for a in directions))
    terms = MODELS[name].terms(c, jnp.asarray(PLANTED[name]))
    value = np.stack(terms, axis=1) @ amplitude
    return Samples(*directions, value, equal_weights(directions[0], value)), amplitude


def each(name, samples):
    """The fit of each wavelength, of one model with a parameter: it compiles for seconds."""
    return [fit_each_wavelength(MODELS[name], samples)] if name == "ward" else []


@pytest.mark.parametrize("name", HAND)
def test_hand_values_in_the_mirror_direction(name):
    angle = jnp.asarray(np.radians(60.0))
    found = specular(name)(angle, angle, jnp.asarray(np.pi), jnp.asarray(PLANTED[name]))
    np.testing.assert_allclose(found, HAND[name], rtol=1e-9)


def test_strauss_reaches_his_limits():
    """Smooth and at normal incidence the specular term is r; at grazing incidence its mirror reflectance is 1."""
    shape = jnp.array([0.05, 0.2])
    zero = jnp.asarray(0.0)
    np.testing.assert_allclose(specular("strauss")(zero, zero, zero, shape), 0.2, rtol=1e-6)


def test_lafortune_of_ratio_one_is_phong(scattered):
    directions = [jnp.asarray(a) for a in scattered]
    one = specular("lafortune")(*directions, jnp.array([20.0, 1.0]))
    np.testing.assert_allclose(one, specular("phong")(*directions, jnp.array([20.0])), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", ["phong", "blinn_phong", "ward", "ggx"])
def test_albedo_at_normal_incidence_is_what_the_normalisation_says(name):
    point, weight = np.polynomial.legendre.leggauss(400)
    theta_o, weight = (point + 1) * np.pi / 4, weight * np.pi / 4
    shape = jnp.asarray([0.1, 1.0] if name == "ggx" else [0.1] if name == "ward" else PLANTED[name])
    zero = jnp.zeros_like(theta_o)
    value = np.asarray(specular(name)(zero, jnp.asarray(theta_o), zero, shape))
    albedo = 2 * np.pi * (weight * value * np.cos(theta_o) * np.sin(theta_o)).sum()
    tolerance = {"ward": 0.03, "ggx": 0.03}.get(name, 1e-6)  # Ward's holds for small roughness; shadowing takes some
    assert abs(albedo - 1) < tolerance


@pytest.mark.parametrize("name", MODELS)
def test_never_nan_nor_negative_at_the_poles_and_at_grazing(name):
    edge = np.array([0.0, 1e-9, 0.8, np.pi / 2])
    grid = [jnp.asarray(a.ravel()) for a in np.meshgrid(edge, edge, [0.0, 1.0, np.pi], indexing="ij")]
    model = MODELS[name]
    for which in ("low", "high"):
        shape = jnp.asarray([getattr(p, which) for p in model.parameters])

        def values(shape):
            return jnp.stack(model.terms(cosines(*grid), shape))

        value, slope = values(shape), jax.jacfwd(values)(shape)
        assert np.isfinite(value).all() and (np.asarray(value) >= 0).all() and np.isfinite(slope).all()


@pytest.mark.parametrize("name", [pytest.param(m, marks=() if m in QUICK else pytest.mark.slow) for m in MODELS])
def test_planted_parameters_come_back(name, scattered):
    samples, amplitude = planted_samples(name, scattered)
    for fit in (fit_jointly(MODELS[name], samples), *each(name, samples)):
        np.testing.assert_array_equal(fit.status, Status.OK)
        assert fit.relative_error.max() < 1e-4
        np.testing.assert_allclose(predict(MODELS[name], fit, *scattered), samples.value, rtol=0, atol=1e-3)
        if name not in ("cook_torrance", "ggx", "strauss"):  # those trade reflectance for amplitude
            np.testing.assert_allclose(fit.parameters, np.tile(PLANTED[name], (4, 1)), rtol=1e-3)
            np.testing.assert_allclose(fit.amplitude, amplitude.T, rtol=1e-2)


def test_a_fit_is_no_worse_than_scipys_and_a_bad_lane_harms_no_other(scattered, rng):
    samples, _ = planted_samples("ggx", scattered)
    value = samples.value * (1 + 0.2 * rng.normal(size=samples.value.shape))
    value[:, 3] = np.nan
    value[:, 2] = 0.0
    weight = equal_weights(scattered[0], value[:, :2])
    samples = Samples(*scattered, value, weight)
    model = MODELS["ggx"]
    fit = fit_each_wavelength(model, samples)
    assert np.isin(fit.status[:2], [Status.OK, Status.MAX_STEPS]).all()  # roughness and reflectance trade places
    np.testing.assert_array_equal(fit.status[2:], [Status.OK, Status.NONFINITE])
    assert fit.relative_error[2] == 0
    c, root = cosines(*(jnp.asarray(a) for a in scattered)), jnp.asarray(np.sqrt(weight))
    left = jax.jit(lambda shape: project(model, c, root, jnp.asarray(value[:, :1]), shape)[1].ravel())
    bounds = tuple(np.array([[p.low, p.high] for p in model.parameters]).T)
    best = min(least_squares(left, start, bounds=bounds, x_scale=(0.1, 0.1)).cost for start in ([0.1, 0.2], [0.3, 0.5]))
    error = fit.relative_error[0] ** 2 * (weight @ value[:, 0] ** 2)
    assert error <= 2 * best * (1 + 1e-4)


def test_amplitudes_are_those_of_scipys_nnls(scattered, rng):
    c, weight = cosines(*(jnp.asarray(a) for a in scattered)), rng.uniform(0.5, 2, 240)
    value = rng.normal(size=(240, 30)) * np.linspace(0.1, 3, 30) + rng.normal(size=30)
    shape = jnp.asarray([0.2])
    found = np.asarray(project(MODELS["ward"], c, jnp.asarray(np.sqrt(weight)), jnp.asarray(value), shape)[0])
    terms = np.stack(MODELS["ward"].terms(c, shape), axis=1) * np.sqrt(weight)[:, None]
    for own, column in zip(found.T, value.T, strict=True):
        np.testing.assert_allclose(own, nnls(terms, np.sqrt(weight) * column)[0], rtol=1e-7, atol=1e-9)
