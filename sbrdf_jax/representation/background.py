"""The smooth background of eq. (13): harmonics by least squares on directions outside a cone.

On a hemisphere the harmonics are nearly dependent (condition number 562 at L = 4, 1.3e6 at
L = 8), so no fit is made in them: they are made orthonormal over the directions once, by a
singular value decomposition in float64, and every masked problem is solved in that basis.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sbrdf_jax.harmonics import harmonic_orders, real_harmonics
from sbrdf_jax.representation.directions import DirectionSet

REFINEMENTS = 1
TRUNCATION = 4096  # machine epsilons; eigenvalues below it, of the largest, count as 0


class OrthonormalHarmonics(NamedTuple):
    """Combinations of harmonics that are orthonormal over weighted directions."""

    value: Float[np.ndarray, "direction function"]  # its weighted Gram matrix is the identity
    to_harmonics: Float[np.ndarray, "harmonic function"]  # A of eq. (13) = to_harmonics @ coefficients


def orthonormal_harmonics(directions: DirectionSet, max_degree: int, *, even: bool = True) -> OrthonormalHarmonics:
    """Return the orthonormal combinations of the harmonics up to L, on the host in float64.

    Args:
        directions: Where, and how often each counts.
        max_degree: L.
        even: Of the harmonics that are even in phi_o (m >= 0), else of the odd ones.

    Returns:
        Combinations; those that the directions cannot tell from 0 are 0, and so is what they
        give to the coefficients of the harmonics.
    """
    orders = harmonic_orders(max_degree)
    used = np.array([(m >= 0) == even for _, m in orders])
    harmonic = np.asarray(real_harmonics(directions.theta_o, directions.phi_o, max_degree), np.float64)
    root_weight = np.sqrt(directions.weight)[:, None]
    left, singular, right = np.linalg.svd(root_weight * harmonic[:, used], full_matrices=False)
    keep = singular > singular.max(initial=0.0) * max(left.shape) * np.finfo(np.float64).eps
    to_harmonics = np.zeros((len(orders), len(singular)))
    to_harmonics[used] = np.where(keep, right.T / np.where(keep, singular, 1), 0)
    return OrthonormalHarmonics(np.where(keep, left / root_weight, 0), to_harmonics)


def fit_background(
    value: Float[Array, " direction"],
    outside: Bool[Array, " direction"],
    functions: Float[Array, "direction function"],
    weight: Float[Array, " direction"],
) -> Float[Array, " function"]:
    """Fit one lane's background to the directions outside its critical angle; section 4.2.

    Args:
        value: The coefficient [1/sr] at each direction.
        outside: Directions that take part.
        functions: `OrthonormalHarmonics.value`.
        weight: How often each direction counts.

    Returns:
        Coefficients of the orthonormal functions; the smallest ones where the directions
        outside leave them open.

    Numerics:
        The Gram matrix has eigenvalues from 0 to 1, how much of a function lies outside. Those
        below `TRUNCATION` epsilons are dropped; a step of refinement on the true residual takes
        back what squaring the condition number lost.
    """
    weighted = functions * jnp.where(outside, weight, 0.0)[:, None]
    eigenvalue, vector = jnp.linalg.eigh(weighted.T @ functions)
    keep = eigenvalue > TRUNCATION * jnp.finfo(value.dtype).eps * eigenvalue[-1]
    inverse = jnp.where(keep, 1 / jnp.where(keep, eigenvalue, 1.0), 0.0)
    coefficient = jnp.zeros_like(eigenvalue)
    for _ in range(1 + REFINEMENTS):
        residual = weighted.T @ (value - functions @ coefficient)
        coefficient = coefficient + vector @ (inverse * (vector.T @ residual))
    return coefficient
