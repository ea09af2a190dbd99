"""The project's CSV: `theta_i_deg,theta_o_deg,phi_o_deg,450nm,...`, a row a direction, `#` comment lines."""

import re
from pathlib import Path
from typing import TextIO

import numpy as np

from sbrdf_jax.errors import UserError
from sbrdf_jax.formats.table import QUANTITIES, Table
from sbrdf_jax.formats.text import Numbers, ends_in_newline, numbered_lines, shorten
from sbrdf_jax.hdf5 import degrees
from sbrdf_jax.records import RawSamples

ANGLE_COLUMNS = ("theta_i_deg", "theta_o_deg", "phi_o_deg")
WAVELENGTH_COLUMN = re.compile(r"(\d+(?:\.\d+)?(?:[eE][+-]?\d+)?)\s*nm")
COMMENT = re.compile(r"#\s*(quantity|mirror_azimuth_deg|samples)\s*:\s*(.*?)\s*")


def read_csv(path: Path) -> Table:
    """Read the project's CSV.

    Without a comment `# quantity: ...` the values are BRDF [1/sr], without `# mirror_azimuth_deg: ...`
    the mirror direction is at 180 degrees; with `# samples: N`, N rows are expected.

    Args:
        path: The file.

    Returns:
        The table, in degrees.

    Raises:
        UserError: a bad header or comment, text where numbers belong, a wrong count of columns or rows.
    """
    numbers = Numbers(path)
    stated: dict[str, str] = {"quantity": "brdf", "mirror_azimuth_deg": "180"}
    wavelength_nm: list[float] = []
    number = 0
    for number, text in numbered_lines(path):
        if text.lstrip().startswith("#"):
            comment = COMMENT.fullmatch(text.strip())
            if comment:
                stated[comment[1]] = _checked(path, number, comment[1], comment[2])
            continue
        words = [word.strip() for word in text.split(",")]
        if words == [""]:
            continue
        if not wavelength_nm:
            wavelength_nm = _header(path, number, text, words)
            continue
        width = len(ANGLE_COLUMNS) + len(wavelength_nm)
        if len(words) != width:
            raise UserError(f"{path}:{number}: found {len(words)} columns, expected {width}, as in the header")
        numbers.append(number, words)
    if not wavelength_nm:
        raise UserError(f"{path}:{number}: found no header, expected {','.join(ANGLE_COLUMNS)},450nm,...")

    width = len(ANGLE_COLUMNS) + len(wavelength_nm)
    table = numbers.value().reshape(-1, width)
    if "samples" in stated and len(table) != int(stated["samples"]):
        raise UserError(f"{path}:{number}: found {len(table)} samples, expected {stated['samples']}, as a comment says")
    notes = () if ends_in_newline(path) else ("the last line does not end; is the file whole?",)
    return Table(
        path=str(path),
        source_format="csv",
        angle_unit="deg",
        theta_i=table[:, 0],
        theta_o=table[:, 1],
        phi_o=table[:, 2],
        wavelength_nm=np.array(wavelength_nm),
        value=table[:, len(ANGLE_COLUMNS) :],
        line=numbers.line(np.arange(len(table)) * width) if len(table) else None,
        quantity=stated["quantity"],
        mirror_azimuth_deg=int(stated["mirror_azimuth_deg"]),
        notes=notes,
    )


def write_csv(file: TextIO, samples: RawSamples) -> None:
    """Write samples as the project's CSV, with every digit."""
    file.write(f"# source: {' '.join(samples.source.split())}\n")
    file.write(f"# quantity: {samples.quantity}\n# mirror_azimuth_deg: 180\n# samples: {samples.num_samples}\n")
    names = [f"{float(wavelength)!r}".removesuffix(".0") + "nm" for wavelength in samples.wavelength_nm]
    file.write(",".join([*ANGLE_COLUMNS, *names]) + "\n")
    angles = degrees(np.stack([samples.theta_i, samples.theta_o, samples.phi_o], axis=1))
    for angle, value in zip(angles, samples.value, strict=True):
        file.write(",".join(map(repr, [*angle.tolist(), *value.tolist()])) + "\n")


def _header(path: Path, number: int, text: str, words: list[str]) -> list[float]:
    """Return the wavelengths [nm] that a header names."""
    words = [word.strip('"') for word in words]
    if tuple(words[: len(ANGLE_COLUMNS)]) != ANGLE_COLUMNS:
        hint = "; columns are parted by commas" if ";" in text or "\t" in text else ""
        raise UserError(
            f"{path}:{number}: header: found {shorten(text)}, expected {','.join(ANGLE_COLUMNS)},450nm,...{hint}"
        )
    matches = [WAVELENGTH_COLUMN.fullmatch(word) for word in words[len(ANGLE_COLUMNS) :]]
    for word, match in zip(words[len(ANGLE_COLUMNS) :], matches, strict=True):
        if match is None:
            raise UserError(f"{path}:{number}: header: found column {shorten(word)}, expected a wavelength as 450nm")
    if not matches:
        raise UserError(f"{path}:{number}: header: found no wavelength, expected columns as 450nm after the angles")
    return [float(match[1]) for match in matches if match]


def _checked(path: Path, number: int, key: str, found: str) -> str:
    """Return what a comment says of `key` if it can be."""
    allowed = {"quantity": QUANTITIES, "mirror_azimuth_deg": ("180", "0")}.get(key)
    if allowed is not None and found not in allowed:
        raise UserError(f"{path}:{number}: {key}: found {shorten(found)}, expected {' or '.join(allowed)}")
    if key == "samples" and not re.fullmatch(r"\d{1,12}", found):
        raise UserError(f"{path}:{number}: samples: found {shorten(found)}, expected a whole number")
    return found
