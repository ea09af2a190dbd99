"""Reading and writing measurements: one file per outside format; what a file is shows in its content, not its name."""

import hashlib
from pathlib import Path

from sbrdf_jax import builtin
from sbrdf_jax.errors import UserError
from sbrdf_jax.files import whole_file
from sbrdf_jax.formats.long_csv import ANGLE_COLUMNS, read_csv, write_csv
from sbrdf_jax.formats.nist import HEADER, read_nist
from sbrdf_jax.formats.pbrt import read_pbrt
from sbrdf_jax.formats.raw_hdf5 import read_hdf5, schema_name, write_hdf5
from sbrdf_jax.formats.table import MAX_FILE_BYTES, Table, to_samples
from sbrdf_jax.formats.text import is_number, shorten
from sbrdf_jax.options import InputOptions
from sbrdf_jax.records import RawSamples

READERS = {"pbrt": read_pbrt, "csv": read_csv, "hdf5": read_hdf5, "nist": read_nist}
NOT_YET = ("rgl-bsdf", "merl", "astm", "pab", "inplane", "alta")
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
MERL_MAGIC = b"\x5a\0\0\0\x5a\0\0\0\xb4\0\0\0"  # the dimensions 90, 90, 180
HEAD_BYTES = 2**16  # what detection looks at


def read(path: str | Path, options: InputOptions, *, base: Path | None = None) -> RawSamples:
    """Read a measurement: all rows in file order, as BRDF, in the project's azimuth convention.

    Args:
        path: A file, or builtin:NAME for an embedded sample.
        options: Format, quantity, scale and azimuth as the config states them; its `path` is not used.
        base: Folder that a relative path starts from; the working directory if None.

    Returns:
        The samples; non-finite rows and rows below the horizon are still among them.

    Raises:
        UserError: the file is missing, damaged, of no known format, or not what its format or `options` say.
    """
    if str(path).startswith(builtin.PREFIX):
        measured = builtin.measure(str(path))
        table = Table(
            path=str(path),
            source_format="builtin",
            angle_unit="rad",
            theta_i=measured.theta_i,
            theta_o=measured.theta_o,
            phi_o=measured.phi_o,
            wavelength_nm=measured.wavelength_nm,
            value=measured.value,
            line=None,
            quantity=measured.quantity,
            mirror_azimuth_deg=180,
            notes=measured.notes,
        )
        return to_samples(table, options, measured.source_sha256)
    file = Path(path).expanduser()
    file = file if base is None or file.is_absolute() else base / file
    _check_file(file)
    try:
        name = detect(file) if options.format == "auto" else options.format
        if name in NOT_YET:
            raise UserError(f"{file}: format {name}: not available yet, expected one of {', '.join(READERS)}")
        if name not in READERS:
            raise UserError(f"{file}: found format {name!r}, expected one of {', '.join(READERS)}")
        table = READERS[name](file)
        with open(file, "rb") as stream:
            sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise UserError(f"{file}: cannot be read: {error.strerror or error}") from error
    return to_samples(table, options, sha256)


def write_samples(path: str | Path, samples: RawSamples) -> None:
    """Write samples as a raw file that `read` takes: `.csv`, or `.h5` / `.hdf5`; whole or not at all.

    Raises:
        UserError: another ending, or a file that cannot be written.
    """
    path = check_writable_name(path)
    with whole_file(path) as temporary:
        if path.suffix == ".csv":
            with open(temporary, "w", encoding="utf-8", newline="\n") as file:
                write_csv(file, samples)
        else:
            write_hdf5(temporary, samples)


def check_writable_name(path: str | Path) -> Path:
    """Return a path that `write_samples` can write by its ending.

    Raises:
        UserError: another ending.
    """
    path = Path(path)
    if path.suffix not in (".csv", ".h5", ".hdf5"):
        raise UserError(f"{path}: found the ending {path.suffix!r}, expected .csv, .h5 or .hdf5")
    return path


def is_result(path: Path) -> bool:
    """Whether a file is a result of this project, by content; False where it cannot be read."""
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        is_hdf5 = file.read(len(HDF5_MAGIC)) == HDF5_MAGIC
    return is_hdf5 and schema_name(path) == "sbrdf-result"


def detect(path: Path) -> str:
    """Return the format of a file, a name of `input.format`, from its content.

    Raises:
        UserError: the content is a result of this project, or nothing that is known.
    """
    with open(path, "rb") as file:
        head = file.read(HEAD_BYTES)
    if is_result(path):
        raise UserError(f"{path}: found a result, expected a measurement")
    if head.startswith(HDF5_MAGIC):
        return "hdf5"
    if head.startswith(b"tensor_file\0"):
        return "rgl-bsdf"
    if head.startswith(MERL_MAGIC):
        return "merl"
    return _detect_text(path, head)


def _detect_text(path: Path, head: bytes) -> str:
    """Tell text formats apart by their header, else by their first line that is no comment."""
    lines = head.decode("utf-8-sig", "replace").splitlines()
    if any(line.startswith("VARS ") for line in lines):
        return "astm"
    if any(line.startswith(("#intheta", "#pgII")) for line in lines):
        return "pab"
    if any(line.startswith(("#DIM", "#PARAM_IN", "#ALTA")) for line in lines):
        return "alta"
    number, first = next(
        ((k, line) for k, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")), (1, "")
    )
    words = [word.strip().strip('"') for word in first.split(",")]
    if words[0] == HEADER[0] and HEADER[-1] in words:
        return "nist"
    if words[0] == "Incident_angle":
        return "inplane"
    if words[0].startswith("theta_i") or any(word in ANGLE_COLUMNS for word in words):
        return "csv"
    if len(words) == 1 and is_number((first.partition("#")[0].split() or [""])[0]):
        return "pbrt"
    raise UserError(
        f"{path}:{number}: found {shorten(first)}, expected the start of one of {', '.join(READERS)}; "
        "set input.format if it is one"
    )


def _check_file(path: Path) -> None:
    """Refuse what is no file that can be read."""
    if path.is_dir():
        raise UserError(f"{path}: found a folder, expected a file")
    if not path.exists():
        raise UserError(f"{path}: no such file, expected a measurement")
    if not path.is_file():
        raise UserError(f"{path}: found a device or pipe, expected a file")
    size = path.stat().st_size
    if size == 0:
        raise UserError(f"{path}: found an empty file, expected a measurement")
    if size > MAX_FILE_BYTES:
        raise UserError(f"{path}: found {size} bytes, expected at most {MAX_FILE_BYTES}")
