"""A library file to materials, each with its resolved options. As strict as a config, with lines of the same form."""

import copy
import csv
import dataclasses
import glob
import json
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from sbrdf_jax.batch.options import ExecutorOptions, LibraryOptions
from sbrdf_jax.config import (
    absolute_input,
    apply_override,
    make_absolute,
    options_of,
    parse_file,
    parse_override,
    parse_value,
    read_text,
    read_tree,
    resolve,
)
from sbrdf_jax.errors import UserError
from sbrdf_jax.option_checks import check_record
from sbrdf_jax.options import RunOptions
from sbrdf_jax.yaml_tree import Tree, graft

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._+-]{0,99}")
RESERVED_NAME = "index"  # index.h5 opens all results as one
TABLE_COLUMNS = ["name", "input"]
LIBRARY_KEYS = tuple(field.name for field in dataclasses.fields(LibraryOptions))


@dataclasses.dataclass(frozen=True)
class Material:
    """One material, as it is to be computed."""

    name: str
    options: RunOptions  # resolved; output.path is the result

    @property
    def result(self) -> Path:
        """The result file."""
        return Path(self.options.output.path)


@dataclasses.dataclass(frozen=True)
class Library:
    """A library file, read."""

    path: Path
    folder: Path  # of the results
    executor: ExecutorOptions
    materials: tuple[Material, ...]


class Override(NamedTuple):
    """A key of a material and its value in YAML."""

    place: str  # beginning of a message about it
    key: str
    value: str


class Entry(NamedTuple):
    """One material as it is written: in the list, in a row of a table, or as a file that a glob found."""

    place: str
    name: str
    input: str
    overrides: tuple[Override, ...] = ()


def load_library(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> Library:
    """Load a library file.

    Args:
        path: The YAML file.
        overrides: `key.path=value` each: of the library's own keys, or of the config of every material.

    Returns:
        The library with every material's options resolved. Inputs are relative to the library file,
        `output_folder` to the working directory.

    Raises:
        UserError: The library file, its base, its table or an override is wrong.
    """
    path = Path(path)
    tree = parse_file(
        read_text(path, "a YAML library file"), os.fspath(path), "a library, the keys base, materials, output_folder"
    )
    check_record(tree, LibraryOptions)
    for_configs = []
    for override in overrides:
        key, part = parse_override(override)
        if key[0] in LIBRARY_KEYS:
            graft(tree, key, part)
            check_record(tree, LibraryOptions)
        else:
            for_configs.append(override)
    options = check_record(tree, LibraryOptions)
    folder = Path(os.path.expanduser(options.output_folder))
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{tree.values[('output_folder',)]}: found {str(folder)!r}, a file; expected a folder")
    entries = list(_entries(options, tree, path.parent))
    _check_names(entries)
    base = read_tree(path.parent / os.path.expanduser(options.base))
    materials = tuple(_materials(entries, base, path.parent, for_configs, folder))
    return Library(path, folder, options.executor, materials)


def take_shard(materials: Sequence[Material], number: int, count: int) -> tuple[Material, ...]:
    """Return part `number`, from 1, of `count` nearly equal parts of neighbours."""
    total = len(materials)
    return tuple(materials[total * (number - 1) // count : total * number // count])


def _entries(options: LibraryOptions, tree: Tree, folder: Path) -> Iterator[Entry]:
    materials = options.materials
    if not isinstance(materials, str):
        for number, material in enumerate(materials):
            at = ("materials", number)
            yield Entry(
                place=tree.values[(*at, "name")],
                name=material.name,
                input=material.input,
                overrides=tuple(
                    Override(tree.keys[(*at, "overrides", key)], key, json.dumps(value))
                    for key, value in material.overrides.items()
                ),
            )
    elif glob.has_magic(materials):
        yield from _found(materials, folder, tree.values[("materials",)])
    else:
        yield from _rows(folder / os.path.expanduser(materials))


def _found(pattern: str, folder: Path, place: str) -> Iterator[Entry]:
    """Files that a glob finds, by name; each is called by its name without the ending."""
    files = sorted(glob.glob(os.path.join(folder, os.path.expanduser(pattern)), recursive=True))
    files = [file for file in files if os.path.isfile(file)]
    if not files:
        raise UserError(f"{place}: found no file that {pattern!r} fits; expected measurements, relative to {folder}")
    for file in files:
        yield Entry(f"{place}: {file}", Path(file).stem, os.path.abspath(file))


def _rows(path: Path) -> Iterator[Entry]:
    """Rows of a CSV table: name, input, then keys of the config; an empty cell leaves its key as it is."""
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            rows = csv.reader(file)
            header = next(rows, [])
            if header[:2] != TABLE_COLUMNS:
                found = ",".join(header)[:60]
                raise UserError(f"{path}:1: found {found!r}; expected the columns name,input and keys of the config")
            empty = True
            for row in rows:
                if not row:
                    continue
                place = f"{path}:{rows.line_num}"
                if len(row) != len(header):
                    raise UserError(f"{place}: found {len(row)} cells; expected {len(header)}, as in the header")
                keys = zip(header[2:], row[2:], strict=True)
                overrides = (Override(f"{place}: {key}", key, cell) for key, cell in keys if cell.strip())
                yield Entry(place, row[0].strip(), row[1].strip(), tuple(overrides))
                empty = False
            if empty:
                raise UserError(f"{path}: found no row below the header; expected materials")
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{path}: cannot be read ({reason}); expected a glob, or a CSV table of materials") from None


def _check_names(entries: Sequence[Entry]) -> None:
    """Refuse a name that cannot be a file's, or that two materials bear."""
    first: dict[str, Entry] = {}
    for entry in entries:
        if not NAME.fullmatch(entry.name) or entry.name == RESERVED_NAME:
            expected = f"letters, digits and . _ + -, at most 100, and not {RESERVED_NAME!r}"
            raise UserError(f"{entry.place}: found the name {entry.name[:100]!r}; expected {expected}")
        if not entry.input:
            raise UserError(f"{entry.place}: found no input; expected a file, or builtin:amber_glass")
        known = first.setdefault(entry.name.lower(), entry)  # one file on every file system
        if known is not entry:
            raise UserError(f"{entry.place}: found the name {entry.name!r} again, see {known.place}; expected it once")


def _materials(
    entries: Sequence[Entry], base: Tree, folder: Path, for_configs: Sequence[str], results: Path
) -> Iterator[Material]:
    """Options of each material; those that differ by their input alone are checked once."""
    known: dict[tuple[tuple[str, str], ...], RunOptions] = {}
    for entry in entries:
        source = absolute_input(entry.input, folder)
        same = tuple((override.key, override.value) for override in entry.overrides)
        if same not in known:
            known[same] = resolve(_options_of(entry, source, base, folder, for_configs))
        options = known[same]
        yield Material(
            entry.name,
            dataclasses.replace(
                options,
                input=dataclasses.replace(options.input, path=source),
                output=dataclasses.replace(options.output, path=str(results / f"{entry.name}.h5")),
            ),
        )


def _options_of(entry: Entry, source: str, base: Tree, folder: Path, for_configs: Sequence[str]) -> RunOptions:
    tree = copy.deepcopy(base)
    graft(tree, *parse_value("input.path", json.dumps(source), entry.place))
    for place, key, value in entry.overrides:
        path, part = parse_value(key, value, place)
        _refuse_places(path, part, place)
        graft(tree, path, part)
    make_absolute(tree, folder)
    for override in for_configs:
        _refuse_places(*parse_override(override), f"command line: {override}")
        apply_override(tree, override)
    return options_of(tree)


def _refuse_places(path: tuple[str | int, ...], part: Tree, place: str) -> None:
    """Refuse keys that the library itself sets for each material."""
    for block, other in (("input", "each material's input"), ("output", "output_folder and the name")):
        if path == (block, "path") or (path == (block,) and isinstance(part.data, dict) and "path" in part.data):
            raise UserError(f"{place}: found {block}.path, which is given by {other}; expected another key")
