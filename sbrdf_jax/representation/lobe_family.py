"""The shapes that a lobe of `lobe_harmonics` may have: the paper's three, and those of the half vector.

A shape is about 1 at its peak and depends on one width. The paper's (eqs. 14 to 16) measure the
angle from the peak itself; those of the half vector h measure its angle from a normal that is
tilted so that they peak there too, and so stretch towards grazing directions as gloss does.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sbrdf_jax.angles import GRAZING, MIRROR_AZIMUTH, angle_between
from sbrdf_jax.lobes import lobe_exponents

SHAPES = ("none", "angle_squared", "tan_squared", "tan", "half_gaussian", "half_exponential", "microfacet")
FIRST_HALF_SHAPE = 4
LOWEST_COSINE = float(np.cos(GRAZING))  # of theta_i and theta_o where a shape divides by them
STEEPEST = 1e12  # tan^2 of the half angle: beyond it every shape is 0 or flat
NARROWEST_DROP = 1000.0  # the narrowest lobe falls by this factor within one step of the grid
WIDEST = (1.0, 30.0, 30.0, 30.0, 30.0, 30.0, 1.0)  # of each shape; no grid tells more from a constant and a slope


def width_limits(step: float) -> Float[np.ndarray, "shape 2"]:
    """Return the least and greatest width of each shape on a grid of a step [rad]."""
    whole, half = step, np.tan(step / 2)
    drop = np.log(NARROWEST_DROP)
    microfacet = half**2 / (np.sqrt(NARROWEST_DROP) - 1)
    least = (1.0, whole**2 / drop, np.tan(whole) ** 2 / drop, np.tan(whole) / drop, half**2 / drop, half / drop)
    return np.stack([(*least, microfacet), WIDEST], axis=1)


def lobe_shapes(
    theta_i: Float[Array, "*shape"],
    theta_o: Float[Array, "*shape"],
    phi_o: Float[Array, "*shape"],
    peak_theta_o: Float[Array, "*shape"],
    width: Float[Array, "*shape"],
) -> Float[Array, " kind *shape"]:
    """Evaluate every shape of `SHAPES`, of one width, in directions.

    With alpha the angle from the peak, x = tan^2 of the half vector's angle from the tilted normal,
    and c_i, c_o the cosines of theta_i and theta_o, floored at 85 degrees: 0, exp(-alpha^2 / w),
    exp(-tan^2 alpha / w), exp(-tan alpha / w), exp(-x / w) c_i / c_o, exp(-sqrt(x) / w) c_i / c_o, and
    the distribution of GGX, (1 + x)^2 / (1 + x / w)^2 with w its roughness squared, times its
    height-correlated visibility over that of the mirror direction.

    Args:
        theta_i: Polar angle of incidence [rad].
        theta_o: Polar angle of exitance [rad].
        phi_o: Azimuth of exitance [rad].
        peak_theta_o: Where the lobe points [rad], at the mirror azimuth; may lie beyond pi/2.
        width: Above 0; rad^2 for "angle_squared", else without unit.

    Numerics:
        Finite everywhere, with finite gradients; independent of phi_o where theta_o is 0, and where
        theta_i and the peak are 0. Without unit and never negative.
    """
    return jnp.stack([shape(theta_i, theta_o, phi_o, peak_theta_o, width) for shape in _BY_KIND])


def lobe_shape(
    kind: Int[Array, "*shape"],
    theta_i: Float[Array, "*shape"],
    theta_o: Float[Array, "*shape"],
    phi_o: Float[Array, "*shape"],
    peak_theta_o: Float[Array, "*shape"],
    width: Float[Array, "*shape"],
) -> Float[Array, "*shape"]:
    """Evaluate shapes whose kinds are data: places in `SHAPES`. The other arguments are those of `lobe_shapes`."""
    shapes = lobe_shapes(theta_i, theta_o, phi_o, peak_theta_o, width)
    return jnp.take_along_axis(shapes, kind[None], axis=0)[0]


def lobe_shape_of_kind(
    kind: Int[Array, ""],
    theta_i: Float[Array, "*shape"],
    theta_o: Float[Array, "*shape"],
    phi_o: Float[Array, "*shape"],
    peak_theta_o: Float[Array, "*shape"],
    width: Float[Array, "*shape"],
) -> Float[Array, "*shape"]:
    """Evaluate the shape of one kind for all; the others cost nothing unless `kind` is batched."""
    return jax.lax.switch(kind, _BY_KIND, theta_i, theta_o, phi_o, peak_theta_o, width)


def _paper_shape(place):
    def shape(theta_i, theta_o, phi_o, peak_theta_o, width):
        alpha = angle_between(theta_o, phi_o, peak_theta_o, jnp.full_like(phi_o, MIRROR_AZIMUTH))
        return jnp.exp(-lobe_exponents(alpha)[place] / width)

    return shape


def _half_gaussian(theta_i, theta_o, phi_o, peak_theta_o, width):
    x = _half_tangent_squared(theta_i, theta_o, phi_o, peak_theta_o)
    return jnp.exp(-x / width) * _cosine(theta_i) / _cosine(theta_o)


def _half_exponential(theta_i, theta_o, phi_o, peak_theta_o, width):
    x = _half_tangent_squared(theta_i, theta_o, phi_o, peak_theta_o)
    root = jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)
    return jnp.exp(-root / width) * _cosine(theta_i) / _cosine(theta_o)


def _microfacet(theta_i, theta_o, phi_o, peak_theta_o, width):
    x = _half_tangent_squared(theta_i, theta_o, phi_o, peak_theta_o)
    cos_i, cos_o = _cosine(theta_i), _cosine(theta_o)
    distribution = ((1 + x) / (1 + x / width)) ** 2
    return distribution * _visibility(cos_i, cos_o, width) / _visibility(cos_i, cos_i, width)


_BY_KIND = (*(_paper_shape(place) for place in range(FIRST_HALF_SHAPE)), _half_gaussian, _half_exponential, _microfacet)


def _cosine(theta):
    return jnp.maximum(jnp.cos(theta), LOWEST_COSINE)


def _half_tangent_squared(theta_i, theta_o, phi_o, peak_theta_o):
    """Return tan^2 of the angle between the half vector and the normal tilted so that the lobe has its peak."""
    tilt, sin_o = (peak_theta_o - theta_i) / 2, jnp.sin(theta_o)
    h_x, h_y = jnp.sin(theta_i) + sin_o * jnp.cos(phi_o), sin_o * jnp.sin(phi_o)
    h_z = jnp.cos(theta_i) + jnp.cos(theta_o)
    across = h_y**2 + (h_x * jnp.cos(tilt) + h_z * jnp.sin(tilt)) ** 2  # |h x normal|^2
    along = h_z * jnp.cos(tilt) - h_x * jnp.sin(tilt)
    along_squared = jnp.where(along > 0, along, 0.0) ** 2
    return across / (along_squared + across / STEEPEST + 1 / STEEPEST)


def _visibility(cos_i, cos_o, width):
    """Return the height-correlated visibility of GGX, G / (4 cos cos), up to a factor; `width` is alpha^2."""
    ahead = cos_o * jnp.sqrt(width + (1 - width) * cos_i**2)
    behind = cos_i * jnp.sqrt(width + (1 - width) * cos_o**2)
    return 1 / (ahead + behind)
