"""The project's own raw HDF5: five datasets and four attributes, sizes checked before anything is read."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sbrdf_jax.errors import UserError
from sbrdf_jax.formats.table import MAX_NUMBERS, QUANTITIES, Table
from sbrdf_jax.formats.text import shorten
from sbrdf_jax.hdf5 import degrees
from sbrdf_jax.records import RawSamples

SCHEMA_NAME = "sbrdf-raw"
SCHEMA_VERSION = 1
ANGLES = ("theta_i_deg", "theta_o_deg", "phi_o_deg")
UNITS = {name: "deg" for name in ANGLES} | {"wavelength_nm": "nm"}
MAX_EXPANSION = 140  # float64 numbers over bytes of the file: gzip cannot reach more
MAX_ATTRIBUTE_BYTES = 2**16
# what h5py raises on damaged files
HDF5_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, MemoryError, OverflowError)


def schema_name(path: Path) -> str | None:
    """Return the root attribute `schema_name` of an HDF5 file, None where it has none.

    Raises:
        UserError: the file is damaged.
    """
    try:
        with h5py.File(path, "r", locking=False) as file:
            found = _attribute(path, file, "schema_name") if "schema_name" in file.attrs else None
            return found if isinstance(found, str) else None
    except HDF5_ERRORS as error:
        raise _damaged(path, error) from error


def read_hdf5(path: Path) -> Table:
    """Read the project's raw HDF5.

    Datasets theta_i_deg, theta_o_deg, phi_o_deg [sample], wavelength_nm [wavelength] and value [sample, wavelength];
    attributes schema_name, schema_version, quantity, mirror_azimuth_deg (180 where it is missing).

    Args:
        path: The file.

    Returns:
        The table, in degrees.

    Raises:
        UserError: damaged, of another schema, incomplete, wrong shapes or types, or larger than it can be.
    """
    try:
        with h5py.File(path, "r", locking=False) as file:
            return _read(path, file)
    except HDF5_ERRORS as error:
        raise _damaged(path, error) from error


def write_hdf5(path: Path, samples: RawSamples) -> None:
    """Write samples as the project's raw HDF5."""
    with h5py.File(path, "w") as file:
        file.attrs["schema_name"] = SCHEMA_NAME
        file.attrs["schema_version"] = SCHEMA_VERSION
        file.attrs["quantity"] = samples.quantity
        file.attrs["mirror_azimuth_deg"] = 180
        file.attrs["source"] = samples.source
        angles = (degrees(a) for a in (samples.theta_i, samples.theta_o, samples.phi_o))
        arrays = dict(zip(ANGLES, angles, strict=True)) | {"wavelength_nm": samples.wavelength_nm}
        for name, array in arrays.items():
            file.create_dataset(name, data=array, dtype="f8", track_times=False).attrs["units"] = UNITS[name]
        value = file.create_dataset("value", data=samples.value, dtype="f8", track_times=False)
        value.attrs["units"] = "1/sr" if samples.quantity == "brdf" else "relative"


def _read(path: Path, file: h5py.File) -> Table:
    """Read what an open file holds."""
    name = _attribute(path, file, "schema_name")
    if name != SCHEMA_NAME:
        raise UserError(f"{path}: schema_name: found {shorten(str(name))}, expected '{SCHEMA_NAME}'")
    version = _attribute(path, file, "schema_version")
    if not isinstance(version, int) or not 1 <= version <= SCHEMA_VERSION:
        raise UserError(f"{path}: schema_version: found {shorten(str(version))}, expected at most {SCHEMA_VERSION}")
    quantity = _attribute(path, file, "quantity") if "quantity" in file.attrs else None
    if quantity is not None and quantity not in QUANTITIES:
        raise UserError(f"{path}: quantity: found {shorten(str(quantity))}, expected {' or '.join(QUANTITIES)}")
    mirror = _attribute(path, file, "mirror_azimuth_deg") if "mirror_azimuth_deg" in file.attrs else 180
    if mirror not in (0, 180):
        raise UserError(f"{path}: mirror_azimuth_deg: found {shorten(str(mirror))}, expected 180 or 0")

    dataset = {key: _dataset(path, file, key) for key in (*ANGLES, "wavelength_nm", "value")}
    samples, wavelengths = dataset["theta_i_deg"].shape[0], dataset["wavelength_nm"].shape[0]
    for key, found in dataset.items():
        expected = {"value": (samples, wavelengths), "wavelength_nm": (wavelengths,)}.get(key, (samples,))
        if found.shape != expected:
            raise UserError(f"{path}: {key}: found shape {found.shape}, expected {expected}")
    array = {key: np.asarray(found[()], float) for key, found in dataset.items()}
    return Table(
        path=str(path),
        source_format="hdf5",
        angle_unit="deg",
        theta_i=array["theta_i_deg"],
        theta_o=array["theta_o_deg"],
        phi_o=array["phi_o_deg"],
        wavelength_nm=array["wavelength_nm"],
        value=array["value"],
        line=None,
        quantity=quantity,
        mirror_azimuth_deg=int(mirror),
    )


def _attribute(path: Path, file: h5py.File, name: str) -> Any:
    """Return a small scalar attribute as a plain Python value."""
    if name not in file.attrs:
        raise UserError(f"{path}: found no attribute {name}, expected one")
    stored = h5py.h5a.open(file.id, name.encode())
    if stored.shape != () or stored.get_storage_size() > MAX_ATTRIBUTE_BYTES:
        raise UserError(f"{path}: attribute {name}: found an array or a long text, expected one word or number")
    value = file.attrs[name]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value.item() if isinstance(value, np.generic) else value


def _dataset(path: Path, file: h5py.File, key: str) -> h5py.Dataset:
    """Return a dataset that may be read: plain numbers, in this file, no larger than the file can hold."""
    if key not in file:
        raise UserError(f"{path}: found no dataset {key}, expected one")
    dataset = file[key] if isinstance(file.get(key, getlink=True), h5py.HardLink) else None
    if not isinstance(dataset, h5py.Dataset):
        raise UserError(f"{path}: {key}: found a link or a group, expected a dataset")
    if dataset.is_virtual or dataset.external:
        raise UserError(f"{path}: {key}: found data of another file, expected them in this one")
    if dataset.dtype.kind not in "fiu" or dataset.dtype.subdtype is not None:
        raise UserError(f"{path}: {key}: found type {shorten(str(dataset.dtype))}, expected numbers")
    axes = 2 if key == "value" else 1
    if dataset.ndim != axes:
        raise UserError(f"{path}: {key}: found {dataset.ndim} axes, expected {axes}")
    limit = min(MAX_NUMBERS, 1024 + MAX_EXPANSION * path.stat().st_size)
    for what, shape in (("shape", dataset.shape), ("chunks", dataset.chunks or ())):
        if np.prod(shape, dtype=float) > limit:
            raise UserError(f"{path}: {key}: found {what} {shape}, expected at most {limit} numbers in such a file")
    return dataset


def _damaged(path: Path, error: BaseException) -> UserError:
    """Say in a line what h5py found."""
    return UserError(f"{path}: found damaged HDF5 ({shorten(' '.join(str(error).split()))}), expected a whole file")
