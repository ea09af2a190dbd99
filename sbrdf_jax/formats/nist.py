"""NIST Mueller tables (CSV): lambda [um], thetai, phi, thetar, phir [deg], f_r11 [1/sr], other Mueller elements."""

from pathlib import Path

import numpy as np

from sbrdf_jax.errors import UserError
from sbrdf_jax.formats.table import Table
from sbrdf_jax.formats.text import Numbers, numbered_lines, shorten

HEADER = ("lambda", "thetai", "phi", "thetar", "phir", "f_r11")


def read_nist(path: Path) -> Table:
    """Read the unpolarised BRDF of a Mueller table.

    A row of the result is a direction, in the order of the first wavelength of the file.

    Args:
        path: The file. thetai is stored negative and its mirror direction is at phir = 0.

    Returns:
        The table, in degrees, wavelengths in nm.

    Raises:
        UserError: a bad header, text where numbers belong, a wrong count of columns, another set of
            directions at some wavelength, or a sample that was rotated (phi other than 0).
    """
    numbers = Numbers(path)
    columns = None
    for number, text in numbered_lines(path):
        words = [word.strip() for word in text.split(",")]
        if words == [""]:
            continue
        if columns is None:
            columns = len(words)
            if tuple(words[: len(HEADER)]) != HEADER:
                raise UserError(f"{path}:{number}: header: found {shorten(text)}, expected {','.join(HEADER)},...")
            continue
        if len(words) != columns:
            raise UserError(f"{path}:{number}: found {len(words)} columns, expected {columns}, as in the header")
        numbers.append(number, words[: len(HEADER)])
    if not len(numbers):
        raise UserError(f"{path}: found no row, expected one for each direction and wavelength")
    table = numbers.value().reshape(-1, len(HEADER))
    line = numbers.line(np.arange(len(table)) * len(HEADER))

    for column, name, wrong, expected in (
        (0, "lambda", ~((table[:, 0] > 0.05) & (table[:, 0] < 100)), "micrometres"),
        (2, "phi", table[:, 2] != 0, "0: rotated samples are not read"),
    ):
        if wrong.any():
            row = int(np.argmax(wrong))
            raise UserError(f"{path}:{line[row]}: {name}: found {table[row, column]:g}, expected {expected}")

    wavelength_um, which = np.unique(table[:, 0], return_inverse=True)
    blocks = [np.flatnonzero(which == k) for k in range(len(wavelength_um))]
    first_block = blocks[which[0]]
    first = table[first_block]
    for block, micrometres in zip(blocks, wavelength_um, strict=True):
        if len(block) != len(first):
            raise UserError(
                f"{path}:{line[block[-1]]}: lambda {micrometres:g}: found {len(block)} directions, "
                f"expected {len(first)}, as at {table[0, 0]:g}"
            )
        other = np.any(table[block, 1:5] != first[:, 1:5], axis=1)
        if other.any():
            row = block[int(np.argmax(other))]
            at = f"{path}:{line[row]}: lambda {micrometres:g}"
            raise UserError(f"{at}: found another direction than at lambda {table[0, 0]:g}, expected the same")
    return Table(
        path=str(path),
        source_format="nist",
        angle_unit="deg",
        theta_i=np.abs(first[:, 1]),
        theta_o=first[:, 3],
        phi_o=first[:, 4],
        wavelength_nm=wavelength_um * 1000,
        value=np.stack([table[block, 5] for block in blocks], axis=1),
        line=line[first_block],
        quantity="brdf",
        mirror_azimuth_deg=0,
        notes=("f_r11 of the Mueller matrix: the unpolarised BRDF",),
    )
