"""Ward, isotropic (1992): f = k_d / pi + k_s exp(-tan^2 theta_h / a^2) / (4 pi a^2 sqrt(cos_i cos_o))."""

import jax.numpy as jnp

from sbrdf_jax.models.model import Cosines, Model, Parameter, floored, lambert_term


def terms(c: Cosines, parameters):
    """Return the diffuse and the specular term; `parameters` is the roughness a."""
    squared = parameters[0] ** 2
    tan_squared = 1 / floored(c.h) ** 2 - 1
    root = jnp.sqrt(floored(c.i) * floored(c.o))
    return lambert_term(c), jnp.exp(-tan_squared / squared) / (4 * jnp.pi * squared * root)


MODEL = Model("ward", (Parameter("roughness", 0.005, 2.0, (0.05, 0.15, 0.4)),), terms)
