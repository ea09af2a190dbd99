"""Phong, as a BRDF (Lafortune and Willems): f = k_d / pi + k_s (n + 2) / (2 pi) cos^n of the angle to the mirror."""

import jax.numpy as jnp

from sbrdf_jax.models.model import Cosines, Model, Parameter, lambert_term, power


def terms(c: Cosines, parameters):
    """Return the diffuse and the specular term; `parameters` is the exponent."""
    exponent = parameters[0]
    return lambert_term(c), (exponent + 2) / (2 * jnp.pi) * power(c.mirror, exponent)


MODEL = Model("phong", (Parameter("exponent", 0.1, 1e4, (3.0, 30.0, 300.0)),), terms)
