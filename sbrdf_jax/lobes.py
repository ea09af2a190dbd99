"""The three lobe shapes of eqs. (14), (15) and (16)."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

LOBE_KINDS = ("none", "angle_squared", "tan_squared", "tan")  # stored as 0, 1, 2, 3
VANISHED = 1e12  # an exponent at which every lobe is 0, yet far from overflow


def lobe_exponents(alpha: Float[Array | np.ndarray, "*shape"]) -> Float[Array, " kind *shape"]:
    """Return s(alpha) of each kind in `LOBE_KINDS`, where the lobe is height * exp(-s(alpha) / width).

    Args:
        alpha: Angle from the lobe's peak [rad], 0 to pi.

    Returns:
        `VANISHED` for "none", the squared angle [rad^2], the squared tangent, the tangent.

    Numerics:
        The tangent shapes are `VANISHED` from pi/2 on, where the paper's formula would grow
        again (16) or revive (15), and bounded before it, so Jacobians hold no infinity.
    """
    alpha = jnp.asarray(alpha)
    is_front = alpha < jnp.pi / 2
    tan = jnp.tan(jnp.where(is_front, alpha, 0.0))
    gone = jnp.full_like(alpha, VANISHED)
    tan_squared = jnp.where(is_front, jnp.minimum(tan, VANISHED**0.5) ** 2, gone)
    return jnp.stack([gone, alpha**2, tan_squared, jnp.where(is_front, jnp.minimum(tan, VANISHED), gone)])


def lobe_value(
    alpha: Float[Array | np.ndarray, "*shape"],
    height: Float[Array | np.ndarray, "*#shape"] | float,
    width: Float[Array | np.ndarray, "*#shape"] | float,
    *,
    kind: str,
) -> Float[Array, "*shape"]:
    """Evaluate one lobe at angles measured from its peak.

    Xu, eqs. (14), (15), (16): ``height * exp(-s(alpha) / width)``, where ``s`` is the squared
    angle, the squared tangent or the tangent; "none" is 0 everywhere.

    Args:
        alpha: Angle between each direction and the lobe's peak [rad], 0 to pi.
        height: Peak value p_k, in the unit of the fitted coefficient [1/sr]; may be negative.
        width: b_k > 0; [rad^2] for "angle_squared", dimensionless otherwise.
        kind: One of `LOBE_KINDS`; static, so each kind compiles once.

    Returns:
        Lobe value per direction [1/sr].

    Raises:
        ValueError: `kind` is unknown (raised while tracing).

    Numerics:
        The tangent shapes are 0 from pi/2 on. The paper does not say; without this, the tangent
        shape grows without bound past pi/2. A width <= 0 is not checked here: the fit keeps it positive.
    """
    if kind not in LOBE_KINDS:
        raise ValueError(f"lobe kind {kind!r}: expected one of {', '.join(LOBE_KINDS)}")
    exponent = lobe_exponents(alpha)[LOBE_KINDS.index(kind)]
    return jnp.asarray(height * jnp.exp(-exponent / width))


def lobe_value_any(
    alpha: Float[Array | np.ndarray, "*shape"],
    height: Float[Array | np.ndarray, "*#shape lobe"],
    width: Float[Array | np.ndarray, "*#shape lobe"],
    kind_index: Int[Array | np.ndarray, "*#shape lobe"],
) -> Float[Array, "*shape lobe"]:
    """Evaluate lobes that share a peak and whose kinds are data: places in `LOBE_KINDS`.

    As `lobe_value`, for each lobe of the last axis (one a coefficient).
    """
    exponents = jnp.moveaxis(lobe_exponents(alpha), 0, -1)
    shape = (*alpha.shape, kind_index.shape[-1])
    height, width, kind_index = (jnp.broadcast_to(a, shape) for a in (height, width, kind_index))
    exponent = jnp.take_along_axis(exponents, kind_index, axis=-1)
    return height * jnp.exp(-exponent / width)
