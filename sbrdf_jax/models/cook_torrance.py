"""Cook-Torrance with Beckmann's distribution: f = k_d / pi + k_s D F G / (4 cos_i cos_o).

D = exp(-tan^2 theta_h / m^2) / (pi m^2 cos^4 theta_h), G = min(1, 2 (n.h) (n.o) / (o.h), 2 (n.h) (n.i) / (o.h)),
and F is Schlick's.
"""

import jax.numpy as jnp

from sbrdf_jax.models.model import Cosines, Model, Parameter, floored, lambert_term, schlick


def terms(c: Cosines, parameters):
    """Return the diffuse and the specular term; `parameters` are the roughness m and the reflectance at normal."""
    roughness, f0 = parameters
    h = floored(c.h)
    distribution = jnp.exp((1 - 1 / h**2) / roughness**2) / (jnp.pi * roughness**2 * h**4)
    shadow = jnp.minimum(1.0, 2 * h * jnp.minimum(floored(c.i), floored(c.o)) / floored(c.d))
    return lambert_term(c), distribution * schlick(f0, c.d) * shadow / (4 * floored(c.i) * floored(c.o))


ROUGHNESS = Parameter("roughness", 0.005, 2.0, (0.05, 0.15, 0.4))
MODEL = Model("cook_torrance", (ROUGHNESS, Parameter("f0", 0.01, 1.0, (0.04, 0.8))), terms)
