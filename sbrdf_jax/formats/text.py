"""Text tables line by line: every error names its line, memory stays within that of the numbers."""

import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sbrdf_jax.errors import UserError
from sbrdf_jax.formats.table import MAX_NUMBERS

MAX_LINE_BYTES = 2**24


def numbered_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield (line number from 1, text without its end) of a UTF-8 file.

    Raises:
        UserError: a line is not UTF-8 text, or too long for one.
    """
    with open(path, "rb") as file:
        for number, raw in enumerate(iter(lambda: file.readline(MAX_LINE_BYTES), b""), 1):
            if len(raw) == MAX_LINE_BYTES:
                raise UserError(f"{path}:{number}: found a line of over {MAX_LINE_BYTES - 1} bytes, expected shorter")
            try:
                text = raw.decode("utf-8-sig" if number == 1 else "utf-8")
            except UnicodeDecodeError as error:
                byte = raw[error.start]
                raise UserError(f"{path}:{number}: found byte 0x{byte:02x}, expected UTF-8 text") from None
            yield number, text.rstrip("\r\n")


def ends_in_newline(path: Path) -> bool:
    """Whether the last line is whole, as far as one can tell."""
    with open(path, "rb") as file:
        file.seek(-1, 2)
        return file.read(1) in b"\r\n"


class Numbers:
    """Numbers of a file with the line of each, appended line by line."""

    def __init__(self, path: Path):
        self._path = path
        self._value = array.array("d")
        self._end = array.array("q")  # how many numbers there are after each line that has some
        self._line = array.array("q")

    def __len__(self) -> int:
        return len(self._value)

    def append(self, number: int, words: list[str]) -> None:
        """Append the words of a line.

        Raises:
            UserError: a word is not a number, or there are more numbers than any file may have.
        """
        try:
            if "_" in "".join(words):  # Python reads 1_000 as a number, no other tool does
                raise ValueError
            self._value.extend(map(float, words))
        except ValueError:
            wrong = next(word for word in words if not is_number(word))
            raise UserError(f"{self._path}:{number}: found {shorten(wrong)}, expected a number") from None
        if len(self._value) > MAX_NUMBERS:
            raise UserError(f"{self._path}:{number}: found more than {MAX_NUMBERS} numbers, expected a smaller file")
        self._end.append(len(self._value))
        self._line.append(number)

    def value(self) -> np.ndarray:
        """All numbers in order."""
        return np.frombuffer(self._value, float) if self._value else np.empty(0)

    def line(self, index: np.ndarray) -> np.ndarray:
        """Line of the numbers at the positions `index`."""
        return np.frombuffer(self._line, np.int64)[np.searchsorted(np.frombuffer(self._end, np.int64), index, "right")]


def is_number(word: str) -> bool:
    """Whether a word is a number as this project reads it; "nan" and "inf" are."""
    if "_" in word:
        return False
    try:
        float(word)
    except ValueError:
        return False
    return True


def shorten(word: str) -> str:
    """Quote what was found, at most 40 characters of it."""
    return repr(word if len(word) <= 40 else word[:37] + "...")
