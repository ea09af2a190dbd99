"""`index.h5` of a library: a table of its materials, and all results as one, stacked by virtual datasets.

It also spares the next batch from reading what has not changed since: of each file it holds
size, time and what was found in it. It is made from the results at any time, and may be deleted.
"""

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sbrdf_jax.batch.library import RESERVED_NAME, Material
from sbrdf_jax.batch.locks import hold
from sbrdf_jax.batch.memory import Checked, Memory, Seen
from sbrdf_jax.batch.states import Outcome, State
from sbrdf_jax.files import whole_file
from sbrdf_jax.hdf5 import dataset_of, group_of

INDEX = f"{RESERVED_NAME}.h5"
SCHEMA_NAME = "sbrdf-library-index"
SCHEMA_VERSION = 1
TEXT = h5py.string_dtype()
FILE_COLUMNS = ("path", "size", "time_ns")


def write_index(folder: Path, materials: Sequence[Material], outcomes: Sequence[Outcome], memory: Memory) -> None:
    """Write the index of a library, from what is known of its results.

    Args:
        folder: Of the results.
        materials: All of the library.
        outcomes: Where each stands.
        memory: What was found in their files.

    Raises:
        UserError: It cannot be written.
    """
    while True:
        with hold(folder, INDEX) as held:
            if held:
                with whole_file(folder / INDEX) as temporary, h5py.File(temporary, "w") as file:
                    _write(file, materials, outcomes, memory)
                return
        time.sleep(0.1)  # another batch writes its own


def read_memory(folder: Path) -> Memory:
    """Read what an index remembers of files; nothing where there is none, or one that cannot be read."""
    memory = Memory()
    try:
        with h5py.File(folder / INDEX, "r") as file:
            if file.attrs["schema_version"] != SCHEMA_VERSION:
                return memory
            layouts = [text.decode() for text in dataset_of(file, "files/layouts")[()]]
            for row in _read_table(group_of(file, "files/results")):
                path, size, time_ns, layout = (row.pop(name) for name in (*FILE_COLUMNS, "layout"))
                memory.results[path] = Seen(size, time_ns, Checked(**row, layout=layouts[layout]))
            for row in _read_table(group_of(file, "files/sources")):
                memory.sources[row["path"]] = Seen(row["size"], row["time_ns"], row["sha256"])
    except (OSError, KeyError, ValueError, TypeError, IndexError):
        return Memory()  # it is made anew from the results
    return memory


def _write(file: h5py.File, materials: Sequence[Material], outcomes: Sequence[Outcome], memory: Memory) -> None:
    file.attrs["schema_name"], file.attrs["schema_version"] = SCHEMA_NAME, SCHEMA_VERSION
    columns = ("name", "state", "reason", "failed_lanes", "seconds", "compile_seconds", "cpu_seconds", "worst_error")
    _write_table(
        file.create_group("materials"),
        {column: [str(o.state) if column == "state" else getattr(o, column) for o in outcomes] for column in columns},
    )
    done = [material for material, outcome in zip(materials, outcomes, strict=True) if outcome.state is State.DONE]
    results = {str(material.result): memory.results[str(material.result)] for material in done}
    layouts = sorted({seen.value.layout for seen in results.values()})
    number = {layout: index for index, layout in enumerate(layouts)}
    files = file.create_group("files")
    files["layouts"] = np.asarray(layouts, dtype=TEXT)
    found = {name: [getattr(seen.value, name) for seen in results.values()] for name in Checked._fields}
    found["layout"] = [number[layout] for layout in found["layout"]]
    _write_table(files.create_group("results"), _file_columns(results) | found)
    paths = {material.options.input.path for material in materials}
    sources = {path: seen for path, seen in memory.sources.items() if path in paths}
    sha256 = {"sha256": [seen.value for seen in sources.values()]}
    _write_table(files.create_group("sources"), _file_columns(sources) | sha256)
    _stack(file.create_group("stacks"), done, [seen.value.layout for seen in results.values()])


def _stack(group: h5py.Group, materials: Sequence[Material], layouts: Sequence[str]) -> None:
    """Stack the results of one shape of grid: a virtual dataset for each dataset that all of them have alike."""
    known = {layout: json.loads(layout) for layout in set(layouts)}
    stacks: dict[str, list[tuple[Material, str]]] = {}
    for material, layout in zip(materials, layouts, strict=True):
        stacks.setdefault(str(known[layout].get("grid/brdf")), []).append((material, layout))
    for number, members in enumerate(stacks.values()):
        stack = group.create_group(str(number))
        stack["name"] = np.asarray([material.name for material, _ in members], dtype=TEXT)
        first, *others = (known[layout] for layout in {layout for _, layout in members})
        for name, (shape, dtype) in first.items():
            if all(other.get(name) == [shape, dtype] for other in others):
                virtual = h5py.VirtualLayout((len(members), *shape), dtype)
                for index, (material, _) in enumerate(members):
                    virtual[index] = h5py.VirtualSource(material.result.name, name, tuple(shape), dtype)
                is_float = np.dtype(dtype).kind == "f"
                stack.create_virtual_dataset(name, virtual, fillvalue=np.nan if is_float else None)


def _file_columns(files: Mapping[str, Seen]) -> dict[str, list]:
    columns = (list(files), [seen.size for seen in files.values()], [seen.time_ns for seen in files.values()])
    return dict(zip(FILE_COLUMNS, columns, strict=True))


def _write_table(group: h5py.Group, columns: Mapping[str, list]) -> None:
    """Write columns of text, whole numbers or numbers."""
    for name, values in columns.items():
        if values:
            group[name] = np.asarray(values, dtype=TEXT if isinstance(values[0], str) else None)


def _read_table(group: h5py.Group) -> list[dict[str, Any]]:
    """Read the rows of a table."""
    columns = {name: dataset_of(group, name)[()].tolist() for name in map(str, group)}
    texts = {name: [v.decode() if isinstance(v, bytes) else v for v in values] for name, values in columns.items()}
    return [dict(zip(texts, row, strict=True)) for row in zip(*texts.values(), strict=True)]
