"""Blinn-Phong: f = k_d / pi + k_s N (n . h)^n, with N = (n + 2) (n + 4) / (8 pi (2^(-n/2) + n)).

N makes the albedo at normal incidence k_s (Giesen's normalisation).
"""

import jax.numpy as jnp

from sbrdf_jax.models.model import Cosines, Model, Parameter, lambert_term, power


def terms(c: Cosines, parameters):
    """Return the diffuse and the specular term; `parameters` is the exponent."""
    n = parameters[0]
    scale = (n + 2) * (n + 4) / (8 * jnp.pi * (jnp.exp(-n / 2 * jnp.log(2.0)) + n))
    return lambert_term(c), scale * power(c.h, n)


MODEL = Model("blinn_phong", (Parameter("exponent", 0.1, 4e4, (10.0, 100.0, 1000.0)),), terms)
