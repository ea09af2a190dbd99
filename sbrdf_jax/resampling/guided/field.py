"""The fitted field and its evaluation: lobe model plus the residual of three grids, in the generalised logarithm."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg.blas
from jaxtyping import Array, Float

from sbrdf_jax.array_module import AnyArray, array_module
from sbrdf_jax.devices import on_host
from sbrdf_jax.host_blas import one_blas_thread
from sbrdf_jax.records import pytree
from sbrdf_jax.resampling.guided.coordinates import (
    Coordinates,
    coordinates_on_axes,
    from_log,
    guided_coordinates,
    log_scale,
    slope,
)
from sbrdf_jax.resampling.guided.covariance import (
    covariance,
    flatten,
    group_coordinates,
    group_features,
    in_chunks,
    prior_variance,
)
from sbrdf_jax.resampling.guided.error_model import ResidualScale, between_scale, residual_scale
from sbrdf_jax.resampling.guided.inverse import Whitener, whitener
from sbrdf_jax.resampling.guided.lobe_model import LobeModel, lobe_log_value, mirror_share
from sbrdf_jax.resampling.guided.nodes import (
    GRIDS,
    POLAR_GRIDS,
    THETA,
    ModeVariance,
    cubic_matrix,
    cubic_rows,
    cubic_weights,
    interpolate,
)

Values = Float[AnyArray, "direction wavelength"]
DIRECTIONS_AT_A_TIME = 1024
MOST_KEPT = 512  # directions of an incident angle whose places among the nodes are kept for the next material
WHITEN_BLOCK = 256  # rows of a triangular matrix that are multiplied as one full block
MOST_GATHERED = 8  # wavelengths; measured: 1.8 us a direction against 6.1 for 1, 5.0 and 7.4 for 6, 46 and 16 for 31

NEVER_EVALUATED = ("multiplier", "model_residual", "reciprocity_cost", "curve", "measured")
LAST_AXIS = ("wavelength_nm", *GRIDS, "multiplier", "model_residual")  # is the wavelength's, in a field


@pytree()
class WholeSpectrum:
    """What is known of all measured wavelengths: with it a later run can solve those that this one skipped."""

    wavelength_nm: Any  # [measured]
    log_amplitude: Any  # [4, measured]
    model_residual: Any  # [measured]
    # projection of the spectra; no component where they are left as they are, as in results of earlier versions
    to_component: Any = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))  # [measured, component]
    from_component: Any = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))  # [component, measured]


@pytree()
class GuidedField:
    """All that evaluates the resampled field and its standard error at any direction.

    The centres are the measured directions, grouped by incident angle; the standard error
    follows from where they are and how far each is trusted.
    """

    wavelength_nm: Any  # [wavelength]
    floor: Any  # 1/sr
    lobe: LobeModel
    half: Any  # [half, theta_i, theta_o, wavelength] residual of z at the nodes of the half-angle grid, mirrored
    azimuth: Any  # [azimuth, theta_i, theta_o, wavelength] the same of the azimuth grid
    difference: Any  # [lean, half, difference, wavelength] the same of the difference grid
    theta_limit: Any  # [2] rad
    centre: Any  # [3, group, member] theta_i, theta_o, folded azimuth [rad]
    noise: Any  # [group, member] variance of z relative to the prior's
    noise_factor: Any  # [group, member] above 1 where neighbours contradict a direction
    noise_level: Any  # variance of one new measurement
    variance: ModeVariance
    scale: ResidualScale
    multiplier: Any  # [group, member, wavelength] unknowns of the bounded problem
    model_residual: Any  # [wavelength] relative gradient norm of the lobe model's fit
    reciprocity_cost: Any  # left-out errors with nodes tied by reciprocity over those without; 1 where not tied
    curve: Any  # [2, trial] noise and left-out error of z
    measured: Any  # WholeSpectrum


def evaluated_part(field: GuidedField) -> GuidedField:
    """Return what evaluation and standard errors read: the rest differs in shape from material to material."""
    return dataclasses.replace(field, **dict.fromkeys(NEVER_EVALUATED))


@jax.jit
def evaluate_direction(
    field: GuidedField, theta_i: Float[Array, ""], theta_o: Float[Array, ""], phi_o: Float[Array, ""]
) -> Float[Array, " wavelength"]:
    """Evaluate the resampled field in one direction, at the measured wavelengths [1/sr].

    Never negative, finite everywhere, and independent of phi_o where theta_i or theta_o is 0.
    """
    at = guided_coordinates(theta_i, theta_o, phi_o, field.theta_limit)
    return from_log(_log_value(field, at), log_scale(at, field.floor))


def _log_value(field: GuidedField, at: Coordinates):
    z = lobe_log_value(field.lobe, at, field.floor)
    for name, grid in GRIDS.items():
        z = z + interpolate(getattr(field, name), grid.places(at), grid.axes)
    return z


def evaluate_directions(
    field: GuidedField,
    theta_i: Float[np.ndarray, " direction"],
    theta_o: Float[np.ndarray, " direction"],
    phi_o: Float[np.ndarray, " direction"],
) -> Float[np.ndarray, "direction wavelength"]:
    """`evaluate_direction` of many directions on the host: the nodes around each are a row of a sparse matrix."""
    at = guided_coordinates(theta_i, theta_o, phi_o, field.theta_limit)
    return from_log(_log_values(field, at), log_scale(at, field.floor))


def _log_values(field: GuidedField, at: Coordinates):
    """`_log_value` of many directions."""
    if array_module(field.half, at.half) is not np:
        return each_direction(lambda place: _log_value(field, place), at, len(field.wavelength_nm))
    z = lobe_log_value(field.lobe, at, field.floor)
    for name, grid in GRIDS.items():
        nodes = getattr(field, name)
        z = z + cubic_rows(grid.places(at), grid.axes) @ nodes.reshape(-1, nodes.shape[3])
    return z


def each_direction(function: Callable[[Any], Array], directions: Any, num_wavelengths: int) -> Array:
    """Map a function of one direction: one by one on a processor, where gathering many values at once is slower."""
    if jax.default_backend() == "cpu" and num_wavelengths > MOST_GATHERED:
        return jax.lax.map(function, directions)
    return jax.vmap(function)(directions)


def field_whitener(field: GuidedField) -> Whitener:
    """Factors of the inverse of prior covariance plus noise, which standard errors need."""
    variance, centre, limit = jax.tree.map(np.asarray, (field.variance, field.centre, field.theta_limit))
    centres = group_coordinates(centre, limit)
    prior = covariance(variance, flatten(centres), group_features(centres))
    whiten = whitener(prior, np.asarray(field.noise).reshape(-1))
    return Whitener(whiten, np.zeros((0, len(whiten))))


def unexplained(
    cross: Float[AnyArray, "direction centre"],
    prior: Float[AnyArray, " direction"],
    whiten: Whitener,
) -> Float[AnyArray, " direction"]:
    """Variance that the centres leave in directions, relative to the prior's: the same at every wavelength.

    Args:
        cross: Prior covariance of directions and centres.
        prior: Prior variance of the directions.
        whiten: Of prior plus noise.
    """
    return with_doubt(prior - explained(cross, whiten.lower), cross, whiten.doubt)


def explained(
    cross: Float[AnyArray, "direction centre"], lower: Float[AnyArray, "centre centre"]
) -> Float[AnyArray, " direction"]:
    """Squared length of W c: BLAS multiplies by a triangle as such; else what is zero is left out block by block."""
    if array_module(cross, lower) is np:
        with one_blas_thread():
            product = scipy.linalg.blas.dtrmm(1.0, lower, cross.T, lower=1)
        return np.einsum("cd,cd->d", product, product)
    count, total = len(lower), jnp.zeros(len(cross))
    for start in range(0, count, WHITEN_BLOCK):
        end = min(start + WHITEN_BLOCK, count)
        total = total + jnp.sum((cross[:, :end] @ lower[start:end, :end].T) ** 2, axis=1)
    return total


def with_doubt(
    left: Float[AnyArray, " direction"],
    cross: Float[AnyArray, "direction centre"],
    doubt: Float[AnyArray, "doubted centre"],
) -> Float[AnyArray, " direction"]:
    """Variance that is left where some centres have more noise than was reckoned with."""
    xp = array_module(left, cross, doubt)
    return xp.maximum(left + xp.sum((cross @ doubt.T) ** 2, axis=1), 0.0)


def _errors(field: GuidedField, at: Coordinates, z, variance):
    """Return values, standard errors and the noise of one measurement [1/sr] from z and its variance."""
    scale = log_scale(at, field.floor)
    xp = array_module(z, variance)
    local, unit = residual_scale(field.scale, at.theta_i, at.half, z), slope(z, scale)
    deviation = xp.sqrt(variance) * between_scale(field.scale, at.theta_i)
    mirror = field.scale.mirror * mirror_share(field.lobe, at, field.floor)
    error = xp.sqrt((local * deviation[..., None]) ** 2 + mirror**2)
    return from_log(z, scale), unit * error, unit * local * xp.sqrt(field.noise_level)


@on_host
def evaluate_with_error(
    field: GuidedField,
    whiten: Whitener,
    theta_i: Float[AnyArray, " direction"],
    theta_o: Float[AnyArray, " direction"],
    phi_o: Float[AnyArray, " direction"],
) -> tuple[Values, Values, Values]:
    """Evaluate the field, its standard error, and the noise of one measurement [1/sr], at the measured wavelengths.

    The shape of the error comes from the same matrix as the field, its local scale from
    residuals of samples left out: 68 % of new samples lie within the root of the sum of
    both squares.

    Args:
        field: The fitted field.
        whiten: Of prior plus noise, from `field_whitener`.
        theta_i: Polar angle of incidence [rad].
        theta_o: Polar angle of exitance [rad].
        phi_o: Azimuth of exitance [rad]; the mirror direction is at pi.
    """
    features = group_features(group_coordinates(field.centre, field.theta_limit))

    def of_chunk(angles):
        at = guided_coordinates(*angles, field.theta_limit)
        cross = covariance(field.variance, at, features)
        variance = unexplained(cross, prior_variance(field.variance, at), whiten)
        z = _log_values(field, at)
        return array_module(z).stack(_errors(field, at, z, variance), axis=1)

    found = in_chunks(of_chunk, (theta_i, theta_o, phi_o), DIRECTIONS_AT_A_TIME)
    return found[:, 0], found[:, 1], found[:, 2]


def evaluate_on_axes(
    field: GuidedField, theta_i: Float[AnyArray, ""], theta_o: Float[AnyArray, " o"], phi_o: Float[AnyArray, " p"]
) -> Float[AnyArray, "o p wavelength"]:
    """`evaluate_direction` at all combinations of two axes, at one incident angle."""
    at, z = _log_value_on_axes(field, theta_i, theta_o, phi_o)
    return from_log(z, log_scale(at, field.floor))


def evaluate_on_axes_with_error(
    field: GuidedField,
    theta_i: Float[AnyArray, ""],
    theta_o: Float[AnyArray, " o"],
    phi_o: Float[AnyArray, " p"],
    variance: Float[AnyArray, "o p"],
) -> tuple[Float[AnyArray, "o p wavelength"], Float[AnyArray, "o p wavelength"]]:
    """Values and standard errors [1/sr] at all combinations of two axes, from `unexplained` variances there."""
    at, z = _log_value_on_axes(field, theta_i, theta_o, phi_o)
    return _errors(field, at, z, variance)[:2]


class _OnAxes(NamedTuple):
    """What depends on the angles of combinations of two axes alone, at one incident angle."""

    at: Coordinates  # [o, p]
    theta_i: tuple[Any, Any]  # `cubic_weights` [1]
    theta_o: Any  # `cubic_matrix` [o, node]
    polar: dict[str, Any]  # `cubic_matrix` [o, p, node] of the first axis of a polar grid
    difference: Any  # places in the difference grid; on the host their `cubic_rows`


def _log_value_on_axes(field: GuidedField, theta_i, theta_o, phi_o) -> tuple[Coordinates, AnyArray]:
    """Coordinates and z; nodes are summed over both polar angles once for all azimuths."""
    angles = theta_i, theta_o, phi_o, field.theta_limit
    xp = array_module(*angles, field.half)
    if xp is np and len(theta_o) * len(phi_o) <= MOST_KEPT:
        on = _kept_on_axes(*(np.asarray(angle, np.float64).tobytes() for angle in angles))
    else:
        on = _on_axes(*angles)
    z = lobe_log_value(field.lobe, on.at, field.floor) + _difference_on_axes(field.difference, on)
    first, weight = on.theta_i
    for name in POLAR_GRIDS:
        nodes = getattr(field, name)
        around = nodes[:, first[0] : first[0] + 4] if xp is np else jax.lax.dynamic_slice_in_dim(nodes, first[0], 4, 1)
        nodes = on.theta_o[None] @ sum(weight[0, k] * around[:, k] for k in range(4))  # [first node, o, wavelength]
        z = z + on.polar[name] @ xp.swapaxes(nodes, 0, 1)
    return on.at, z


@functools.lru_cache(maxsize=128)
def _kept_on_axes(*angles: bytes) -> _OnAxes:
    """`_on_axes`, kept for the next material: at most some 100 MB."""
    theta_i, theta_o, phi_o, theta_limit = (np.frombuffer(angle) for angle in angles)
    return _on_axes(theta_i[0], theta_o, phi_o, theta_limit)


def _on_axes(theta_i, theta_o, phi_o, theta_limit) -> _OnAxes:
    """Work out where all combinations of two axes lie among the nodes."""
    at = coordinates_on_axes(theta_i, theta_o, phi_o, theta_limit)
    xp, grid = array_module(at.half), GRIDS["difference"]
    places = tuple(xp.broadcast_to(x, at.half.shape).reshape(-1) for x in grid.places(at))
    return _OnAxes(
        at,
        cubic_weights(at.theta_i[0], THETA),
        cubic_matrix(at.theta_o[:, 0], THETA),
        {name: cubic_matrix(getattr(at, name), axis) for name, (_, (axis, _, _)) in POLAR_GRIDS.items()},
        cubic_rows(places, grid.axes) if xp is np else places,
    )


def _difference_on_axes(nodes, on: _OnAxes) -> AnyArray:
    """What the difference grid adds [o, p, wavelength]: direction by direction, it has no axis along theta_o."""
    if array_module(nodes, on.at.half) is np:
        found = on.difference @ nodes.reshape(-1, nodes.shape[-1])
    else:
        found = jax.vmap(lambda place: interpolate(nodes, place, GRIDS["difference"].axes))(on.difference)
    return found.reshape(*on.at.half.shape, -1)
