"""The sinc kernel and the cosine window: eqs. (4), (5) and (17), one axis at a time.

Eq. (5) is separable, so a direction is three short weight vectors, never one long row.
phi_o is periodic: its nodes are the distinct ones (0 and 2 pi are one), and a distance
is that to the nearest image.
"""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

Window = Literal["none", "product", "factor"]
WindowTerm = tuple[Float[Array, "*shape m"], Float[Array, "*shape n"], Float[Array, "*shape l"]]


def polar_distance(theta: Float[Array, "*shape"], nodes: Float[Array, " node"]) -> Float[Array, "*shape node"]:
    """Signed distances theta - node [rad] for a polar angle."""
    return theta[..., None] - jnp.expand_dims(nodes, range(theta.ndim))


def azimuth_distance(phi: Float[Array, "*shape"], num_nodes: int) -> Float[Array, "*shape {num_nodes}"]:
    """Signed distances [rad] to the nearest image of `num_nodes` uniform nodes on the circle, in [-pi, pi)."""
    nodes = jnp.arange(num_nodes, dtype=phi.dtype) * (2 * jnp.pi / num_nodes)
    return (polar_distance(phi, nodes) + jnp.pi) % (2 * jnp.pi) - jnp.pi


def sinc_weight(distance: Float[Array, "*shape"], step: float | Float[Array, ""]) -> Float[Array, "*shape"]:
    """The kernel of eq. (5), sin(pi x) / (pi x) with x = distance / step; 1 at 0, 0 at every other node."""
    return jnp.sinc(distance / step)


def separable_weights(
    distances: WindowTerm,
    steps: tuple[float | Float[Array, ""], float | Float[Array, ""], float | Float[Array, ""]],
    window: Window = "none",
) -> tuple[WindowTerm, ...]:
    """Return eq. (5)'s weights, under eq. (17)'s window, as a sum of separable terms.

    "none" is eq. (5) alone. "factor" sets each cosine of eq. (17) to 0 beyond 45 degrees.
    "product" clips the product of the three cosines where it is negative, in the words of
    the paper; its positive part is the sum of the four sign patterns with an even number
    of negative factors, which keeps it separable.

    Args:
        distances: Signed distances to the nodes [rad] in theta_i, theta_o and phi_o.
        steps: Node spacings [rad] in the same order.
        window: Which reading of eq. (17).

    Returns:
        One or four triples of weights in theta_i, theta_o and phi_o; the weight of node
        (m, n, l) is the sum over triples of the product of their three entries.

    Raises:
        ValueError: `window` is unknown.
    """
    kernel = tuple(sinc_weight(distance, step) for distance, step in zip(distances, steps, strict=True))
    if window == "none":
        return (kernel,)
    cosine = tuple(jnp.cos(2 * distance) for distance in distances)
    if window == "factor":
        near = tuple(jnp.where(jnp.abs(d) <= jnp.pi / 4, c, 0.0) for d, c in zip(distances, cosine, strict=True))
        return (tuple(k * w for k, w in zip(kernel, near, strict=True)),)
    if window == "product":
        plus = tuple(k * jnp.maximum(c, 0.0) for k, c in zip(kernel, cosine, strict=True))
        minus = tuple(k * jnp.maximum(-c, 0.0) for k, c in zip(kernel, cosine, strict=True))
        patterns = ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 0))
        return tuple(tuple((plus, minus)[s][axis] for axis, s in enumerate(signs)) for signs in patterns)
    raise ValueError(f"window {window!r} is unknown; it is none, product or factor")
