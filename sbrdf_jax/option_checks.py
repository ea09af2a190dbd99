"""Plain data to option records: every key, type and range checked, and the JSON schema.

The only importer of pydantic. It decides what is valid, from the annotations in
`options.py`; the words of a message are made here from the same annotations, because
pydantic says of a union only what each of its members missed.
"""

import dataclasses
import difflib
import functools
import sys
import types
from collections.abc import Iterator
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import annotated_types
import pydantic
import pydantic_core

from sbrdf_jax.errors import UserError
from sbrdf_jax.options import RunOptions
from sbrdf_jax.yaml_tree import KeyPath, Tree, dotted

_NO_DEFAULT = (("input",), ("input", "path"))
Record = TypeVar("Record")
WrongItem = tuple[KeyPath, bool, tuple[str | int, ...]]  # place in the data, whether it is missing, pydantic's location
_YAML_1_1 = {"yes": "true", "on": "true", "no": "false", "off": "false"}


_BOUNDS = {
    annotated_types.Gt: "above {0.gt}",
    annotated_types.Ge: "of at least {0.ge}",
    annotated_types.Lt: "below {0.lt}",
    annotated_types.Le: "at most {0.le}",
}


def check_options(tree: Tree, *, complete: bool = True) -> RunOptions | None:
    """Check a config against its option records: `check_record`, but for the one key without default.

    Args:
        tree: Data of a config and its places.
        complete: False: a key without default may be missing, and then there is no record.

    Returns:
        The record, or None where a key is missing that was allowed to be.

    Raises:
        UserError: The first unknown key, else the first value of a wrong type or range.
    """
    _check_keys(tree, RunOptions, tree.data, ())
    try:
        return _validated(RunOptions, tree)
    except pydantic.ValidationError as error:
        wrong = _wrong_items(tree, error, depth=2)
    if not complete:
        wrong = [item for item in wrong if not (item[1] and item[2] in _NO_DEFAULT)]
    if not wrong:
        return None
    path, is_missing, location = wrong[0]
    if is_missing and location in _NO_DEFAULT:
        label = tree.values[path].removesuffix(": " + dotted(path)) if path else tree.values[()]
        raise UserError(f"{label}: input.path: found nothing; expected a file, or builtin:amber_glass")
    raise _error_of(tree, RunOptions, wrong[0])


def check_record(tree: Tree, record: type[Record]) -> Record:
    """Check data against an option record, and those within it, and fill in the defaults.

    Raises:
        UserError: The first unknown key, else the first value that is missing or of a wrong type or range.
    """
    _check_keys(tree, record, tree.data, ())
    try:
        return _validated(record, tree)
    except pydantic.ValidationError as error:
        raise _error_of(tree, record, _wrong_items(tree, error, depth=1)[0]) from None


@functools.cache
def _adapter(record: type) -> pydantic.TypeAdapter:
    return pydantic.TypeAdapter(record)


def _validated(record: type, tree: Tree) -> Any:
    # Through JSON, where pydantic is strict about scalars and still takes a mapping for a record.
    return _adapter(record).validate_json(pydantic_core.to_json(tree.data, inf_nan_mode="constants"))


def _wrong_items(tree: Tree, error: pydantic.ValidationError, depth: int) -> list[WrongItem]:
    """What pydantic found, the item that says most first: of a union, `depth` keys down, every member complains."""
    wrong = [(_path_in(tree.data, item["loc"]), item["type"] == "missing", item["loc"]) for item in error.errors()]
    order = {path: number for number, path in enumerate(tree.values)}
    return sorted(wrong, key=lambda item: (order[item[0][:depth]], -len(item[2]), order[item[0]]))


def _error_of(tree: Tree, record: type, item: WrongItem) -> UserError:
    path, is_missing, location = item
    if is_missing:
        path = (*path, location[-1])
        return UserError(f"{tree.values[path[:-1]]}: found no {path[-1]!r}; expected {_expected_at(record, path)}")
    return UserError(f"{tree.values[path]}: {_wrong_value(record, path, _value_at(tree.data, path))}")


def option_at(record: Any, key: str) -> Any:
    """Value of a key, by its dotted path."""
    for part in key.split("."):
        record = getattr(record, part)
    return record


def json_schema() -> dict[str, Any]:
    """JSON schema (draft 2020-12) of a config, for editors."""
    schema = _adapter(RunOptions).json_schema()
    for block in [schema, *schema["$defs"].values()]:
        for key in block["properties"].values():
            key.pop("title", None)
            if "default" in key:
                key["default"] = _without_null(key["default"])
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **schema,
        "title": "sbrdf_jax config",
    }


def _without_null(default: Any) -> Any:
    """A default block without its null keys, of which some blocks allow one alone."""
    if isinstance(default, dict):
        return {name: _without_null(value) for name, value in default.items() if value is not None}
    return default


def suggest(found: object, names: Iterator[str] | list[str] | tuple[str, ...]) -> str:
    """The end of a message: which name was probably meant, where one is close."""
    close = difflib.get_close_matches(str(found).lower(), list(names), n=1, cutoff=0.6)
    return f"; did you mean {close[0]!r}?" if close else ""


def describe(value: object) -> str:
    """Name a value that was found, with its type, on one line."""
    if isinstance(value, dict) or dataclasses.is_dataclass(value):
        return "a block of keys"
    if isinstance(value, list):
        return "a list" if value else "an empty list"
    if value is None:
        return "nothing (null)"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"{value[:60]!r}{'...' if len(value) > 60 else ''} (text)"
    text = repr(value)
    return text if len(text) <= 60 else text[:60] + "..."


def _check_keys(tree: Tree, record: type, data: Any, path: KeyPath, root: type | None = None) -> None:
    """Refuse keys that a record, or a record within it, does not have; `root` is the record of the whole file."""
    root = root or record
    if not isinstance(data, dict):
        return
    hints = _hints(record)
    for key, value in data.items():
        here = (*path, key)
        if key not in hints:
            names = ", ".join(hints)
            raise UserError(f"{tree.keys[here]}: unknown key; expected one of {names}{_meant(key, root, hints)}")
        inner = _record_of(hints[key])
        if inner is not None:
            _check_keys(tree, inner, value, here, root)
        inner = _record_in_list(hints[key])
        if inner is not None and isinstance(value, list):
            for index, item in enumerate(value):
                _check_keys(tree, inner, item, (*here, index), root)


def _meant(key: str, root: type, hints: dict[str, Any]) -> str:
    """Suggest a key of this block, else one of this very name from elsewhere."""
    near = suggest(key, list(hints))
    if near:
        return near
    everywhere = [dotted(other) for other in _all_paths(root, ()) if other[-1] == key]
    return f"; did you mean {everywhere[0]!r}?" if everywhere else ""


def _all_paths(record: type, path: KeyPath) -> Iterator[KeyPath]:
    for key, hint in _hints(record).items():
        yield (*path, key)
        inner = _record_of(hint)
        if inner is not None:
            yield from _all_paths(inner, (*path, key))


@functools.cache
def _hints(record: type) -> dict[str, Any]:
    hints = get_type_hints(record, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(record)}


def _members(hint: Any) -> list[Any]:
    """Members of a union, the flattened ones of a nested one too."""
    if get_origin(hint) in (Union, types.UnionType):
        return [member for part in get_args(hint) for member in _members(part)]
    return [hint]


def _record_of(hint: Any) -> type | None:
    return next((member for member in _members(hint) if dataclasses.is_dataclass(member)), None)  # pyright: ignore


def _record_in_list(hint: Any) -> type | None:
    lists = (_bare(member)[0] for member in _members(hint))
    return next((_record_of(get_args(member)[0]) for member in lists if get_origin(member) is tuple), None)


def _path_in(data: Any, location: tuple[str | int, ...]) -> KeyPath:
    """Key path, as far as the data go, of pydantic's location, which also names members of unions."""
    path: KeyPath = ()
    for part in location:
        if (isinstance(data, dict) and part in data) or (isinstance(data, list) and isinstance(part, int)):
            path, data = (*path, part), data[part]  # pyright: ignore[reportArgumentType, reportCallIssue]
    return path


def _value_at(data: Any, path: KeyPath) -> Any:
    for part in path:
        data = data[part]
    return data


def _hint_at(root: type, path: KeyPath) -> Any:
    hint: Any = root
    for part in path:
        if isinstance(part, int):
            lists = (_bare(member)[0] for member in _members(hint))
            hint = next(get_args(member)[0] for member in lists if get_origin(member) is tuple)
        else:
            record = _record_of(hint)
            assert record is not None
            hint = _hints(record)[part]
    return hint


def _wrong_value(root: type, path: KeyPath, value: Any) -> str:
    hint = _hint_at(root, path)
    words = [word for member in _members(hint) if get_origin(member) is Literal for word in get_args(member)]
    meant = suggest(value, [word for word in words if isinstance(word, str)]) if isinstance(value, str) else ""
    if isinstance(value, str) and bool in _members(hint) and value.lower() in _YAML_1_1:
        meant = f"; did you mean {_YAML_1_1[value.lower()]}?"
    expected = _expected_at(root, path)
    if isinstance(value, int | float) and not abs(value) <= sys.float_info.max:
        expected = expected.replace("a number", "a finite number")
    return f"found {describe(value)}; expected {expected}{meant}"


def _expected_at(root: type, path: KeyPath) -> str:
    """What a key takes, in words, with the unit that its name says."""
    name = next(part for part in reversed(path) if isinstance(part, str))
    name = str(path[-2]) if name in ("min", "max") else name
    unit = " [deg]" if name.endswith("_deg") else " [nm]" if name.endswith("_nm") else ""
    return " or ".join(_expected(member, unit) for member in _merged(_members(_hint_at(root, path))))


def _merged(members: list[Any]) -> list[Any]:
    """Join the words of several Literals into one."""
    words = tuple(word for member in members if get_origin(member) is Literal for word in get_args(member))
    others = [member for member in members if get_origin(member) is not Literal]
    return [Literal[words], *others] if words else others


def _bare(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type without its constraints, and these."""
    return (get_args(hint)[0], get_args(hint)[1:]) if get_origin(hint) is Annotated else (hint, ())


def _expected(hint: Any, unit: str) -> str:
    bare, constraints = _bare(hint)
    if bare is type(None):
        return "null"
    if bare is bool:
        return "true or false"
    if bare is str:
        return "text that is not empty"
    if dataclasses.is_dataclass(bare):
        return "a block with the keys " + ", ".join(field.name for field in dataclasses.fields(bare))
    if get_origin(bare) is Literal:
        words = [str(word) for word in get_args(bare)]
        return words[0] if len(words) == 1 else "one of " + ", ".join(words)
    if get_origin(bare) is dict:
        return "a block of keys"
    if get_origin(bare) is tuple:
        return f"a list, each {_expected(get_args(bare)[0], unit)}"
    bounds = " and ".join(_BOUNDS[type(bound)].format(bound) for bound in constraints)
    return ("a whole number" if bare is int else "a number") + (f" {bounds}" if bounds else "") + unit
