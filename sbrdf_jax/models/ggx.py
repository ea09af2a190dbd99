"""GGX (Walter et al. 2007) with height-correlated Smith shadowing: f = k_d / pi + k_s D F V.

D = a^2 / (pi (cos^2 theta_h (a^2 - 1) + 1)^2), F is Schlick's, and
V = 1 / (2 (cos_o sqrt(a^2 + (1 - a^2) cos_i^2) + cos_i sqrt(a^2 + (1 - a^2) cos_o^2))).
"""

import jax.numpy as jnp

from sbrdf_jax.models.model import Cosines, Model, Parameter, floored, lambert_term, schlick


def terms(c: Cosines, parameters):
    """Return the diffuse and the specular term; `parameters` are the roughness a and the reflectance at normal."""
    squared, f0 = parameters[0] ** 2, parameters[1]
    distribution = squared / (jnp.pi * (c.h**2 * (squared - 1) + 1) ** 2)
    i, o = floored(c.i), floored(c.o)
    root_i, root_o = (jnp.sqrt(squared + (1 - squared) * cosine**2) for cosine in (i, o))
    visibility = 0.5 / (o * root_i + i * root_o)
    return lambert_term(c), distribution * schlick(f0, c.d) * visibility


ROUGHNESS = Parameter("roughness", 0.005, 1.0, (0.05, 0.15, 0.4))
MODEL = Model("ggx", (ROUGHNESS, Parameter("f0", 0.01, 1.0, (0.04, 0.8))), terms)
