"""Directions as CSV: `theta_i_deg,theta_o_deg,phi_o_deg`."""

import math
from collections.abc import Iterator
from pathlib import Path

from sbrdf_jax.errors import UserError
from sbrdf_jax.formats.text import numbered_lines, shorten

COLUMNS = ("theta_i_deg", "theta_o_deg", "phi_o_deg")
LONGEST = 40  # characters of a number that a message shows


def read_directions(path: Path) -> tuple[list[list[str]], list[list[float]]]:
    """Read directions as written and as numbers [deg].

    Args:
        path: CSV with the header `theta_i_deg,theta_o_deg,phi_o_deg`; `#` comments and empty lines are skipped.

    Returns:
        The three columns of each row, as text and as numbers.

    Raises:
        UserError: a bad header, or a row that is no direction above the horizon; it is named by line and by row from 0.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file, expected directions as CSV")
    texts, angles, header = [], [], False
    for number, words in _rows(path):
        if not header:
            if tuple(words) != COLUMNS:
                found = shorten(",".join(words))
                raise UserError(f"{path}:{number}: header: found {found}, expected {','.join(COLUMNS)}")
            header = True
            continue
        where = f"{path}:{number}: row {len(texts)}"
        if len(words) != len(COLUMNS):
            raise UserError(f"{where}: found {len(words)} columns, expected {len(COLUMNS)}")
        angles.append([_angle(where, *pair) for pair in zip(COLUMNS, words, strict=True)])
        texts.append(words)
    if not header:
        raise UserError(f"{path}: found no header, expected {','.join(COLUMNS)}")
    return texts, angles


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:

    for number, text in numbered_lines(path):
        if text.strip() and not text.lstrip().startswith("#"):
            yield number, [word.strip() for word in text.split(",")]


def _angle(where: str, column: str, word: str) -> float:

    try:
        angle = float(word)
    except ValueError:
        raise UserError(f"{where}: {column}: found {shorten(word)}, expected a number") from None
    found = word if len(word) <= LONGEST else shorten(word)  # 400 nines are a number too
    if not math.isfinite(angle):
        raise UserError(f"{where}: {column}: found {found}, expected a finite number")
    if column != "phi_o_deg" and not 0 <= angle <= 90:
        below = ", below the horizon" if angle > 90 else ""
        raise UserError(f"{where}: {column}: found {found}{below}, expected 0 to 90")
    return angle
