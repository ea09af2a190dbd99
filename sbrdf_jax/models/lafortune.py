"""Lafortune, one isotropic lobe: f = k_d / pi + k_s (n + 2) / (2 pi) (C_xy (x x' + y y') + C_z z z')^n.

C_xy is negative; only the ratio rho = C_z / -C_xy is free, and both are scaled so that the
mirror direction at 45 degrees has the value of Phong, which rho = 1 is.
"""

import jax.numpy as jnp

from sbrdf_jax.models.model import Cosines, Model, Parameter, lambert_term, power


def terms(c: Cosines, parameters):
    """Return the diffuse and the specular term; `parameters` are the exponent and rho."""
    exponent, ratio = parameters
    in_plane = c.mirror - c.i * c.o  # -(x x' + y y')
    base = 2 * (in_plane + ratio * c.i * c.o) / (1 + ratio)
    return lambert_term(c), (exponent + 2) / (2 * jnp.pi) * power(base, exponent)


EXPONENT = Parameter("exponent", 0.1, 1e3, (3.0, 30.0))
MODEL = Model("lafortune", (EXPONENT, Parameter("ratio", 0.1, 2.0, (0.7, 0.95))), terms)
