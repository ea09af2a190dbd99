"""Child process that reads HDF5 for `isolated`: on damaged files the HDF5 library may crash or loop for ever.

Run as a script; needs nothing of this package. One request a line on standard input, JSON:
path, attributes, datasets, max_numbers, seconds. The answer is one line of JSON, then the
bytes of the arrays that it names. Values are checked before they are read: nothing is
followed out of the file, and nothing larger than the limit is allocated.
"""

import json
import math
import resource
import signal
import sys
from typing import Any

import h5py
import numpy as np

MAX_ADDRESS_SPACE = 8 * 2**30
MAX_ATTRIBUTE_BYTES = 2**12


class Refused(Exception):
    """The file is sound, but not what was asked for."""


def read_attribute(file: h5py.File, name: str) -> str | float | int | None:
    """Return a small scalar attribute; None where there is none."""
    if name not in file.attrs:
        return None
    stored = h5py.h5a.open(file.id, name.encode())
    if stored.shape != () or stored.get_storage_size() > MAX_ATTRIBUTE_BYTES:
        raise Refused(f"attribute {name}: found an array or a long text, expected one word or number")
    value: Any = file.attrs[name]
    value = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
    value = value.item() if isinstance(value, np.generic) else value
    if not isinstance(value, (str, int, float)):
        raise Refused(f"attribute {name}: found {type(value).__name__}, expected one word or number")
    return value


def read_dataset(file: h5py.File, name: str, max_numbers: int) -> np.ndarray:
    """Return a dataset that may be read: plain numbers, in this file, at most `max_numbers` of them."""
    if name not in file:
        raise Refused(f"found no dataset {name}, expected one")
    dataset = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
    if not isinstance(dataset, h5py.Dataset):
        raise Refused(f"{name}: found a link or a group, expected a dataset")
    if dataset.is_virtual or dataset.external:
        raise Refused(f"{name}: found data of another file, expected them in this one")
    if dataset.dtype.kind not in "fiu" or dataset.dtype.itemsize > 16:
        raise Refused(f"{name}: found type {str(dataset.dtype)[:40]!r}, expected numbers")
    if dataset.shape is None:
        raise Refused(f"{name}: found no data, expected numbers")
    for what, shape in (("shape", dataset.shape), ("chunks", dataset.chunks or ())):
        if math.prod(shape) > max_numbers:
            raise Refused(f"{name}: found {what} {shape}, expected at most {max_numbers} numbers in such a file")
    return np.asarray(dataset[()], "<f8", order="C")


def answer(request: dict[str, Any]) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Return the header and the arrays that answer a request."""
    try:
        with h5py.File(request["path"], "r", locking=False) as file:
            attributes = {name: read_attribute(file, name) for name in request["attributes"]}
            arrays = [read_dataset(file, name, request["max_numbers"]) for name in request["datasets"]]
    except Refused as refused:
        return {"refused": str(refused)}, []
    except Exception as error:  # whatever a damaged file makes h5py raise is told in the answer
        return {"damaged": " ".join(str(error).split())[:200]}, []
    return {"attributes": attributes, "shapes": [array.shape for array in arrays]}, arrays


def main() -> None:
    """Answer requests until standard input ends."""
    resource.setrlimit(resource.RLIMIT_AS, (MAX_ADDRESS_SPACE, MAX_ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    for line in sys.stdin.buffer:
        request = json.loads(line)
        signal.setitimer(signal.ITIMER_REAL, request["seconds"])  # ends this process, inside the library too
        header, arrays = answer(request)
        signal.setitimer(signal.ITIMER_REAL, 0)
        sys.stdout.buffer.write(json.dumps(header).encode() + b"\n")
        for array in arrays:
            sys.stdout.buffer.write(array.tobytes())
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
