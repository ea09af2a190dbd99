"""Covariances of the residual between directions, without a matrix of node pairs.

With samples A x, energy x' E x and noise N, the normal equations (A' N^-1 A + E) x = A' N^-1 r
have the dual (A E^-1 A' + N) a = r, x = E^-1 A' a: as large as the samples, not the nodes.
Samples of one incident angle share the modes of theta_i, so A E^-1 A' needs the modes of
the two other axes only, once per pair of a direction and an incident angle; of the difference
grid it is a sum of products of one small matrix product an axis. Nodes tied by
reciprocity are the mean of both ways: A becomes (A + A exchanged) / 2.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.sparse
from jaxtyping import Float

from sbrdf_jax.array_module import AnyArray, array_module
from sbrdf_jax.records import pytree
from sbrdf_jax.resampling.guided.coordinates import Coordinates, coordinates_on_axes, exchanged, guided_coordinates
from sbrdf_jax.resampling.guided.nodes import (
    GRIDS,
    LEAN,
    POLAR_GRIDS,
    THETA,
    Features,
    ModeVariance,
    analyse,
    axis_features,
    difference_features,
    features_of,
    synthesise,
)

DIRECTIONS_AT_A_TIME = 256


@pytree()
class GroupedFeatures:
    """Features of centres, grouped by incident angle."""

    theta_i: Any  # [group, mode]
    half: Any  # [group, member, mode]
    azimuth: Any  # [group, member, mode]
    along: tuple[Any, Any, Any]  # [centre, mode] of each axis of the difference grid


class HeldCovariances(NamedTuple):
    """What the next material of these centres needs at the same nodes."""

    cross: np.ndarray  # [direction, centre] prior covariances
    prior: np.ndarray  # [direction] prior variances
    left: list[tuple[np.ndarray, np.ndarray]]  # W, and what centres with equal noise leave of the variances


def group_coordinates(angles: Float[AnyArray, "3 group member"], theta_limit: Float[AnyArray, " 2"]) -> Coordinates:
    """Coordinates of centres as the residual sees them: each group at one incident angle, its members' mean."""
    at = guided_coordinates(angles[0], angles[1], angles[2], theta_limit)
    mean = at.theta_i.mean(axis=1, keepdims=True)
    return dataclasses.replace(at, theta_i=array_module(mean).broadcast_to(mean, at.theta_i.shape))


def group_features(at: Coordinates) -> GroupedFeatures:
    """Return the features of grouped centres [group, member], of one theta_i each group."""
    features = features_of(at)
    along = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), features.along)
    return GroupedFeatures(features.theta_i[:, 0], features.half, features.azimuth, along)


def flatten(at: Coordinates) -> Coordinates:
    """Return coordinates with all their axes made one."""
    return jax.tree.map(lambda x: x.reshape(-1), at)


def _by_theta_i(variance):
    """Variances of one grid's modes as [mode of theta_i, other mode], the order of the features."""
    return array_module(variance).moveaxis(variance, 1, 0).reshape(variance.shape[1], -1)


def _covariance(variance: ModeVariance, left: Features, right: GroupedFeatures):
    xp, total = array_module(left.theta_i, right.theta_i), 0.0
    for name in POLAR_GRIDS:
        pairs = left.theta_i[:, None, :] * right.theta_i[None, :, :]  # [direction, group, mode]
        weighted = (pairs @ _by_theta_i(getattr(variance, name))) * getattr(left, name)[:, None, :]
        # [direction, group, other mode] with [group, member, other mode], group by group
        total = total + xp.swapaxes(weighted, 0, 1) @ xp.swapaxes(getattr(right, name), 1, 2)
    return xp.swapaxes(total, 0, 1).reshape(left.theta_i.shape[0], -1) + _along_axes(variance, left.along, right.along)


def _along_axes(variance: ModeVariance, left, right):
    """Covariance [*direction, centre] by the difference grid of features [*direction, mode] and [centre, mode]."""
    total = 0.0
    for term in zip(*variance.along, strict=True):
        one, two, three = (x @ (weight[:, None] * y.T) for x, weight, y in zip(left, term, right, strict=True))
        total = total + one * two * three
    return total


def _own_along_axes(variance: ModeVariance, left, right):
    """Covariance [*direction] by the difference grid of pairs of directions, of features [*direction, mode]."""
    total = 0.0
    for term in zip(*variance.along, strict=True):
        one, two, three = ((x * y) @ weight for x, y, weight in zip(left, right, term, strict=True))
        total = total + one * two * three
    return total


def covariance(
    variance: ModeVariance, at: Coordinates, centres: GroupedFeatures
) -> Float[AnyArray, "direction centre"]:
    """Prior covariance A E^-1 A' of the residual between directions and grouped centres (flattened)."""

    def of_chunk(chunk):
        forth = _covariance(variance, features_of(chunk), centres)
        if not variance.reciprocal:
            return forth
        return (forth + _covariance(variance, features_of(exchanged(chunk)), centres)) / 2

    return in_chunks(of_chunk, at, DIRECTIONS_AT_A_TIME)


def in_chunks(function: Callable[[Any], AnyArray], directions: Any, size: int) -> AnyArray:
    """Map a function of directions [direction] over chunks of equal size, so that memory stays bounded."""
    leaves = jax.tree.leaves(directions)
    xp, count = array_module(*leaves), leaves[0].shape[0]
    size = -(-count // max(-(-count // size), 1)) if count else 1
    chunks = jax.tree.map(lambda x: xp.pad(x, (0, -count % size)).reshape(-1, size), directions)
    if xp is np:
        parts = [function(jax.tree.map(lambda x, k=k: x[k], chunks)) for k in range(-(-count // size))]
        return np.concatenate(parts)[:count]
    out = jax.lax.map(function, chunks)
    return out.reshape(-1, *out.shape[2:])[:count]


def prior_variance(variance: ModeVariance, at: Coordinates) -> Float[AnyArray, " direction"]:
    """Prior variance of the residual in each direction: the diagonal of `covariance` with itself."""
    features = features_of(at)

    def with_features(others: Features):
        total = _own_along_axes(variance, features.along, others.along)
        for name in POLAR_GRIDS:
            weight = (features.theta_i * others.theta_i) @ _by_theta_i(getattr(variance, name))
            total = total + (weight * getattr(features, name) * getattr(others, name)).sum(axis=1)
        return total

    if not variance.reciprocal:
        return with_features(features)
    return (with_features(features) + with_features(features_of(exchanged(at)))) / 2


def covariance_on_axes(
    variance: ModeVariance,
    centre: Float[AnyArray, "3 group member"],
    theta_limit: Float[AnyArray, " 2"],
    theta_i: Float[AnyArray, ""],
    theta_o: Float[AnyArray, " o"],
    phi_o: Float[AnyArray, " p"],
) -> tuple[Float[AnyArray, "o p centre"], Float[AnyArray, "o p"]]:
    """`covariance` and `prior_variance` of all combinations of two axes, at one incident angle.

    The modes of both polar angles are summed once for all azimuths: a tenth of the work.
    """
    xp = array_module(centre, theta_limit, theta_i, theta_o, phi_o)
    at = coordinates_on_axes(theta_i, theta_o, phi_o, theta_limit)
    places = group_coordinates(centre, theta_limit)
    along_i, along_o = axis_features(at.theta_i[:, 0], THETA), axis_features(at.theta_o[:, 0], THETA)
    centre_i, centre_o = axis_features(places.theta_i[:, 0], THETA), axis_features(places.theta_o, THETA)
    polar = along_i[:, :, None] * along_o[:, None, :]  # [o, mode of theta_i, mode of theta_o]
    if variance.reciprocal:
        polar = (polar + xp.swapaxes(polar, 1, 2)) / 2
    lean, *others = difference_features(at)  # lean [o, 1, mode]
    if variance.reciprocal:
        lean = (lean + axis_features(-at.lean, LEAN)) / 2
    along = lean, *others
    total, prior = 0.0, _own_along_axes(variance, along, along)
    for name, grid in POLAR_GRIDS.items():
        around, at_centre = (axis_features(getattr(x, name), grid.axes[0]) for x in (at, places))
        weighted = polar[:, None] * getattr(variance, name)[None]  # [o, first mode, two modes]
        of_first = (weighted * polar[:, None]).sum(axis=(2, 3))
        prior = prior + (around**2 @ of_first[:, :, None])[:, :, 0]
        of_group = xp.tensordot(centre_i, weighted, (1, 2))  # [group, o, first mode, mode of theta_o]
        of_centre = of_group @ xp.swapaxes(centre_o, 1, 2)[:, None] * xp.swapaxes(at_centre, 1, 2)[:, None]
        total = total + around[None] @ of_centre  # [group, o, p, member]
    total = xp.moveaxis(total, 0, 2).reshape(*at.half.shape, -1)
    return total + _along_axes(variance, along, difference_features(flatten(places))), prior


def mode_sums(
    rows: dict[str, scipy.sparse.csr_array], dual: Float[np.ndarray, "centre wavelength"]
) -> dict[str, Float[np.ndarray, "first second third wavelength"]]:
    """Sum the modes of centres, weighed by `dual`, for each grid: A' a, given to the nodes and then to their modes."""
    sums = {}
    for name, grid in GRIDS.items():
        nodes = rows[name].T @ dual
        sums[name] = analyse(nodes.reshape(*(axis.count + 2 for axis in grid.axes), -1), grid.axes)
    return sums


def node_values(
    variance: ModeVariance, rows: dict[str, scipy.sparse.csr_array], dual: Float[np.ndarray, "centre wavelength"]
) -> dict[str, Float[np.ndarray, "first second third wavelength"]]:
    """Return the nodes x = E^-1 A' a of each grid, from dual coefficients a, on the host.

    Args:
        variance: The prior E^-1.
        rows: A, `Centres.node_rows`.
        dual: a.
    """
    sums = mode_sums(rows, dual)
    if variance.reciprocal:
        for name in POLAR_GRIDS:
            sums[name] = (sums[name] + np.swapaxes(sums[name], 1, 2)) / 2
        is_odd = np.arange(LEAN.count) % 2  # these modes change sign with theta_i - theta_o
        sums["difference"] = sums["difference"] * (1.0 - is_odd)[:, None, None, None]
    return {
        name: synthesise(modes * getattr(variance, name)[..., None], GRIDS[name].axes) for name, modes in sums.items()
    }
