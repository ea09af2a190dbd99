"""Strauss (1990): smoothness s and specular reflectance r, as a BRDF with amplitudes free for each wavelength.

f = k_d (1 - s^3) / pi + k_s cos^h(mirror) min(1, r + (r + k_j) F(i) G(i) G(o)) / cos_i, with h = 3 / (1 - s),

    F(x) = (1 / (x - k_f)^2 - 1 / k_f^2) / (1 / (1 - k_f)^2 - 1 / k_f^2),
    G(x) = (1 / (1 - k_g)^2 - 1 / (x - k_g)^2) / (1 / (1 - k_g)^2 - 1 / k_g^2),

x the polar angle over 90 degrees, k_f = 1.12, k_g = 1.01, k_j = 0.1. Strauss mixes both colours by
metalness and transparency; here they are the amplitudes.
"""

import jax.numpy as jnp

from sbrdf_jax.models.model import Cosines, Model, Parameter, floored, lambert_term, power

K_F, K_G, K_J = 1.12, 1.01, 0.1


def terms(c: Cosines, parameters):
    """Return the diffuse and the specular term; `parameters` are 1 - s and r."""
    rough, reflectance = parameters
    x_i, x_o = (2 / jnp.pi * jnp.arccos(jnp.clip(cosine, 1e-9, 1 - 1e-9)) for cosine in (c.i, c.o))
    fresnel = (1 / (x_i - K_F) ** 2 - 1 / K_F**2) / (1 / (1 - K_F) ** 2 - 1 / K_F**2)
    seen = fresnel * _shadow(x_i) * _shadow(x_o)
    adjusted = jnp.minimum(1.0, reflectance + (reflectance + K_J) * seen)
    specular = power(c.mirror, 3 / rough) * adjusted / floored(c.i)
    return (1 - (1 - rough) ** 3) * lambert_term(c), specular


def _shadow(x):
    most = 1 / (1 - K_G) ** 2
    return (most - 1 / (x - K_G) ** 2) / (most - 1 / K_G**2)


MODEL = Model(
    "strauss", (Parameter("1 - smoothness", 3e-4, 1.0, (0.01, 0.1, 0.5)), Parameter("r", 0.01, 1.0, (0.1,))), terms
)
