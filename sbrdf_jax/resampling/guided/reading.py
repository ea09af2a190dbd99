"""The fitted field and its standard error, read off at the nodes of a grid that are needed."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sbrdf_jax.grid import Grid
from sbrdf_jax.records import GriddedBRDF
from sbrdf_jax.resampling.guided.field import GuidedField, posterior_variance, value_and_errors
from sbrdf_jax.resampling.guided.lanes import take_field

SAME_ANGLE = 1e-9  # rad; degrees in a file and back are not exact
SMALLEST_BATCH, LARGEST_BATCH = 64, 512  # directions evaluated at once, a power of two


class NodeValues(NamedTuple):
    """What is read off at nodes; nan at those that are not needed, incident angles without any left out."""

    value: Float[np.ndarray, "theta_i theta_o phi_o wavelength"]  # 1/sr; phi_o from 0 to 2 pi inclusive
    standard_error: Float[np.ndarray, "theta_i theta_o phi_o wavelength"]  # 1/sr
    variance: Float[np.ndarray, "theta_i theta_o phi_o"]  # of z, relative to the prior's


def read_nodes(
    field: GuidedField,
    grid: Grid,
    whiten: np.ndarray,
    node: np.ndarray | None = None,
    known: GriddedBRDF | None = None,
    variances: dict[bytes, np.ndarray] | None = None,
) -> NodeValues:
    """Return the field and its standard error at the grid's nodes.

    The field is even in azimuth, so half of the circle is evaluated, in batches of one shape.

    Args:
        field: The fitted field.
        grid: Nodes.
        whiten: Inverse Cholesky factor of prior plus noise, from the fit.
        node: Mask [theta_i, theta_o, phi_o inclusive] of the nodes that are needed; None: all.
        known: An earlier answer, of which what is needed is taken over.
        variances: Variances of z that other wavelengths have asked for, by grid; new ones are added.
    """
    shape = (len(grid.theta_i), len(grid.theta_o), grid.num_azimuths)
    half = np.ones(shape, bool) if node is None else node[:, :, : grid.num_azimuths]
    axes = [a.reshape(-1) for a in np.meshgrid(grid.theta_i, grid.theta_o, grid.phi_o[: shape[2]], indexing="ij")]
    key = b"".join(np.asarray(a).tobytes() for a in (grid.theta_i, grid.theta_o, grid.phi_o))
    variance = ({} if variances is None else variances).setdefault(key, np.full(shape, np.nan)).reshape(-1)
    value = np.full((2, *shape, len(field.wavelength_nm)), np.nan)
    fresh, lanes = half, np.ones(len(field.wavelength_nm), bool)
    if known is not None and known_rows(known, grid) is not None:
        fresh, lanes = _take_known(value, variance.reshape(shape), half, grid, np.asarray(field.wavelength_nm), known)
    _add_variances(variance, field, whiten, axes, np.flatnonzero(half.reshape(-1) & np.isnan(variance)))
    flat = value.reshape(2, -1, value.shape[-1])
    for nodes, columns in ((fresh, np.arange(len(lanes))), (half & ~fresh, np.flatnonzero(lanes))):
        place = np.flatnonzero(nodes)
        if len(place) and len(columns):
            part = field if len(columns) == len(lanes) else take_field(field, columns)
            inputs = [variance[place], *(a[place] for a in axes)]
            found = _in_batches(lambda *batch, part=part: value_and_errors(part, *batch)[:2], inputs)
            flat[:, place[:, None], columns] = found
    around, rows = np.append(grid.azimuth_index, 0), half.any(axis=(1, 2))
    known_variance = np.where(half, variance.reshape(shape), np.nan)[rows][:, :, around]
    value = value[:, rows][:, :, :, around]
    return NodeValues(value[0], value[1], known_variance)


def _add_variances(variance: np.ndarray, field: GuidedField, whiten: np.ndarray, axes, place: np.ndarray) -> None:
    """Work out the variances that are missing, once for each distinct direction: poles have many azimuths."""
    if not len(place):
        return
    theta_i, theta_o, phi_o = (a[place] for a in axes)
    phi_o = np.where((theta_i == 0) | (theta_o == 0), 0.0, phi_o)
    distinct, back = np.unique(np.stack([theta_i, theta_o, phi_o]), axis=1, return_inverse=True)
    given = (field.variance, *map(jnp.asarray, (field.centre, field.theta_limit, whiten)))
    found = _in_batches(lambda *batch: (posterior_variance(*given, *batch),), list(distinct))
    variance[place] = found[0][back.reshape(-1)]


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


def _in_batches(function: Callable[..., Any], inputs: list[np.ndarray]) -> np.ndarray:
    """Map a function of directions over batches of few shapes; its answers stacked [answer, direction, ...]."""
    count = len(inputs[0])
    size = min(LARGEST_BATCH, max(SMALLEST_BATCH, 1 << (count - 1).bit_length()))
    padded = [np.pad(a, (0, -count % size), mode="edge").reshape(-1, size) for a in inputs]
    found = [np.asarray(function(*map(jnp.asarray, batch))) for batch in zip(*padded, strict=True)]
    return np.concatenate(found, axis=1)[:, :count]
