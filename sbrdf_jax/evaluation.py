"""Any stage's answer at any direction and wavelength.

Eq. (5) under the window of eq. (17) for the grid, eq. (13) decoded for the compact form.

A kernel describes one direction; `evaluate` batches it. A new stage, or a method with a
field of its own, registers its kernel for its record with `direction_kernel.register`.
"""

import dataclasses
import functools
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Real

from sbrdf_jax.devices import on_host
from sbrdf_jax.encoding import decode
from sbrdf_jax.interpolation import outside_range, spectral_weights
from sbrdf_jax.records import CompactBRDF, GriddedBRDF, LobeHarmonics, LobeTensor, SpectralField
from sbrdf_jax.representation.lobe_harmonics_value import lobe_harmonics_value, pad_coefficients
from sbrdf_jax.representation.paper import compact_coefficient
from sbrdf_jax.representation.tensor_value import pad_ranks, tensor_on_axes, tensor_value
from sbrdf_jax.resampling.guided.field import (
    GuidedField,
    each_direction,
    evaluate_direction,
    evaluate_directions,
    evaluate_with_error,
    evaluated_part,
    field_whitener,
)
from sbrdf_jax.resampling.guided.field import evaluate_on_axes as field_on_axes
from sbrdf_jax.resampling.guided.on_axes import on_axes
from sbrdf_jax.sinc import Window, azimuth_distance, polar_distance, separable_weights

CHUNK_BYTES = 128 * 2**20  # working memory of one chunk of directions
NEVER_EVALUATED = (  # of a grid: what `evaluate` does not read
    "extrapolated", "kkt_residual", "num_steps", "status", "standard_error", "residual_variance", "needed",
)  # fmt: skip
MOST_AT_A_TIME = 2048  # directions; more leave the processor's cache


@jax.jit
def evaluate(
    result: Any,
    theta_i: Float[ArrayLike, "*#shape"] | int,
    theta_o: Float[ArrayLike, "*#shape"] | int,
    phi_o: Float[ArrayLike, "*#shape"] | int,
    wavelength_nm: Real[ArrayLike, "*wavelength"] | None = None,
) -> Float[Array, "*shape wavelength"]:
    """Evaluate a result of any stage; pure and jitted, for use under jit, vmap and grad.

    Xu, eq. (5) times the window of eq. (17) for the grid, eq. (13) decoded by eq. (11) for
    the compact form, which is linear between neighbouring incident angles.

    Args:
        result: GriddedBRDF, SpectralField, CompactBRDF, LobeHarmonics, LobeTensor, or a record with a
            registered kernel.
        theta_i: Polar angle of incidence [rad], 0 to pi/2; the three angles broadcast.
        theta_o: Polar angle of exitance [rad], 0 to pi/2.
        phi_o: Azimuth of exitance [rad], any; the mirror direction is at pi.
        wavelength_nm: Where to evaluate the spectrum; the measured wavelengths unless given.

    Returns:
        BRDF [1/sr].

    Raises:
        TypeError: the record has no kernel (raised while tracing).

    Numerics:
        Between wavelengths the grid is a C1 cubic, the compact form its own basis; outside
        the measured range the value is NaN, never an extrapolation. Directions are not
        checked. At a pole, eq. (5) is not constant in phi_o between its nodes: its weights
        do not sum to 1, and the paper does not renormalise them. Taking the nearest image
        leaves a corner of the field at the nodes of phi_o under the windows "none" and
        "product"; "factor" has none there.
    """
    if direction_kernel.dispatch(type(result)) is direction_kernel.dispatch(object):
        raise TypeError(f"{type(result).__name__} cannot be evaluated: no kernel is registered for it")
    dtype = jnp.asarray(jax.tree.leaves(result)[0]).dtype
    angles = jnp.broadcast_arrays(*(jnp.asarray(a, dtype) for a in (theta_i, theta_o, phi_o)))
    wavelength = None if wavelength_nm is None else jnp.atleast_1d(jnp.asarray(wavelength_nm, dtype))
    kernel = functools.partial(direction_kernel, result, wavelength_nm=wavelength)
    flat = tuple(a.reshape(-1) for a in angles)
    field = getattr(result, "field", result)
    if isinstance(field, GuidedField):
        value = each_direction(lambda angles: kernel(*angles), flat, len(field.wavelength_nm))
    else:
        value = jax.vmap(kernel)(*flat)
    if wavelength is not None:
        outside = outside_range(wavelength, jnp.asarray(measured_wavelengths(result), dtype))
        value = jnp.where(outside[None, :], jnp.nan, value)
    return value.reshape(*angles[0].shape, value.shape[-1])


@functools.singledispatch
def direction_kernel(result, theta_i, theta_o, phi_o, *, wavelength_nm=None) -> Float[Array, " wavelength"]:
    """BRDF [1/sr] of one record in one direction, at its own wavelengths or at `wavelength_nm`."""
    raise NotImplementedError


@direction_kernel.register
def _(result: GriddedBRDF, theta_i, theta_o, phi_o, *, wavelength_nm=None):
    if result.field is None:
        value = interpolate_nodes(result, jnp.asarray(result.brdf), theta_i, theta_o, phi_o)
    else:
        nodes = jnp.asarray(result.theta_i)
        angle = theta_i if result.interpolate_theta_i else nodes[nearest(theta_i, nodes)]
        value = evaluate_direction(result.field, angle, theta_o, phi_o)
    if wavelength_nm is None:
        return value
    return spectral_weights(wavelength_nm, jnp.asarray(result.wavelength_nm)) @ value


@direction_kernel.register
def _(result: GuidedField, theta_i, theta_o, phi_o, *, wavelength_nm=None):
    value = evaluate_direction(result, theta_i, theta_o, phi_o)
    if wavelength_nm is None:
        return value
    return spectral_weights(wavelength_nm, jnp.asarray(result.wavelength_nm)) @ value


@direction_kernel.register
def _(result: SpectralField, theta_i, theta_o, phi_o, *, wavelength_nm=None):
    coefficient = interpolate_nodes(result, jnp.asarray(result.coefficient), theta_i, theta_o, phi_o)
    return decode(coefficient, result.basis, wavelength_nm)


@direction_kernel.register
def _(result: CompactBRDF, theta_i, theta_o, phi_o, *, wavelength_nm=None):
    nodes = jnp.asarray(result.theta_i)
    if result.interpolate_theta_i and nodes.shape[0] > 1:
        lower, upper, share = bracket(theta_i, nodes)
        at_nodes = jax.vmap(functools.partial(compact_coefficient, result), in_axes=(0, None, None))
        below, above = at_nodes(jnp.stack([lower, upper]), theta_o, phi_o)
        coefficient = (1 - share) * below + share * above
    else:
        coefficient = compact_coefficient(result, nearest(theta_i, nodes), theta_o, phi_o)
    return decode(coefficient, result.basis, wavelength_nm)


@direction_kernel.register
def _(result: LobeTensor, theta_i, theta_o, phi_o, *, wavelength_nm=None):
    return tensor_value(result, theta_i, theta_o, phi_o, wavelength_nm)


@direction_kernel.register
def _(result: LobeHarmonics, theta_i, theta_o, phi_o, *, wavelength_nm=None):
    return lobe_harmonics_value(result, theta_i, theta_o, phi_o, wavelength_nm)


def measured_wavelengths(result) -> Float[Array | np.ndarray, " wavelength"]:
    """The measured wavelengths [nm] of a record: its own, or those of its spectral basis."""
    return result.wavelength_nm if hasattr(result, "wavelength_nm") else result.basis.wavelength_nm


def nearest(angle: Float[Array, ""], nodes: Float[Array, " node"]) -> Int[Array, ""]:
    """Index of the node nearest to an angle."""
    return jnp.argmin(jnp.abs(angle - nodes))


def bracket(
    angle: Float[Array, ""], nodes: Float[Array, " node"]
) -> tuple[Int[Array, ""], Int[Array, ""], Float[Array, ""]]:
    """Return the two nodes around an angle and the share of the upper one; angles beyond the nodes are clamped."""
    lower = jnp.clip(jnp.searchsorted(nodes, angle, side="right") - 1, 0, nodes.shape[0] - 2)
    share = (angle - nodes[lower]) / (nodes[lower + 1] - nodes[lower])
    return lower, lower + 1, jnp.clip(share, 0.0, 1.0)


def node_weights(grid: GriddedBRDF | SpectralField, theta_i, theta_o, phi_o):
    """Return eq. (5)'s weights under the grid's window for one direction, as separable triples.

    The last axis of phi_o weighs the distinct nodes: 0 and 2 pi are one. Where nothing is
    interpolated over theta_i, its nearest node has all the weight.
    """
    nodes_i, nodes_o = jnp.asarray(grid.theta_i), jnp.asarray(grid.theta_o)
    num_phi = grid.phi_o.shape[0] - 1
    along_i = polar_distance(theta_i, nodes_i) if grid.interpolate_theta_i else jnp.zeros(1, nodes_i.dtype)
    step_i = nodes_i[1] - nodes_i[0] if grid.interpolate_theta_i else 1.0
    distances = (along_i, polar_distance(theta_o, nodes_o), azimuth_distance(phi_o, num_phi))
    steps = (step_i, nodes_o[1] - nodes_o[0], 2 * np.pi / num_phi)
    terms = separable_weights(distances, steps, cast(Window, grid.window))
    if grid.interpolate_theta_i:
        return terms
    chosen = jax.nn.one_hot(nearest(theta_i, nodes_i), nodes_i.shape[0], dtype=nodes_i.dtype)
    return tuple((chosen * along[0], over_o, over_phi) for along, over_o, over_phi in terms)


def interpolate_nodes(
    grid: GriddedBRDF | SpectralField,
    node_value: Float[Array, "theta_i theta_o phi_o channel"],
    theta_i: Float[Array, ""],
    theta_o: Float[Array, ""],
    phi_o: Float[Array, ""],
) -> Float[Array, " channel"]:
    """Xu, eq. (5) times eq. (17): the field in one direction from values at all nodes.

    One incident angle of the grid at a time: a batch of directions is a matrix product with
    the nodes of each. As one expression it takes six times as long on a processor, because
    XLA then computes every sine anew for each node of the grid.
    """
    terms = node_weights(grid, theta_i, theta_o, phi_o)
    along_i = jnp.stack([over_i for over_i, _, _ in terms], axis=1)
    over_directions = jnp.stack([jnp.outer(over_o, over_phi).reshape(-1) for _, over_o, over_phi in terms])
    distinct = node_value[:, :, :-1].reshape(node_value.shape[0], -1, node_value.shape[-1])

    def add_incidence(total, part):
        weight, nodes = part
        return total + weight @ (over_directions @ nodes), None

    zero = jnp.zeros(node_value.shape[-1], node_value.dtype)
    return jax.lax.scan(add_incidence, zero, (along_i, distinct))[0]


def evaluate_in_chunks(
    result: Any,
    theta_i: npt.ArrayLike,
    theta_o: npt.ArrayLike,
    phi_o: npt.ArrayLike,
    wavelength_nm: npt.ArrayLike | None = None,
    *,
    chunk_size: int | None = None,
) -> np.ndarray:
    """Evaluate many directions on the host in chunks of equal shape, so that working memory stays bounded.

    Args:
        result: As for `evaluate`.
        theta_i: Polar angle of incidence [rad]; the three angles broadcast.
        theta_o: Polar angle of exitance [rad].
        phi_o: Azimuth of exitance [rad].
        wavelength_nm: As for `evaluate`.
        chunk_size: Directions at a time; unless given, what keeps a chunk's arrays near 128 MiB.

    Returns:
        BRDF [1/sr], NumPy, in the common shape of the angles plus the wavelength axis.
    """
    angles = np.broadcast_arrays(*(np.asarray(a, float) for a in (theta_i, theta_o, phi_o)))
    flat = [a.reshape(-1) for a in angles]
    wavelength = None if wavelength_nm is None else np.atleast_1d(np.asarray(wavelength_nm, float))
    num_wavelengths = len(measured_wavelengths(result)) if wavelength is None else len(wavelength)
    count = flat[0].size
    size = chunk_size or min(
        max(1, CHUNK_BYTES // (8 * numbers_per_direction(result))),
        1 << max(count - 1, 0).bit_length(),  # few shapes, few compilations
        MOST_AT_A_TIME,
    )
    value = np.empty((count, num_wavelengths))
    on_host = host_function(result, wavelength)
    result = on_device(result) if on_host is None else result
    for start in range(0, count, size):
        part = [a[start : start + size] for a in flat]
        length = part[0].size
        if on_host is not None:
            value[start : start + length] = on_host(*part)
            continue
        padded = [np.pad(a, (0, size - length), mode="edge") for a in part]  # equal shapes compile once
        value[start : start + length] = np.asarray(evaluate(result, *padded, wavelength))[:length]
    return value.reshape(*angles[0].shape, num_wavelengths)


def host_function(result: Any, wavelength_nm: Float[np.ndarray, " query"] | None):
    """Return what evaluates a record in lists of directions by NumPy; None where JAX does, as on accelerators.

    Compiling takes longer than thousands of directions of a field or a lobe tensor.
    """
    field = getattr(result, "field", result)
    if jax.default_backend() != "cpu" or not isinstance(field, GuidedField | LobeTensor):
        return None
    measured = np.asarray(measured_wavelengths(result), float)
    outside = None if wavelength_nm is None else outside_range(wavelength_nm, measured)
    record = jax.tree.map(np.asarray, field)

    def value_of(theta_i, theta_o, phi_o):
        if isinstance(field, LobeTensor):
            value = tensor_value(record, theta_i, theta_o, phi_o, wavelength_nm)
        else:
            if not getattr(result, "interpolate_theta_i", True):
                nodes = np.asarray(result.theta_i)
                theta_i = nodes[np.argmin(np.abs(theta_i[:, None] - nodes), axis=1)]
            value = evaluate_directions(record, theta_i, theta_o, phi_o)
            if wavelength_nm is not None:
                value = value @ spectral_weights(wavelength_nm, measured).T
        return value if outside is None else np.where(outside, np.nan, value)

    return value_of


def numbers_per_direction(result) -> int:
    """Rough count of the numbers that one direction needs while it is evaluated."""
    if isinstance(result, GuidedField) or getattr(result, "field", None) is not None:
        return 3 * 4**3 * len(result.wavelength_nm)  # the nodes around it on three grids
    if isinstance(result, GriddedBRDF):
        return 8 * int(np.prod(result.brdf.shape[1:3])) + 4 * result.brdf.shape[3]
    if isinstance(result, SpectralField):
        return 8 * int(np.prod(result.coefficient.shape[1:3])) + 4 * len(result.basis.wavelength_nm)
    return sum(int(np.prod(np.shape(leaf)[1:])) for leaf in jax.tree.leaves(result)) + 1


def evaluate_standard_error(
    result: Any,
    theta_i: npt.ArrayLike,
    theta_o: npt.ArrayLike,
    phi_o: npt.ArrayLike,
    wavelength_nm: npt.ArrayLike | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Standard error of the resampled field, and the noise of one measurement there [1/sr], on the host.

    Args:
        result: A GriddedBRDF with a field of its own, or that field.
        theta_i: Polar angle of incidence [rad]; the three angles broadcast.
        theta_o: Polar angle of exitance [rad].
        phi_o: Azimuth of exitance [rad].
        wavelength_nm: Linear between the measured wavelengths, which are taken unless given.

    Raises:
        TypeError: the method has no standard error.
    """
    field = getattr(result, "field", result)
    if not isinstance(field, GuidedField):
        raise TypeError(f"{type(result).__name__}: its method has no standard error")
    angles = np.broadcast_arrays(*(np.asarray(a, float) for a in (theta_i, theta_o, phi_o)))
    _, *found = evaluate_with_error(evaluated_part(field), field_whitener(field), *(a.reshape(-1) for a in angles))
    both = np.asarray(found).reshape(2, *angles[0].shape, -1)
    if wavelength_nm is not None:
        measured = np.asarray(field.wavelength_nm)
        hats = np.stack([np.interp(wavelength_nm, measured, unit) for unit in np.eye(len(measured))])
        both = both @ hats
    return both[0], both[1]


def on_device(result: Any) -> Any:
    """Return the part of a record that evaluation reads, as arrays of JAX and in few shapes; once is enough."""
    if isinstance(result, LobeTensor):
        result = pad_ranks(result)
    if isinstance(result, LobeHarmonics):
        result = pad_coefficients(result)
    if isinstance(result, GriddedBRDF):
        more = {} if result.field is None else {"brdf": None, "field": evaluated_part(result.field)}
        result = dataclasses.replace(result, **dict.fromkeys(NEVER_EVALUATED), **more)
    if isinstance(result, GuidedField):
        result = evaluated_part(result)
    return jax.tree.map(jnp.asarray, result)


def evaluate_on_axes(
    result: Any,
    theta_i: npt.ArrayLike,
    theta_o: npt.ArrayLike,
    phi_o: npt.ArrayLike,
    wavelength_nm: npt.ArrayLike | None = None,
) -> np.ndarray:
    """Evaluate every combination of three axes on the host: [theta_i, theta_o, phi_o, wavelength].

    For the grid, eq. (5) is separable: three small products replace one row of weights for
    every direction. A fitted field sums its nodes once for all azimuths. Other records are
    evaluated direction by direction, in chunks.
    """
    axes = [np.asarray(a, float) for a in (theta_i, theta_o, phi_o)]
    shape = tuple(map(len, axes))
    if isinstance(result, GriddedBRDF) and result.field is None:
        wavelength = None if wavelength_nm is None else jnp.asarray(wavelength_nm, float)
        return np.asarray(_grid_on_axes(on_device(result), *map(jnp.asarray, axes), wavelength))
    if isinstance(getattr(result, "field", result), GuidedField) and all(shape):
        value = evaluate_where(result, *axes, np.ones(shape, bool)).reshape(*shape, -1)
        if wavelength_nm is None:
            return value
        wavelength, measured = np.atleast_1d(np.asarray(wavelength_nm, float)), np.asarray(result.wavelength_nm)
        return np.where(outside_range(wavelength, measured), np.nan, value @ spectral_weights(wavelength, measured).T)
    return evaluate_in_chunks(result, *np.meshgrid(*axes, indexing="ij"), wavelength_nm)


def evaluate_where(
    result: Any,
    theta_i: Float[np.ndarray, " i"],
    theta_o: Float[np.ndarray, " o"],
    phi_o: Float[np.ndarray, " p"],
    where: Bool[np.ndarray, "i o p"],
    *,
    chunk_size: int | None = None,
) -> Float[np.ndarray, "direction wavelength"]:
    """Evaluate those combinations of three axes where a mask is true, on the host, in the mask's order.

    As `evaluate_on_axes` where a record gains by it; what is around the mask is then evaluated too.
    """
    field = getattr(result, "field", result)
    axes = [np.asarray(a, float) for a in (theta_i, theta_o, phi_o)]
    if isinstance(result, GriddedBRDF) and field is None:
        return evaluate_on_axes(result, *axes)[where]
    gains = isinstance(field, GuidedField) or (isinstance(field, LobeTensor) and jax.default_backend() == "cpu")
    if not gains or not where.any():
        directions = (mesh[where] for mesh in np.meshgrid(*axes, indexing="ij"))
        return evaluate_in_chunks(result, *directions, chunk_size=chunk_size)
    nodes = None if getattr(result, "interpolate_theta_i", True) else np.asarray(result.theta_i)
    value: list[np.ndarray] = []
    along, part = (tensor_on_axes, field) if isinstance(field, LobeTensor) else (field_on_axes, evaluated_part(field))
    for i in np.flatnonzero(where.any(axis=(1, 2))):
        angle = axes[0][i] if nodes is None else nodes[np.argmin(np.abs(axes[0][i] - nodes))]
        row = functools.partial(on_host(along), part, angle)
        value += on_axes(lambda *at, row=row: (row(*at),), *axes[1:], where[i])
    return np.concatenate(value)


@jax.jit
def _grid_on_axes(grid: GriddedBRDF, theta_i, theta_o, phi_o, wavelength_nm):
    zero = jnp.zeros((), jnp.asarray(grid.theta_i).dtype)
    along_i = jax.vmap(lambda t: [term[0] for term in node_weights(grid, t, zero, zero)])(theta_i)
    along_o = jax.vmap(lambda t: [term[1] for term in node_weights(grid, zero, t, zero)])(theta_o)
    along_phi = jax.vmap(lambda p: [term[2] for term in node_weights(grid, zero, zero, p)])(phi_o)
    nodes = jnp.asarray(grid.brdf)[:, :, :-1]
    value = sum(
        jnp.einsum("am,bn,cl,mnlw->abcw", w_i, w_o, w_phi, nodes)
        for w_i, w_o, w_phi in zip(along_i, along_o, along_phi, strict=True)
    )
    if wavelength_nm is None:
        return value
    measured = jnp.asarray(grid.wavelength_nm)
    value = jnp.einsum("abcw,vw->abcv", value, spectral_weights(wavelength_nm, measured))
    return jnp.where(outside_range(wavelength_nm, measured)[None, None, None, :], jnp.nan, value)
