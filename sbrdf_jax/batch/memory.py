"""Results read from end to end, sources hashed: once, for as long as the file keeps its size and time."""

import dataclasses
import functools
import hashlib
import json
import os
import re
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from sbrdf_jax.config import BUILTIN, config_sha256, parse_config
from sbrdf_jax.errors import UserError
from sbrdf_jax.hdf5 import attribute, one_line_errors
from sbrdf_jax.options import OutputOptions, RunOptions
from sbrdf_jax.schema import angles_with_data, open_result
from sbrdf_jax.status import Status

STACKED = ("grid", "spectral", "compact", "metrics")  # groups whose datasets the index stacks over materials
_PATH_LINE = re.compile(r"^  path: .*$", re.MULTILINE)  # of input and output, which `config_key` leaves out
_FAILED = (int(Status.MAX_STEPS), int(Status.NONFINITE))


class Checked(NamedTuple):
    """A result that was read from end to end."""

    config: str  # key of its config, see `config_key`
    source: str  # SHA-256
    failed_lanes: int
    seconds: float
    compile_seconds: float
    worst_error: float  # relative, of the compact form, over incident angles with data; nan where there is none
    created_utc: str
    layout: str  # JSON: shape and type of each dataset that the index stacks


class Seen(NamedTuple):
    """What was found in a file of this size and time."""

    size: int
    time_ns: int
    value: Any


@dataclasses.dataclass
class Memory:
    """What was found in files, by their paths."""

    results: dict[str, Seen] = dataclasses.field(default_factory=dict)  # of Checked
    sources: dict[str, Seen] = dataclasses.field(default_factory=dict)  # of SHA-256

    def source(self, path: str) -> str:
        """SHA-256 of a measurement.

        Raises:
            UserError: It cannot be read.
        """
        if path.startswith(BUILTIN):
            return _builtin_key(path)
        try:
            size, time_ns = _stat(path)
            known = self.sources.get(path)
            if known is None or known[:2] != (size, time_ns):
                with open(path, "rb") as file:
                    known = Seen(size, time_ns, hashlib.file_digest(file, "sha256").hexdigest())
                self.sources[path] = known
            return known.value
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror}); expected a measurement") from None

    def result(self, path: Path) -> Checked | None:
        """What stands under a result's name; None where there is no such file.

        Raises:
            UserError: It is damaged, or no result.
        """
        try:
            size, time_ns = _stat(path)
        except OSError:
            return None
        known = self.results.get(str(path))
        if known is None or known[:2] != (size, time_ns):
            known = self.results[str(path)] = Seen(size, time_ns, check_result(path))
        return known.value


def config_key(options: RunOptions) -> str:
    """SHA-256 of what decides a result, whatever file it is read from or written to.

    The source is keyed by its content, so that moving a library computes nothing anew.
    """
    source = dataclasses.replace(options.input, path="any")
    return _key_of(dataclasses.replace(options, input=source, output=OutputOptions()))


@functools.lru_cache(maxsize=1024)
def _key_of(options: RunOptions) -> str:
    return config_sha256(options)


@one_line_errors
def check_result(path: Path) -> Checked:
    """Read a result from end to end, so that checksums are verified, and say what it is of.

    Raises:
        UserError: It is damaged, or no result.
    """
    layout: dict[str, tuple[list[int], str]] = {}
    failed, seconds = 0, {"total": 0.0, "compile": 0.0}
    counted: dict[str, np.ndarray] = {}
    with open_result(path) as file:

        def visit(path: bytes) -> None:
            nonlocal failed
            item, name = h5py.h5o.open(file.id, path), path.decode()  # in half of the time of `visititems`
            if not isinstance(item, h5py.h5d.DatasetID):
                return
            value = np.empty(item.shape, item.dtype)
            item.read(h5py.h5s.ALL, h5py.h5s.ALL, value)
            group, last = name.split("/")[0], name.split("/")[-1]
            is_plain = not h5py.h5a.exists(item, b"exponent")  # else a material's numbers count in their own units
            if group in STACKED and item.dtype.kind in "biuf" and is_plain:
                layout[name] = (list(item.shape), item.dtype.str)
            if last == "status":
                failed += int(np.isin(value, _FAILED).sum())
            if name in ("metrics/relative_error", "grid/extrapolated"):
                counted[name] = value
            if group == "timing" and last in seconds:
                seconds[last] += float(value)

        h5py.h5o.visit(file.id, visit)
        return Checked(
            config=_stored_key(_PATH_LINE.sub("  path: any", str(attribute(file, "config")))),
            source=str(attribute(file, "source_sha256")),
            failed_lanes=failed,
            seconds=seconds["total"],
            compile_seconds=seconds["compile"],
            worst_error=_worst_error(**{name.split("/")[1]: value for name, value in counted.items()}),
            created_utc=str(attribute(file, "created_utc")),
            layout=json.dumps(layout),
        )


def _worst_error(relative_error: np.ndarray | None = None, extrapolated: np.ndarray | None = None) -> float:
    """Return the worst error of the incident angles with data; nan where none was measured."""
    if relative_error is None:
        return np.nan
    known = slice(None) if extrapolated is None else angles_with_data(extrapolated)
    return float(np.max(relative_error[known], initial=0.0))


@functools.lru_cache(maxsize=1024)
def _stored_key(config: str) -> str:
    """Key of a config as results store it, but for its paths; of one that this version does not read, no key at all."""
    try:
        return config_key(parse_config(config))
    except UserError:
        return ""


@functools.cache
def _builtin_key(name: str) -> str:
    from sbrdf_jax.builtin import measure

    return measure(name).source_sha256


def _stat(path: str | Path) -> tuple[int, int]:
    found = os.stat(path)
    return found.st_size, found.st_mtime_ns
