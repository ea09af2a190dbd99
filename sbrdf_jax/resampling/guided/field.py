"""The fitted field and its evaluation: lobe model plus residual, in the generalised logarithm."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sbrdf_jax.records import pytree
from sbrdf_jax.resampling.guided.coordinates import floored_cos, from_log, guided_coordinates
from sbrdf_jax.resampling.guided.error_model import ResidualScale, residual_scale
from sbrdf_jax.resampling.guided.kernel import Kernel, covariance, factorise, prior_variance
from sbrdf_jax.resampling.guided.lobe_model import LobeModel, lobe_log_value

CHUNK = 512  # directions evaluated at a time


@pytree()
class GuidedField:
    """All that evaluates the resampled field and its standard error at any direction.

    Centres are the samples, repeated directions merged, padded to a bucket size with centres
    of no effect. Two sets of dual coefficients differ in how smooth they are over theta_i: the
    first holds near measured incident angles, the second between them.
    """

    wavelength_nm: Any  # [wavelength]
    floor: Any  # 1/sr
    lobe: LobeModel
    theta_i: Any  # [centre] rad
    theta_o: Any  # [centre] rad
    azimuth: Any  # [centre] rad, folded
    noise: Any  # [centre] variance relative to the kernel's
    noise_level: Any  # the same of one new sample
    dual: Any  # [2, centre, wavelength]
    kernel: Kernel
    between_kernel: Kernel
    between_scale: Any  # the second set's deviations, relative to the first's scale
    measured_theta_i: Any  # [incidence] rad, increasing; one: no second set
    theta_limit: Any  # [2] rad
    scale: ResidualScale


def _between(field: GuidedField, theta_i: Float[Array, " direction"]) -> Float[Array, " direction"]:
    """Share of the second set: 0 at measured incident angles, 1 midway and outside."""
    known = field.measured_theta_i
    if known.shape[0] < 2:
        return jnp.zeros_like(theta_i)
    upper = jnp.clip(jnp.searchsorted(known, theta_i), 1, known.shape[0] - 1)
    gap = known[upper] - known[upper - 1]
    distance = jnp.min(jnp.abs(theta_i[:, None] - known[None, :]), axis=1)
    part = jnp.minimum(2 * distance / gap, 1.0)
    return part**2 * (3 - 2 * part)


def _centres(field: GuidedField):
    return guided_coordinates(field.theta_i, field.theta_o, field.azimuth, field.theta_limit)


def _in_chunks(function, *arrays):
    """Map a function of direction arrays [direction] over chunks, so that memory stays bounded."""
    count = arrays[0].shape[0]
    size = min(CHUNK, max(count, 1))
    padded = [jnp.pad(x, (0, -count % size)).reshape(-1, size) for x in arrays]
    out = jax.lax.map(lambda chunk: function(*chunk), tuple(padded))
    return out.reshape(-1, *out.shape[2:])[:count]


def _log_value(field: GuidedField, centres, theta_i, theta_o, phi_o):
    at = guided_coordinates(theta_i, theta_o, phi_o, field.theta_limit)
    near = covariance(field.kernel, at, centres) @ field.dual[0]
    if field.measured_theta_i.shape[0] > 1:
        share = _between(field, at.theta_i)[:, None]
        near = (1 - share) * near + share * (covariance(field.between_kernel, at, centres) @ field.dual[1])
    return at, lobe_log_value(field.lobe, at, field.floor) + near


@jax.jit
def evaluate_guided(
    field: GuidedField,
    theta_i: Float[Array, "*shape"],
    theta_o: Float[Array, "*shape"],
    phi_o: Float[Array, "*shape"],
) -> Float[Array, "*shape wavelength"]:
    """Evaluate the resampled field at any directions, at the measured wavelengths.

    Never negative, finite everywhere, and independent of phi_o where theta_i or theta_o is 0.

    Args:
        field: From `fit_guided`.
        theta_i: Incident polar angle [rad].
        theta_o: Outgoing polar angle [rad].
        phi_o: Outgoing azimuth [rad]; the mirror direction is at pi.

    Returns:
        BRDF [1/sr].
    """
    centres = _centres(field)

    def values(theta_i, theta_o, phi_o):
        at, z = _log_value(field, centres, theta_i, theta_o, phi_o)
        return from_log(z, at.theta_i, field.floor)

    flat = _in_chunks(values, theta_i.reshape(-1), theta_o.reshape(-1), phi_o.reshape(-1))
    return flat.reshape(*theta_i.shape, -1)


@jax.jit
def evaluate_standard_error(
    field: GuidedField,
    theta_i: Float[Array, "*shape"],
    theta_o: Float[Array, "*shape"],
    phi_o: Float[Array, "*shape"],
) -> tuple[Float[Array, "*shape wavelength"], Float[Array, "*shape wavelength"]]:
    """Standard error of the field, and the noise of one measurement there.

    The shape comes from the same matrix as the field, the local scale from leave-one-out
    residuals: 68 % of new samples lie within the root of the sum of both squares.

    Returns:
        Standard error and noise [1/sr].
    """
    centres = _centres(field)
    factor = factorise(field.kernel, centres, field.noise)
    level = field.noise_level
    two = field.measured_theta_i.shape[0] > 1
    between_factor = factorise(field.between_kernel, centres, field.noise) if two else factor

    def variance(kernel, factor, at):
        half = jax.scipy.linalg.solve_triangular(factor, covariance(kernel, at, centres).T, lower=True)
        return jnp.maximum(prior_variance(kernel) - jnp.sum(half**2, axis=0), 0.0)

    def both(theta_i, theta_o, phi_o):
        at, z = _log_value(field, centres, theta_i, theta_o, phi_o)
        spread = variance(field.kernel, factor, at)
        if two:
            share = _between(field, at.theta_i)
            other = field.between_scale**2 * (variance(field.between_kernel, between_factor, at) + level) - level
            spread = (1 - share) * spread + share * jnp.maximum(other, spread)
        slope = (field.floor * jnp.exp(jnp.clip(z, 0.0, 80.0))) / jnp.sqrt(floored_cos(at.theta_i))[:, None]
        local = residual_scale(field.scale, at.theta_i, at.half, z) * slope
        return jnp.stack([local * jnp.sqrt(spread)[:, None], local * jnp.sqrt(level)])

    def stacked(theta_i, theta_o, phi_o):
        return jnp.moveaxis(both(theta_i, theta_o, phi_o), 0, 1)

    flat = _in_chunks(stacked, theta_i.reshape(-1), theta_o.reshape(-1), phi_o.reshape(-1))
    out = flat.reshape(*theta_i.shape, 2, -1)
    return out[..., 0, :], out[..., 1, :]
