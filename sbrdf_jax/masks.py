"""Files of cells that a scene looks at: masks, and footprints with one mask for each material.

HDF5, `schema_name` "sbrdf-footprint". A mask is a dataset `needed` [theta_i, theta_o, phi_o] or
[theta_o, phi_o] beside its axes `theta_i_deg`, `theta_o_deg`, `phi_o_deg`, which are the centres
of the cells; in a footprint each material has one, `materials/NAME/needed`.
"""

import dataclasses
import os
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Bool, Float

from sbrdf_jax.angles import fold_azimuth
from sbrdf_jax.errors import UserError
from sbrdf_jax.files import whole_file
from sbrdf_jax.formats.isolated import read_isolated
from sbrdf_jax.grid import Grid
from sbrdf_jax.hdf5 import dataset, degrees, file_in_memory, scale

SCHEMA_NAME, SCHEMA_VERSION = "sbrdf-footprint", 1
MATERIAL_MARK = "#"  # FOOTPRINT.h5#NAME names one of its materials
MOST_NUMBERS = 50_000_000
AXES = ("theta_i_deg", "theta_o_deg", "phi_o_deg")


@dataclasses.dataclass(frozen=True)
class Mask:
    """Cells that are needed; phi_o is folded, theta_i is None where every incident angle counts."""

    theta_i: Float[np.ndarray, " theta_i"] | None  # rad
    theta_o: Float[np.ndarray, " theta_o"]  # rad
    phi_o: Float[np.ndarray, " phi_o"]  # rad, 0 to pi
    needed: Bool[np.ndarray, "theta_i theta_o phi_o"]


def write_footprint(path: str | os.PathLike, axes: tuple[np.ndarray, ...], counts: dict[str, np.ndarray]) -> None:
    """Write how often light reached each cell of each material; needed are those and their neighbours.

    Args:
        path: The file.
        axes: Centres of the cells: theta_i, theta_o, folded phi_o [rad].
        counts: By material: [theta_i, theta_o, phi_o].
    """
    with whole_file(path) as temporary, file_in_memory(temporary) as file:
        file.attrs["schema_name"], file.attrs["schema_version"] = SCHEMA_NAME, SCHEMA_VERSION
        file.attrs["materials"] = ",".join(counts)
        scales = [scale(file, name, degrees(axis), "deg") for name, axis in zip(AXES, axes, strict=True)]
        for name, count in counts.items():
            group = file.create_group(f"materials/{name}")
            dataset(group, "count", np.asarray(count, np.int64), "1", scales)
            dataset(group, "needed", widen(count > 0).astype(np.uint8), "1", scales)


def widen(needed: Bool[np.ndarray, "theta_i theta_o phi_o"]) -> Bool[np.ndarray, "theta_i theta_o phi_o"]:
    """Add the neighbours of every cell, along each axis and across."""
    for axis in range(3):
        moved = np.moveaxis(needed, axis, 0)
        wide = moved.copy()
        wide[1:] |= moved[:-1]
        wide[:-1] |= moved[1:]
        needed = np.moveaxis(wide, 0, axis)
    return needed


def read_mask(name: str, key: str) -> Mask:
    """Read a mask, or one material of a footprint.

    Args:
        name: The file; `FILE#NAME` names one of several materials.
        key: The config's key, for messages.

    Raises:
        UserError: No such file, no mask, several materials and none named, or axes that do not increase.
    """
    file, _, material = name.partition(MATERIAL_MARK) if not Path(name).exists() else (name, "", "")
    path = Path(file)
    if not path.is_file():
        raise UserError(f"{key}: {file}: found no such file; expected a mask or a footprint (HDF5)")
    if not h5py.is_hdf5(path):
        raise UserError(f"{key}: {file}: found no HDF5 file, or one cut off; expected a mask or a footprint")
    head = read_isolated(path, ("schema_name", "schema_version", "materials"))[0]
    if head["schema_name"] != SCHEMA_NAME:
        raise UserError(f"{key}: {file}: schema_name: found {head['schema_name']!r}; expected {SCHEMA_NAME!r}")
    if int(head["schema_version"] or 0) > SCHEMA_VERSION:
        raise UserError(f"{key}: {file}: schema_version: found {head['schema_version']}; expected {SCHEMA_VERSION}")
    names = str(head["materials"]).split(",") if head["materials"] else []
    if names and not material and len(names) > 1:
        raise UserError(f"{key}: {file}: found the materials {', '.join(names)}; expected one, as in {file}#{names[0]}")
    if material and material not in names:
        raise UserError(f"{key}: {file}: found the materials {', '.join(names)}; expected {material!r} among them")
    where = f"materials/{material or names[0]}/needed" if names else "needed"
    needed = read_isolated(path, (), (where,), MOST_NUMBERS)[1][where] > 0
    labels = AXES[3 - needed.ndim :] if needed.ndim in (2, 3) else AXES
    found = read_isolated(path, (), labels, MOST_NUMBERS)[1]
    axes = [np.deg2rad(found[label]) for label in labels]
    if needed.shape != tuple(map(np.size, axes)):
        raise UserError(f"{key}: {file}: {where}: found shape {needed.shape}; expected the lengths of its axes")
    for label, axis in zip(labels, axes, strict=True):
        if axis.ndim != 1 or not (np.diff(axis) > 0).all() or not np.isfinite(axis).all():
            raise UserError(f"{key}: {file}: {label}: found values out of order; expected them to increase")
    folded = fold_azimuth(axes[-1])
    phi_o = np.unique(np.round(folded, 12))
    place = np.searchsorted(phi_o, np.round(folded, 12))
    half = np.zeros((*needed.shape[:-1], len(phi_o)), bool)
    np.logical_or.at(np.moveaxis(half, -1, 0), place, np.moveaxis(needed, -1, 0))
    if needed.ndim == 2:
        return Mask(None, axes[0], phi_o, half[None])
    return Mask(axes[0], axes[1], phi_o, half)


def nodes_of_mask(mask: Mask, grid: Grid) -> Bool[np.ndarray, "theta_i theta_o phi_o"]:
    """Return the nodes of a grid that a mask's cells touch: the mask itself on its own axes.

    On other axes a node is needed where linear interpolation anywhere in a cell would ask for it.
    """
    rows = np.ones((len(grid.theta_i), 1), bool)
    if mask.theta_i is not None:
        rows = _touches(grid.theta_i, mask.theta_i)
    columns = _touches(grid.theta_o, mask.theta_o)
    around = _touches(fold_azimuth(grid.phi_o), mask.phi_o)
    touched = np.einsum("im,mnl->inl", rows.astype(float), mask.needed.astype(float))
    touched = np.einsum("on,inl->iol", columns.astype(float), touched)
    return np.einsum("pl,iol->iop", around.astype(float), touched) > 0


def _touches(node: np.ndarray, cell: np.ndarray) -> Bool[np.ndarray, "node cell"]:
    """Which nodes of an axis the cells of another touch."""
    distance = np.abs(node[:, None] - cell)
    slack = 1e-9
    if (distance.min(axis=1) < slack).all() and (distance.min(axis=0) < slack).all():
        return distance < slack
    reach = (_step(np.unique(node)) + _step(cell) / 2) if len(node) > 1 else np.pi
    found = distance < reach - slack
    found[np.argmin(distance, axis=0), np.arange(len(cell))] = True
    return found


def _step(axis: np.ndarray) -> float:
    return float(np.diff(axis).max()) if len(axis) > 1 else float(np.pi)
