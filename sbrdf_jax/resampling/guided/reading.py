"""The fitted field and its standard error, read off at the nodes of a grid that are needed."""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sbrdf_jax.angles import SAME_ANGLE
from sbrdf_jax.devices import on_host
from sbrdf_jax.grid import Grid
from sbrdf_jax.records import GriddedBRDF
from sbrdf_jax.resampling.guided.covariance import HeldCovariances, covariance_on_axes
from sbrdf_jax.resampling.guided.field import (
    GuidedField,
    evaluate_on_axes_with_error,
    evaluated_part,
    explained,
    unexplained,
    with_doubt,
)
from sbrdf_jax.resampling.guided.inverse import Whitener
from sbrdf_jax.resampling.guided.lanes import take_field
from sbrdf_jax.resampling.guided.on_axes import on_axes

MOST_PENDING = 4096  # directions whose covariances with all centres are held at a time
Covariances = tuple[np.ndarray, np.ndarray]  # prior ones [direction, centre], and prior variances [direction]


class NodeValues(NamedTuple):
    """What is read off at nodes; nan at those that are not needed, incident angles without any left out."""

    value: Float[np.ndarray, "theta_i theta_o phi_o wavelength"]  # 1/sr; phi_o from 0 to 2 pi inclusive
    standard_error: Float[np.ndarray, "theta_i theta_o phi_o wavelength"]  # 1/sr
    variance: Float[np.ndarray, "theta_i theta_o phi_o"]  # of z, relative to the prior's


def read_nodes(
    field: GuidedField,
    grid: Grid,
    whiten: Whitener,
    node: np.ndarray | None = None,
    known: GriddedBRDF | None = None,
    variances: dict[bytes, np.ndarray] | None = None,
    covariances: dict[bytes, HeldCovariances] | None = None,
) -> NodeValues:
    """Return the field and its standard error at the grid's nodes.

    The field is even in azimuth, so half of the circle is evaluated, one incident angle at a time.

    Args:
        field: The fitted field.
        grid: Nodes.
        whiten: Of prior plus noise, from the fit.
        node: Mask [theta_i, theta_o, phi_o inclusive] of the nodes that are needed; None: all.
        known: An earlier answer, of which what is needed is taken over.
        variances: Variances of z that other wavelengths have asked for, by grid; new ones are added.
        covariances: Of the nodes that the last material of these centres asked for, by grid; renewed.
    """
    shape = (len(grid.theta_i), len(grid.theta_o), grid.num_azimuths)
    half = np.ones(shape, bool) if node is None else node[:, :, : grid.num_azimuths]
    axes = grid.theta_o, grid.phi_o[: shape[2]]
    variance = ({} if variances is None else variances).setdefault(grid.key, np.full(shape, np.nan))
    value = np.full((2, *shape, len(field.wavelength_nm)), np.nan)
    fresh, lanes = half, np.ones(len(field.wavelength_nm), bool)
    if known is not None and known_rows(known, grid) is not None:
        fresh, lanes = _take_known(value, variance, half, grid, np.asarray(field.wavelength_nm), known)
    missing = half & np.isnan(variance)
    covariances = {} if covariances is None else covariances
    _add_variances(variance, missing, field, whiten, grid.theta_i, axes, covariances, grid.key + missing.tobytes())
    for nodes, columns in ((fresh, np.arange(len(lanes))), (half & ~fresh, np.flatnonzero(lanes))):
        rows = np.flatnonzero(nodes.any(axis=(1, 2)))
        if not len(columns) or not len(rows):
            continue
        part = evaluated_part(field if len(columns) == len(lanes) else take_field(field, columns))
        for i in rows:
            at_i = functools.partial(on_host(evaluate_on_axes_with_error), part, grid.theta_i[i])
            o, p = (place[:, None] for place in np.nonzero(nodes[i]))
            for out, new in zip(value[:, i], on_axes(at_i, *axes, nodes[i], variance[i]), strict=True):
                out[o, p, columns] = new
    around, rows = np.append(grid.azimuth_index, 0), half.any(axis=(1, 2))
    known_variance = np.where(half, variance, np.nan)[rows][:, :, around]
    nodes, errors = (np.ascontiguousarray(part[rows][:, :, around]) for part in value)  # products round by the order
    return NodeValues(nodes, errors, known_variance)


def _add_variances(
    variance: np.ndarray, missing: np.ndarray, field: GuidedField, whiten, theta_i, axes, covariances, key: bytes
) -> None:
    """Work out the variances that are missing, once for each distinct direction: poles have many azimuths.

    Covariances depend on angles and the prior alone; of few enough directions they are held for the next material.
    """
    prior = field.variance, field.centre, field.theta_limit
    pending: list[Covariances] = []
    flushed: list[np.ndarray] = []
    distinct = missing.copy()
    isotropic = (theta_i[:, None] == 0) | (axes[0] == 0)
    distinct[isotropic] = False
    distinct[..., 0] |= isotropic & missing.any(axis=2)
    rows = [] if key in covariances else np.flatnonzero(distinct.any(axis=(1, 2)))
    for i in rows:
        pending.append(on_axes(functools.partial(on_host(covariance_on_axes), *prior, theta_i[i]), *axes, distinct[i]))
        if sum(len(part[1]) for part in pending) >= MOST_PENDING:
            flushed.append(unexplained(*_joined(pending), whiten))
            pending = []
    if pending and not flushed:
        covariances.clear()  # they take up to 52 MB
        covariances[key] = HeldCovariances(*_joined(pending), [])
    elif pending:
        flushed.append(unexplained(*_joined(pending), whiten))
    if key in covariances:
        flushed.append(_left(covariances[key], whiten))
    if flushed:
        found = np.full(variance.shape, np.nan)
        found[distinct] = np.concatenate(flushed)
        found[isotropic] = found[isotropic][:, :1]
        variance[missing] = found[missing]


def _left(held: HeldCovariances, whiten: Whitener) -> np.ndarray:
    """`field.unexplained`, of which most is the same for the next material whose noise is as strong."""
    left = next((found for lower, found in held.left if lower is whiten.lower), None)
    if left is None:
        left = held.prior - explained(held.cross, whiten.lower)
        held.left.append((whiten.lower, left))
    return with_doubt(left, held.cross, whiten.doubt)


def _joined(parts: list[Covariances]) -> Covariances:
    if len(parts) == 1:
        return parts[0]
    cross, prior = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return cross, prior


def _take_known(value, variance, half: np.ndarray, grid: Grid, wavelength_nm: np.ndarray, known: GriddedBRDF):
    """Fill in what an earlier answer holds; return the nodes that it lacks, and the wavelengths that it lacks there."""
    held = np.isin(wavelength_nm, known.wavelength_nm)
    columns = np.searchsorted(known.wavelength_nm, wavelength_nm[held])
    rows = known_rows(known, grid)
    assert rows is not None
    fresh = half.copy()
    for place in np.flatnonzero(rows >= 0):
        found = [
            np.asarray(a)[rows[place], :, : half.shape[2]][..., columns] for a in (known.brdf, known.standard_error)
        ]
        has = half[place] & np.isfinite(found[0]).all(axis=-1)
        if known.residual_variance is not None:
            variance[place][has] = np.asarray(known.residual_variance)[rows[place], :, : half.shape[2]][has]
        for out, source in zip(value, found, strict=True):
            out[place][has[..., None] & held] = source[has].reshape(-1)
        fresh[place] &= ~has
    return fresh, ~held


def known_rows(known: GriddedBRDF, grid: Grid) -> np.ndarray | None:
    """Return the row of each incident angle of a grid in an earlier answer, -1 where it lacks it.

    None where the nodes of outgoing directions are others.
    """
    for one, other in ((known.theta_o, grid.theta_o), (known.phi_o, grid.phi_o)):
        if np.shape(one) != np.shape(other) or np.abs(np.asarray(one) - other).max() > SAME_ANGLE:
            return None
    distance = np.abs(grid.theta_i[:, None] - np.asarray(known.theta_i))
    return np.where(distance.min(axis=1) <= SAME_ANGLE, distance.argmin(axis=1), -1)
