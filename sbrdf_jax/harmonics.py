"""Real spherical harmonics up to a degree L, with the order (l, m) written out."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def harmonic_orders(max_degree: int) -> list[tuple[int, int]]:
    """Return (sh_degree l, sh_order m) of each harmonic: l from 0 to L, m from -l to l."""
    return [(l, m) for l in range(max_degree + 1) for m in range(-l, l + 1)]  # noqa: E741


@functools.partial(jax.jit, static_argnames="max_degree")
def real_harmonics(
    theta: Float[Array | np.ndarray, "*shape"], phi: Float[Array | np.ndarray, "*shape"], max_degree: int
) -> Float[Array, "*shape harmonic"]:
    """Evaluate the real spherical harmonics Y_{l,m} of eq. (13) at directions.

    Orthonormal on the sphere. In terms of the complex Y_l^m (SciPy's `sph_harm_y`, with the
    Condon-Shortley phase): Y_l^0 for m = 0, sqrt(2) (-1)^m Re Y_l^m for m > 0 and
    sqrt(2) (-1)^m Im Y_l^|m| for m < 0, so that Y_{1,1}, Y_{1,-1}, Y_{1,0} are x, y, z times
    sqrt(3 / (4 pi)). Those with m >= 0 are even in phi, the others odd.

    Args:
        theta: Polar angle [rad].
        phi: Azimuth [rad], of the same shape.
        max_degree: L; static.

    Returns:
        Values in the order of `harmonic_orders`, (L + 1)^2 of them.

    Numerics:
        Recurrences in cos(theta) and (x + iy)^m, polynomials of the unit vector: values and
        gradients are finite at the poles, where phi has no meaning.
    """
    z, sin_theta = jnp.cos(theta), jnp.sin(theta)
    x, y = sin_theta * jnp.cos(phi), sin_theta * jnp.sin(phi)

    def azimuth(power, _):  # (x + iy)^m as (real, imaginary)
        real, imaginary = power
        return (x * real - y * imaginary, x * imaginary + y * real), power

    def degree(legendre, step):  # P_l^m / sin^m from those of l - 1 and l - 2, for all m at once
        before, last = legendre
        up, down, start = (jnp.asarray(c, z.dtype).reshape(-1, *(1,) * z.ndim) for c in step)
        value = up * z[None] * last - down * before + start
        return (last, value), value

    one, zero = jnp.ones_like(z), jnp.zeros_like(z)
    _, (cosine, sine) = jax.lax.scan(azimuth, (one, zero), None, length=max_degree + 1)
    none = jnp.zeros((max_degree + 1, *z.shape), z.dtype)
    _, legendre = jax.lax.scan(degree, (none, none), _recurrence(max_degree, z.dtype))
    waves = jnp.concatenate([sine[:0:-1], cosine])  # m from -L to L
    l, m = np.array(harmonic_orders(max_degree)).T  # noqa: E741
    return jnp.moveaxis(legendre[l, abs(m)] * waves[m + max_degree], 0, -1)


def _recurrence(max_degree, dtype):
    """Return [l, m] factors of z P_(l-1) and -P_(l-2), and the value of P_m^m / sin^m at l = m, all normalised."""
    up, down, start = np.zeros((3, max_degree + 1, max_degree + 1))
    sectoral = np.sqrt(1 / (4 * np.pi))
    for m in range(max_degree + 1):
        start[m, m] = sectoral
        sectoral *= np.sqrt((2 * m + 3) / (2 * m + 2)) * (np.sqrt(2) if m == 0 else 1)
        for l in range(m + 1, max_degree + 1):  # noqa: E741
            up[l, m] = np.sqrt((4 * l * l - 1) / (l * l - m * m))
            down[l, m] = up[l, m] * np.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
    return tuple(jnp.asarray(factor, dtype) for factor in (up, down, start))
