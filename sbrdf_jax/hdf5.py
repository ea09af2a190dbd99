"""HDF5 as this project writes it: units, dimension scales, chunks, no time stamps; and a wary reader of it."""

import contextlib
import functools
import json
import mmap
import os
import struct
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sbrdf_jax.errors import UserError

CHUNKED_FROM = 2  # dimensions
GROWTH = 2**22  # bytes; a file in memory grows by so much
LARGEST_COMPACT = 2**15  # bytes; datasets up to it lie in their own header, whose checksum covers them
LONGEST_PLAIN = 64  # bytes; what is shorter gains nothing by compression
FORMAT = ("v110", "v110")  # of HDF5: the oldest whose every header has a checksum, so that damage is told, not followed
LONGEST_REASON = 200  # characters of an error that quotes a file
TEXTS = b"GCOL\x01\0\0\0"  # begins a heap of texts: magic, version, 3 bytes of nothing; then its size, and objects
OBJECT = struct.Struct("<HHIQ")  # index, references, nothing, size; then its bytes, filled up to a multiple of 8
MOST_EXPANSION = 1000  # a dataset may declare at most this many times what it holds, or the file is refused


@contextlib.contextmanager
def file_in_memory(path: Path) -> Iterator[h5py.File]:
    """Yield an empty HDF5 file; what is written to it reaches the disk at the end, in one piece.

    On a full disk the HDF5 library fails again at every later call, that of the interpreter's end included; here
    Python writes the file, and fails once.

    Raises:
        OSError: the file cannot be written.
    """
    options: dict[str, Any] = {"driver": "core", "backing_store": False, "block_size": GROWTH, "libver": FORMAT}
    with h5py.File(path, "w", **options) as file:
        yield file
        file.flush()
        image = file.id.get_file_image()
    path.write_bytes(image)


def degrees(angle) -> np.ndarray:
    """Radians to degrees, without the rounding that makes 22.500000000000004 of 22.5."""
    exact = np.rad2deg(np.asarray(angle, float))
    short = np.round(exact, 9)
    return np.where(np.isclose(exact, short, rtol=4e-16, atol=1e-15), short, exact)


def dataset(
    group: h5py.Group,
    name: str,
    value,
    units: str,
    axes: list[h5py.Dataset],
    *,
    chunks: tuple[int, ...] | None = None,
    narrow: bool = False,
) -> h5py.Dataset:
    """Write one dataset with units and a dimension scale on each axis.

    Where it has more than one axis, its chunks have the shape `chunks`, or unless given that of an entry of the first
    axis. A checksum covers every one, whatever its size: a flipped bit is an error, never another number. Floats are
    written in float64; or, if `narrow`, as they are given, and whatever is not very short is compressed.
    """
    value = np.asarray(value)
    if value.dtype.kind == "f" and not narrow:
        value = value.astype(np.float64)
    options: dict[str, Any] = {"track_times": False}  # equal input, equal bytes
    if narrow and value.nbytes > LONGEST_PLAIN:
        options |= {"chunks": value.shape, "shuffle": True, "compression": "gzip", "compression_opts": 9}
        options |= {"fletcher32": True}
    elif value.ndim >= CHUNKED_FROM and value.size:
        options |= {"chunks": chunks or (1, *value.shape[1:]), "fletcher32": True}
    elif value.nbytes <= LARGEST_COMPACT:
        options["dcpl"] = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        options["dcpl"].set_layout(h5py.h5d.COMPACT)
    else:
        options |= {"chunks": True, "fletcher32": True}
    written = group.create_dataset(name, data=value, dtype=value.dtype, **options)
    written.attrs["units"] = units
    for dimension, axis in enumerate(axes):
        written.dims[dimension].attach_scale(axis)
        written.dims[dimension].label = str(axis.name).rsplit("/", 1)[-1]
    return written


def scale(group: h5py.Group, name: str, value, units: str, *, narrow: bool = False) -> h5py.Dataset:
    """Write an axis as a dimension scale; `narrow` as for `dataset`."""
    written = dataset(group, name, value, units, [], narrow=narrow)
    written.make_scale(name)
    return written


def write_mapping(group: h5py.Group, mapping: Mapping[str, Any], units: str) -> None:
    """Write a nested mapping: mappings as groups, arrays and numbers as datasets, the rest as JSON attributes."""
    for name, value in mapping.items():
        if isinstance(value, Mapping):
            write_mapping(group.create_group(name), value, units)
        elif isinstance(value, (np.ndarray, np.generic, int, float)) and np.asarray(value).dtype.kind in "biuf":
            write_array(group, name, value, units)
        else:
            group.attrs[name] = json.dumps(value)


def write_array(group: h5py.Group, name: str, value, units: str, *, chunks: tuple[int, ...] | None = None) -> None:
    """Write an array whose axes are numbered alone; `chunks` as for `dataset`."""
    value = np.asarray(value)
    axes = [scale(group, f"{name}_axis{k}", np.arange(n), "1") for k, n in enumerate(value.shape)]
    dataset(group, name, value, units, axes, chunks=chunks)


def group_of(group: h5py.Group, name: str) -> h5py.Group:
    """Return a group below a group; ValueError where it is something else."""
    return _item_of(group, name, h5py.Group)


def dataset_of(group: h5py.Group, name: str) -> h5py.Dataset:
    """Return a dataset below a group; ValueError where it is something else."""
    return _item_of(group, name, h5py.Dataset)


def _item_of(group: h5py.Group, name: str, kind: type) -> Any:
    found = group[name]
    if not isinstance(found, kind):
        raise ValueError(f"{group.name}/{name}: expected a {kind.__name__.lower()}")
    return found


def attribute(item: h5py.Group | h5py.Dataset, name: str) -> Any:
    """Return an attribute; text as str, a number or truth value as NumPy gives it."""
    return item.attrs[name]


def read(
    group: h5py.Group, name: str, shape: tuple[int, ...] | None = None, *, last: np.ndarray | slice | None = None
) -> np.ndarray:
    """Read one numeric dataset after a look at its kind, shape and size.

    Args:
        group: The group above it.
        name: Its name there.
        shape: What the whole dataset must have.
        last: Which entries of the last axis to read, increasing; no chunk without one of them is read.

    Raises:
        ValueError: it is no array of numbers, has another shape than its axes, or declares far more than it holds.
    """
    stored = dataset_of(group, name)
    if stored.dtype.kind not in "biuf":
        raise ValueError(f"{group.name}/{name}: expected an array of numbers")
    if shape is not None and stored.shape != shape:
        raise ValueError(f"{group.name}/{name}: found shape {stored.shape}, expected {shape}")
    if stored.nbytes > MOST_EXPANSION * stored.id.get_storage_size() + 4096:
        raise ValueError(f"{group.name}/{name}: declares {stored.nbytes} bytes, far more than it holds")
    if isinstance(last, np.ndarray):
        return _read_entries(stored, last)
    return np.asarray(stored[()] if last is None else stored[..., last])


def _read_entries(stored: h5py.Dataset, last: np.ndarray) -> np.ndarray:
    """Read entries of the last axis, each chunk once and whole: a selection of many small pieces is slow in HDF5."""
    length = stored.chunks[-1] if stored.chunks else stored.shape[-1]
    runs = np.split(last, np.flatnonzero(np.diff(last) > length) + 1)  # no two share a chunk, none spans one in vain
    return np.concatenate([stored[..., run[0] : run[-1] + 1][..., run - run[0]] for run in runs], axis=-1)


def read_datasets(group: h5py.Group) -> dict[str, np.ndarray]:
    """Read all datasets below a group, by their paths, but for the group's own axes."""
    found: dict[str, np.ndarray] = {}

    def visit(name, item):
        if isinstance(item, h5py.Dataset) and not item.is_scale:
            found[name] = read(group, name)

    group.visititems(visit)
    return found


def read_mapping(group: h5py.Group, without: Collection[str] = ()) -> dict[str, Any]:
    """Read what `write_mapping` wrote, but for some names."""
    found: dict[str, Any] = {name: json.loads(attribute(group, name)) for name in group.attrs}
    for name, item in group.items():
        if isinstance(item, h5py.Group):
            found[name] = read_mapping(item)
        elif name not in without and not item.is_scale:
            value = read(group, name)
            found[name] = value if value.ndim else value[()].item()
    return found


def one_line_errors(read):
    """Turn whatever a damaged file makes h5py or NumPy raise into one line that names the file."""

    @functools.wraps(read)
    def wrapped(path, *args, **kwargs):
        try:
            return read(path, *args, **kwargs)
        except (OSError, LookupError, ValueError, TypeError, AttributeError, RuntimeError, ArithmeticError) as error:
            reason = shortened(" ".join(str(error).split()))
            raise UserError(f"{path}: the result cannot be read, it is damaged: {reason}") from error

    return wrapped


@one_line_errors
def check_texts(path: str | os.PathLike) -> None:
    """Look whether the heaps of texts of an HDF5 file are whole: no checksum covers them, and the library may loop.

    Raises:
        UserError: One is damaged: its objects do not end where it ends.
    """
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as whole:
        start = whole.find(TEXTS)
        while start >= 0:
            _check_heap(whole, start)
            start = whole.find(TEXTS, start + len(TEXTS))


def _check_heap(whole: mmap.mmap, start: int) -> None:
    place = start + len(TEXTS)
    end = start + int.from_bytes(whole[place : place + 8], "little")
    place += 8
    while end - place >= OBJECT.size and end <= len(whole):
        index, _, _, size = OBJECT.unpack_from(whole, place)
        place += size if index == 0 else OBJECT.size + size + -size % 8  # 0: what is free, itself included
        if index == 0:
            break
    if end > len(whole) or not end - OBJECT.size < place <= end:
        raise ValueError(f"the texts at byte {start} do not end where they should")


def shortened(text: str) -> str:
    """Return the first part of a long text: what a damaged file says of itself may have any length."""
    return text if len(text) <= LONGEST_REASON else text[: LONGEST_REASON - 3] + "..."
