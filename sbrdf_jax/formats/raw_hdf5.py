"""The project's own raw HDF5: five datasets and four attributes, sizes checked before anything is read."""

from pathlib import Path

from sbrdf_jax.errors import UserError
from sbrdf_jax.formats.isolated import read_isolated
from sbrdf_jax.formats.table import MAX_NUMBERS, QUANTITIES, Table
from sbrdf_jax.formats.text import shorten
from sbrdf_jax.hdf5 import degrees, file_in_memory
from sbrdf_jax.records import RawSamples

SCHEMA_NAME = "sbrdf-raw"
SCHEMA_VERSION = 1
ANGLES = ("theta_i_deg", "theta_o_deg", "phi_o_deg")
UNITS = {name: "deg" for name in ANGLES} | {"wavelength_nm": "nm"}
MAX_EXPANSION = 140  # float64 numbers over bytes of the file: gzip cannot reach more


def schema_name(path: Path) -> str | None:
    """Return the root attribute `schema_name` of an HDF5 file, None where it has none.

    Raises:
        UserError: the file is damaged.
    """
    found = read_isolated(path, ("schema_name",))[0]["schema_name"]
    return found if isinstance(found, str) else None


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
    quantity, mirror = _check_attributes(path)
    limit = min(MAX_NUMBERS, 1024 + MAX_EXPANSION * path.stat().st_size)
    array = read_isolated(path, (), (*ANGLES, "wavelength_nm", "value"), limit)[1]
    # a wrong axis count gives a wrong shape
    samples, wavelengths = array["theta_i_deg"].size, array["wavelength_nm"].size
    for key, found in array.items():
        expected = {"value": (samples, wavelengths), "wavelength_nm": (wavelengths,)}.get(key, (samples,))
        if found.shape != expected:
            raise UserError(f"{path}: {key}: found shape {found.shape}, expected {expected}")
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
        mirror_azimuth_deg=mirror,
    )


def write_hdf5(path: Path, samples: RawSamples) -> None:
    """Write samples as the project's raw HDF5."""
    with file_in_memory(path) as file:
        file.attrs["schema_name"] = SCHEMA_NAME
        file.attrs["schema_version"] = SCHEMA_VERSION
        file.attrs["quantity"] = samples.quantity
        file.attrs["mirror_azimuth_deg"] = 180
        file.attrs["source"] = samples.source
        angles = (degrees(a) for a in (samples.theta_i, samples.theta_o, samples.phi_o))
        arrays = dict(zip(ANGLES, angles, strict=True)) | {"wavelength_nm": samples.wavelength_nm}
        for name, array in arrays.items():
            file.create_dataset(name, data=array, dtype="f8", track_times=False).attrs["units"] = UNITS[name]
        value = file.create_dataset("value", data=samples.value, dtype="f8", fletcher32=True, track_times=False)
        value.attrs["units"] = "1/sr" if samples.quantity == "brdf" else "relative"


def _check_attributes(path: Path) -> tuple[str | None, int]:
    """Return quantity and mirror_azimuth_deg after a look at all attributes."""
    found = read_isolated(path, ("schema_name", "schema_version", "quantity", "mirror_azimuth_deg"))[0]
    if found["schema_name"] != SCHEMA_NAME:
        raise UserError(f"{path}: schema_name: found {_shown(found['schema_name'])}, expected '{SCHEMA_NAME}'")
    version = found["schema_version"]
    if not isinstance(version, int) or not 1 <= version <= SCHEMA_VERSION:
        raise UserError(f"{path}: schema_version: found {_shown(version)}, expected 1 to {SCHEMA_VERSION}")
    quantity = found["quantity"]
    if quantity is not None and quantity not in QUANTITIES:
        raise UserError(f"{path}: quantity: found {_shown(quantity)}, expected {' or '.join(QUANTITIES)}")
    mirror = 180 if found["mirror_azimuth_deg"] is None else found["mirror_azimuth_deg"]
    if mirror not in (0, 180):
        raise UserError(f"{path}: mirror_azimuth_deg: found {_shown(mirror)}, expected 180 or 0")
    return quantity, int(mirror)


def _shown(found: str | float | int | None) -> str:
    """What was found, for an error."""
    return "none" if found is None else shorten(found) if isinstance(found, str) else f"{found}"
