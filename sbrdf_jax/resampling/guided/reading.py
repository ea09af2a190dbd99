"""The fitted field and its standard error, read off at the nodes of a grid that are needed."""

import jax.numpy as jnp
import numpy as np

from sbrdf_jax.grid import Grid
from sbrdf_jax.records import GriddedBRDF
from sbrdf_jax.resampling.guided.field import GuidedField, evaluate_with_error
from sbrdf_jax.resampling.guided.lanes import take_field

SAME_ANGLE = 1e-9  # rad; degrees in a file and back are not exact
SMALLEST_BATCH = 64  # directions evaluated at once; fewer are padded


def read_nodes(
    field: GuidedField,
    grid: Grid,
    whiten: np.ndarray,
    node: np.ndarray | None = None,
    known: GriddedBRDF | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the field and its standard error [theta_i, theta_o, phi_o inclusive, wavelength] at the grid's nodes.

    The field is even in azimuth, so half of the circle is evaluated, in batches of one shape.

    Args:
        field: The fitted field.
        grid: Nodes.
        whiten: Inverse Cholesky factor of prior plus noise, from the fit.
        node: Mask [theta_i, theta_o, phi_o inclusive] of the nodes that are needed, nan elsewhere; incident angles
            without any are left out. None: all.
        known: An earlier answer, of which what is needed is taken over.
    """
    shape = (len(grid.theta_i), len(grid.theta_o), grid.num_azimuths)
    half = np.ones(shape, bool) if node is None else node[:, :, : grid.num_azimuths]
    axes = np.meshgrid(grid.theta_i, grid.theta_o, grid.phi_o[: grid.num_azimuths], indexing="ij")
    value = np.full((2, *shape, len(field.wavelength_nm)), np.nan)
    fresh, lanes = half, np.ones(len(field.wavelength_nm), bool)
    if known is not None and known_rows(known, grid) is not None:
        fresh, lanes = _take_known(value, half, grid, np.asarray(field.wavelength_nm), known)
    for nodes, wavelengths in ((fresh, slice(None)), (half & ~fresh, lanes)):
        place = np.flatnonzero(nodes)
        part = field if isinstance(wavelengths, slice) else take_field(field, wavelengths)
        if len(place) and len(part.wavelength_nm):
            angles = [a.reshape(-1)[place] for a in axes]
            value.reshape(2, -1, value.shape[-1])[:, place[:, None], np.arange(value.shape[-1])[wavelengths]] = (
                _read_batches(part, whiten, angles, shape[1] * shape[2])
            )
    around = np.append(grid.azimuth_index, 0)
    value = value[:, half.any(axis=(1, 2))][:, :, :, around]
    return value[0], value[1]


def _take_known(value: np.ndarray, half: np.ndarray, grid: Grid, wavelength_nm: np.ndarray, known: GriddedBRDF):
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


def _read_batches(field: GuidedField, whiten: np.ndarray, angles: list[np.ndarray], most: int) -> np.ndarray:
    """Return value and standard error [2, direction, wavelength], in batches of one shape."""
    count = len(angles[0])
    size = min(most, max(SMALLEST_BATCH, 1 << (count - 1).bit_length()))
    padded = [np.pad(a, (0, -count % size), mode="edge").reshape(-1, size) for a in angles]
    factor = jnp.asarray(whiten)
    found = [evaluate_with_error(field, factor, *map(jnp.asarray, batch))[:2] for batch in zip(*padded, strict=True)]
    return np.concatenate([np.asarray(batch) for batch in found], axis=1)[:, :count]
