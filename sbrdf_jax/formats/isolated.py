"""Reading HDF5 of unknown origin in a child process, so that a damaged file costs one line and not this process.

The HDF5 library crashes or loops for ever on about one in 100 files with a few damaged bytes.
The child is started at the first file and kept; it ends with this process.
"""

import atexit
import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np

from sbrdf_jax.errors import UserError

SECONDS = 10.0  # for any file, and for each 20 MB of it as long again
BYTES_PER_SECOND = 2e6
OUTSIDE_SIGNALS = (-signal.SIGKILL, -signal.SIGTERM)  # not of the file's doing: worth a second try
WORKER = Path(__file__).with_name("hdf5_worker.py")

_lock = threading.Lock()
_worker: dict[int, subprocess.Popen] = {}  # by the process that started it: a fork must not share a pipe


def read_isolated(
    path: Path, attributes: tuple[str, ...], datasets: tuple[str, ...] = (), max_numbers: int = 0
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read root attributes and datasets of an HDF5 file, in a child process.

    Args:
        path: The file.
        attributes: Names of scalar attributes; the value is None where there is none.
        datasets: Names of datasets of plain numbers.
        max_numbers: A dataset or a chunk that declares more is refused before it is read.

    Returns:
        Attributes by name, datasets by name as float64.

    Raises:
        UserError: the file is damaged, or a name is missing, a link, no numbers or too large.
    """
    request = {
        "path": os.path.abspath(path),
        "attributes": attributes,
        "datasets": datasets,
        "max_numbers": max_numbers,
        "seconds": SECONDS + path.stat().st_size / BYTES_PER_SECOND,
    }
    with _lock:
        answer = _ask(request)
        if answer in OUTSIDE_SIGNALS:
            answer = _ask(request)
    if isinstance(answer, int):
        raise UserError(f"{path}: found damaged HDF5 (reading it crashes or does not end), expected a whole file")
    header, arrays = answer
    if "refused" in header:
        raise UserError(f"{path}: {header['refused']}")
    if "damaged" in header:
        raise UserError(f"{path}: found damaged HDF5 ({header['damaged']}), expected a whole file")
    return header["attributes"], dict(zip(datasets, arrays, strict=True))


def _ask(request: dict[str, Any]) -> tuple[dict[str, Any], list[np.ndarray]] | int:
    """Send one request and return its answer, or the exit code of the child that died of it."""
    child = _running_worker()
    assert child.stdin is not None and child.stdout is not None
    try:
        child.stdin.write(json.dumps(request).encode() + b"\n")
        child.stdin.flush()
        line = child.stdout.readline()
        if line:
            header = json.loads(line)
            return header, [_receive(child.stdout, shape) for shape in header.get("shapes", ())]
    except BrokenPipeError:
        pass  # it died before or in mid-answer: the exit code tells
    except BaseException:  # an interrupt in mid-answer: the pipe is of no use any more
        _stop(os.getpid())
        raise
    _stop(os.getpid())
    return child.returncode


def _receive(stream, shape: list[int]) -> np.ndarray:
    """Read one array from the child."""
    buffer = bytearray(8 * math.prod(shape))
    view = memoryview(buffer)
    while view:
        count = stream.readinto(view)
        if not count:
            raise BrokenPipeError
        view = view[count:]
    return np.frombuffer(buffer, "<f8").reshape(shape)


def _running_worker() -> subprocess.Popen:
    """Return this process's child, started if need be."""
    pid = os.getpid()
    if pid in _worker and _worker[pid].poll() is not None:
        _stop(pid)
    if pid not in _worker:
        # -P: the folder of this file has modules named as those of the standard library
        command = [sys.executable, "-P", str(WORKER)]
        _worker[pid] = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
    return _worker[pid]


def _stop(pid: int) -> None:
    """End the child that a process started."""
    child = _worker.pop(pid, None)
    if child is not None:
        child.kill()
        for stream in (child.stdin, child.stdout):
            with contextlib.suppress(BrokenPipeError):  # what it had no time to read
                if stream is not None:
                    stream.close()
        child.wait()


@atexit.register
def _stop_own() -> None:
    _stop(os.getpid())
