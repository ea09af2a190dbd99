"""The value of harmonics and lobes in any direction; pure, for jit, vmap and grad."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sbrdf_jax.angles import unit_vector
from sbrdf_jax.encoding import decode
from sbrdf_jax.harmonics import harmonic_orders, real_harmonics
from sbrdf_jax.records import LobeHarmonics
from sbrdf_jax.representation.lobe_family import lobe_shape

COEFFICIENT_STEP = 8
FLOOR = 1e-3
SMALLEST = 1e-300  # keeps the logarithm of nothing finite
VANISHED = 1e-12  # a half vector whose length squared is below it has no direction


def even_orders(max_degree: int) -> list[tuple[int, int]]:
    """Return (sh_degree l, sh_order m) of each harmonic that is even in phi_o: l from 0 to L, m from 0 to l."""
    return [(l, m) for l, m in harmonic_orders(max_degree) if m >= 0]  # noqa: E741


def even_harmonics(
    theta: Float[Array | np.ndarray, "*shape"], phi: Float[Array | np.ndarray, "*shape"], max_degree: int
) -> Float[Array, "*shape harmonic"]:
    """Return the harmonics of `even_orders` [..., harmonic]."""
    places = np.flatnonzero([m >= 0 for _, m in harmonic_orders(max_degree)])
    return real_harmonics(theta, phi, max_degree)[..., places]


def pad_coefficients(compact: LobeHarmonics) -> LobeHarmonics:
    """Return the same with coefficients of 0 up to a multiple of 8, so that most materials share compiled code."""
    count = np.shape(compact.degree)[1]
    more = -count % COEFFICIENT_STEP if compact.basis.stores_vectors else 0  # else the config fixes how many
    if not more:
        return compact
    basis = dataclasses.replace(
        compact.basis,
        analysis=np.pad(compact.basis.analysis, ((0, 0), (0, more))),
        synthesis=np.pad(compact.basis.synthesis, ((0, more), (0, 0))),
    )
    return dataclasses.replace(
        compact,
        basis=basis,
        degree=np.pad(compact.degree, ((0, 0), (0, more)), constant_values=-1),
        background=np.pad(compact.background, ((0, 0), (0, more), (0, 0))),
        lobe_height=np.pad(compact.lobe_height, ((0, 0), (0, 0), (0, more))),
    )


def lobe_harmonics_value(
    compact: LobeHarmonics,
    theta_i: Float[Array, ""],
    theta_o: Float[Array, ""],
    phi_o: Float[Array, ""],
    wavelength_nm: Float[Array, " query"] | None = None,
) -> Float[Array, " wavelength"]:
    """Evaluate harmonics and lobes in one direction [1/sr].

    Between incident angles both neighbours are evaluated, each where its own half vector is that of
    the direction asked for, so that a lobe moves with the mirror direction and stays one lobe; then
    the logarithms of their values are blended. Beyond the first and last incident angle with data it is theirs alone.

    Numerics:
        Never negative, because it is clipped at 0; finite everywhere, and independent of phi_o
        where theta_i (if that is one of the fitted angles) or theta_o is 0.
    """
    nodes = jnp.asarray(compact.fitted_theta_i)
    if not compact.interpolate_theta_i or nodes.shape[0] == 1:
        place = jnp.argmin(jnp.abs(theta_i - nodes))
        coefficient = coefficient_at_node(compact, place, *same_half_vector(theta_i, theta_o, phi_o, nodes[place]))
        return jnp.maximum(decode(coefficient, compact.basis, wavelength_nm), 0.0)
    lower = jnp.clip(jnp.searchsorted(nodes, theta_i, side="right") - 1, 0, nodes.shape[0] - 2)
    share = jnp.clip((theta_i - nodes[lower]) / (nodes[lower + 1] - nodes[lower]), 0.0, 1.0)
    places = jnp.stack([lower, lower + 1])

    def at(place):
        return coefficient_at_node(compact, place, *same_half_vector(theta_i, theta_o, phi_o, nodes[place]))

    below, above = jnp.maximum(decode(jax.vmap(at)(places), compact.basis, wavelength_nm), 0.0)
    return geometric_mean(below, above, share)


def geometric_mean(
    below: Float[Array, " wavelength"], above: Float[Array, " wavelength"], share: Float[Array, ""]
) -> Float[Array, " wavelength"]:
    """Blend two spectra that are nowhere negative: linearly in the logarithm, from a small floor on.

    The floor is `FLOOR` of their mean, so that a value that is clipped at 0 does not pull the other down with it.
    """
    floor = FLOOR * (below.mean() + above.mean()) / 2 + SMALLEST
    logarithm = (1 - share) * jnp.log(below + floor) + share * jnp.log(above + floor)
    return jnp.maximum(jnp.exp(logarithm) - floor, 0.0)


def coefficient_at_node(
    compact: LobeHarmonics, place: Int[Array, ""], theta_o: Float[Array, ""], phi_o: Float[Array, ""]
) -> Float[Array, " coefficient"]:
    """Return the coefficients of the spectrum [1/sr] in one direction, at one of the fitted incident angles."""
    background = jnp.asarray(compact.background)[place] @ even_harmonics(theta_o, phi_o, compact.max_degree)
    kind, width, peak, height = (
        jnp.asarray(part)[place]
        for part in (compact.lobe_kind, compact.lobe_width, compact.lobe_peak_theta_o, compact.lobe_height)
    )
    same = jnp.ones_like(peak)
    theta_i = jnp.asarray(compact.fitted_theta_i)[place]
    return background + lobe_shape(kind, theta_i * same, theta_o * same, phi_o * same, peak, width) @ height


def same_half_vector(
    theta_i: Float[Array, ""], theta_o: Float[Array, ""], phi_o: Float[Array, ""], other_theta_i: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the direction of exitance [rad] that has the same half vector with another angle of incidence.

    Numerics:
        The direction itself where the half vector vanishes; no lower than the horizon.
    """
    incidence, other = (unit_vector(theta, jnp.zeros_like(theta)) for theta in (theta_i, other_theta_i))
    half = incidence + unit_vector(theta_o, phi_o)
    squared = half @ half
    along = 2 * (half @ other) / jnp.where(squared > VANISHED, squared, 1.0)
    x, y, z = along * half - other
    across = x**2 + y**2
    is_pole = across < VANISHED**2
    radius = jnp.where(is_pole, 0.0, jnp.sqrt(jnp.where(is_pole, 1.0, across)))
    theta = jnp.minimum(jnp.arctan2(radius, jnp.where(is_pole, 1.0, z)), jnp.pi / 2)
    phi = jnp.arctan2(jnp.where(is_pole, 0.0, y), jnp.where(is_pole, 1.0, x))
    return jnp.where(squared > VANISHED, theta, theta_o), jnp.where(squared > VANISHED, phi, phi_o)
