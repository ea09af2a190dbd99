"""What a file of results calls itself, and a first look at one."""

import contextlib
import os
from pathlib import Path

import h5py
import numpy as np

from sbrdf_jax.errors import UserError
from sbrdf_jax.hdf5 import attribute, check_texts, shortened

SCHEMA_NAME = "sbrdf-result"
SCHEMA_VERSION = 1
MEASURED, INTERPOLATED, BEYOND = 0, 1, 2  # `grid/extrapolated`


@contextlib.contextmanager
def open_result(path: str | os.PathLike):
    """Open a result for reading after a look at its schema.

    Raises:
        UserError: no such file, not an HDF5 file, damaged, not a result, or written by a newer version.
    """
    if not Path(path).is_file():
        raise UserError(f"{path}: no such file, expected a result of sbrdf_jax")
    if not h5py.is_hdf5(path):
        raise UserError(f"{path}: not an HDF5 file or cut off, expected a result of sbrdf_jax")
    check_texts(path)
    with h5py.File(path, "r") as file:
        found = file.attrs.get("schema_name")
        if found != SCHEMA_NAME:
            shown = shortened(repr(found))
            raise UserError(f"{path}: schema_name: found {shown}, expected {SCHEMA_NAME!r}: this is not a result")
        version = int(attribute(file, "schema_version"))
        if version > SCHEMA_VERSION:
            raise UserError(
                f"{path}: schema_version: found {version}, expected {SCHEMA_VERSION} or older: "
                "it was written by a newer sbrdf_jax"
            )
        yield file


def angles_with_data(extrapolated: np.ndarray) -> np.ndarray:
    """Mask [theta_i] of the incident angles that have data, from `extrapolated` [theta_i, theta_o, phi_o]."""
    return (extrapolated != BEYOND).any(axis=(1, 2))
