"""pbrt `.brdf` text tables: n, n wavelengths [nm], then rows of theta_i, phi_i, theta_o, phi_o [rad] and n values."""

from pathlib import Path

import numpy as np

from sbrdf_jax.errors import UserError
from sbrdf_jax.formats.table import Table
from sbrdf_jax.formats.text import Numbers, ends_in_newline, numbered_lines

ANGLES = 4


def read_pbrt(path: Path) -> Table:
    """Read a pbrt table; values are BRDF [1/sr], the mirror direction lies half a turn from incidence.

    Args:
        path: The file; `#` starts a comment, rows may wrap at any white space.

    Returns:
        The table, in radians.

    Raises:
        UserError: not UTF-8, text where numbers belong, a bad count of wavelengths, or a row cut short.
    """
    numbers = Numbers(path)
    number = 0
    for number, text in numbered_lines(path):  # noqa: B007 - the last line is named by an error
        words = text.partition("#")[0].split()
        if words:
            numbers.append(number, words)
    value = numbers.value()
    if not len(value):
        raise UserError(f"{path}:{number}: found no number, expected the count of wavelengths")
    count = value[0]
    if not (count >= 1 and count == np.floor(count) and count < 1e6):
        line = numbers.line(np.array([0]))[0]
        raise UserError(f"{path}:{line}: count of wavelengths: found {count:g}, expected a whole number above 0")
    count = int(count)
    if len(value) < 1 + count:
        raise UserError(
            f"{path}:{number}: found {len(value) - 1} wavelengths, expected {count}, as the first number says"
        )
    width = ANGLES + count
    rows, rest = divmod(len(value) - 1 - count, width)
    if rest:
        raise UserError(
            f"{path}:{number}: found {rest} numbers after {rows} rows, expected {width} in a row "
            f"(4 angles, {count} values); the table is cut short or its count of wavelengths is wrong"
        )
    table = value[1 + count :].reshape(rows, width)
    notes = () if ends_in_newline(path) else ("the last line does not end; is the file whole?",)
    return Table(
        path=str(path),
        source_format="pbrt",
        angle_unit="rad",
        theta_i=table[:, 0],
        theta_o=table[:, 2],
        phi_o=table[:, 3] - table[:, 1],
        wavelength_nm=value[1 : 1 + count],
        value=table[:, ANGLES:],
        line=numbers.line(1 + count + width * np.arange(rows)),
        quantity="brdf",
        mirror_azimuth_deg=180,
        notes=notes,
    )
