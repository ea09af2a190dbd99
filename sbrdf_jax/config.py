"""A YAML config and `key.path=value` overrides to frozen option records; what autos mean; what is built.

Whatever is wrong is one `UserError`: `file:line:column: key.path: what was found; expected ...`,
or `command line: key.path=value: ...`.
"""

import dataclasses
import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from sbrdf_jax.errors import UserError
from sbrdf_jax.option_checks import check_options, describe, option_at
from sbrdf_jax.options import (
    ADDING_METHODS,
    DEFAULT_VECTORS,
    VECTOR_KINDS,
    ErrorBudget,
    OutgoingOptions,
    RunOptions,
    TargetOptions,
)
from sbrdf_jax.yaml_tree import KeyPath, Tree, dotted, dump_yaml, graft, parse_yaml

# A row goes when its method arrives: key, which values are refused, and what there is.
NOT_YET: dict[str, tuple[Callable[[Any], bool], str]] = {
    "input.format": (
        lambda value: value in ("rgl-bsdf", "merl", "astm", "pab", "inplane", "alta"),
        "auto, pbrt, csv, hdf5, nist",
    ),
}

# What auto means, by method; what is not here stays auto and is decided by the data.
AUTO_RESAMPLE: dict[str, dict[str, Any]] = {
    "paper": {"smoothness_weight": 1.0, "tolerance": 1e-8},
    "guided": {"smoothness_weight": "data", "tolerance": 1e-6},
}
AUTO_BASIS = {"paper": "fourier"}  # else data
AUTO_COEFFICIENTS = dict.fromkeys(VECTOR_KINDS, DEFAULT_VECTORS)  # else 19, as in the paper
AUTO_DEGREE = {"paper": 4}  # else 8

BUILTIN = "builtin:"

_INPUT_PATHS = (
    "input.path",
    "validate.fold_file",
    "scene.outgoing.directions",
    "scene.outgoing.mask",
    "scene.footprint",
)
_ONE_OF = ("represent.target", "scene.outgoing", "scene.error_budget")
_RANGES = ("scene.theta_i_deg", "scene.wavelength_nm")
_STEPS = (("grid.theta_i_step_deg", 90), ("grid.theta_o_step_deg", 90), ("grid.phi_o_step_deg", 180))
_MAX_BYTES = 1 << 16  # the YAML parser takes some 0.2 ms a value


def load_config(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> RunOptions:
    """Load a config file; autos stay (see `resolve`).

    Args:
        path: The YAML file.
        overrides: `key.path=value` each, the value in YAML, applied in order. A mapping replaces a whole block.

    Returns:
        The options, with `input.path` and other inputs made absolute: in the file they are
        relative to its folder, in an override to the working directory.

    Raises:
        UserError: The file or an override is wrong.
    """
    return parse_config(read_text(path), overrides, name=os.fspath(path), folder=Path(path).parent)


def parse_config(
    text: str, overrides: Sequence[str] = (), *, name: str = "config", folder: str | os.PathLike[str] = "."
) -> RunOptions:
    """Parse the text of a config: `load_config` without the file, with a name for messages and a folder."""
    tree = parse_tree(text, name=name, folder=folder)
    for override in overrides:
        apply_override(tree, override)
    return options_of(tree)


def read_tree(path: str | os.PathLike[str]) -> Tree:
    """Read a config that overrides may follow: checked, its inputs absolute, `input.path` possibly missing."""
    return parse_tree(read_text(path), name=os.fspath(path), folder=Path(path).parent)


def parse_tree(text: str, *, name: str, folder: str | os.PathLike[str]) -> Tree:
    """Parse the text of a config: `read_tree` without the file."""
    tree = parse_file(text, name, "a config, a block of keys such as input.path")
    check_options(tree, complete=False)
    make_absolute(tree, folder)
    return tree


def parse_file(text: str, name: str, expected: str) -> Tree:
    """Parse YAML that is one block of keys; places are `name:line:column: key.path`."""

    def place(line: int, column: int, path: KeyPath) -> str:
        return f"{name}:{line}:{column}" + (f": {dotted(path)}" if path else "")

    tree = parse_yaml(text, place)
    if not isinstance(tree.data, dict):
        found = "an empty file" if tree.data is None else describe(tree.data)
        raise UserError(f"{tree.values[()]}: found {found}; expected {expected}")
    return tree


def options_of(tree: Tree) -> RunOptions:
    """Check a whole config, what holds between its keys too, and return its records.

    Raises:
        UserError: The config is wrong, or asks for what is not available yet.
    """
    make_absolute(tree, ".")
    options = check_options(tree)
    assert options is not None
    for key, problem in _problems(options):
        raise UserError(f"{_place_of(tree, key)}: {problem}")
    output = dataclasses.replace(options.output, path=os.path.expanduser(options.output.path))
    return dataclasses.replace(options, output=output)


def resolve(options: RunOptions) -> RunOptions:
    """Replace every auto that does not need the data by what it stands for."""
    method = options.represent.method
    encode = _fill_autos(options.encode, {"basis": AUTO_BASIS.get(method, "data")})
    return dataclasses.replace(
        options,
        resample=_fill_autos(options.resample, AUTO_RESAMPLE[options.resample.method]),
        encode=_fill_autos(encode, {"coefficients": AUTO_COEFFICIENTS.get(encode.basis, 19)}),
        represent=_fill_autos(options.represent, {"max_degree": AUTO_DEGREE.get(method, 8)}),
    )


def resolved_yaml(options: RunOptions) -> str:
    """Write options as YAML with every key, as a result stores it; loading it gives equal options."""
    return dump_yaml(_plain(options))


def config_sha256(options: RunOptions) -> str:
    """SHA-256 of `resolved_yaml`, in hexadecimal."""
    return hashlib.sha256(resolved_yaml(options).encode()).hexdigest()


def check_output(options: RunOptions) -> None:
    """Refuse an output path that cannot be written, or that would replace a result unasked. Creates nothing.

    Raises:
        UserError: It is a folder, exists without `output.overwrite`, is the input, or its folder cannot be made.
    """
    path = Path(options.output.path)
    where = f"output.path: found {str(path)!r}"
    try:
        if path.is_dir() or options.output.path.endswith(os.sep):
            raise UserError(f"{where}, a folder; expected the name of a file")
        if path.exists():
            if not path.is_file():
                raise UserError(f"{where}, which is no regular file; expected the name of a file")
            if Path(options.input.path).exists() and path.samefile(options.input.path):
                raise UserError(f"{where}, the input itself; expected another file")
            if not options.output.overwrite:
                raise UserError(f"{where}, which exists; expected a new file, or output.overwrite=true")
        folder = path.absolute().parent
        while not folder.exists():
            folder = folder.parent
        if not folder.is_dir():
            raise UserError(f"{where}, but {str(folder)!r} is a file; expected a folder there")
        if not os.access(folder, os.W_OK | os.X_OK):
            raise UserError(f"{where}, but the folder {str(folder)!r} cannot be written; expected one that can")
    except OSError as error:
        raise UserError(f"{where}, which cannot be used ({error.strerror}); expected a file to write") from None


def read_text(path: str | os.PathLike[str], expected: str = "a YAML config") -> str:
    """Read a small text file, as UTF-8.

    Raises:
        UserError: It is missing, too large or no text.
    """
    name = os.fspath(path)
    try:
        with open(path, "rb") as file:
            raw = file.read(_MAX_BYTES + 1)
    except FileNotFoundError:
        raise UserError(f"{name}: found no such file; expected {expected}") from None
    except IsADirectoryError:
        raise UserError(f"{name}: found a folder; expected {expected}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{name}: found a file that cannot be read ({reason}); expected {expected}") from None
    if len(raw) > _MAX_BYTES:
        raise UserError(f"{name}: found more than {_MAX_BYTES} bytes; expected {expected}")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        column = error.start - (raw.rfind(b"\n", 0, error.start) + 1) + 1
        found = f"found the byte 0x{raw[error.start]:02x}, which is not UTF-8"
        raise UserError(f"{name}:{line}:{column}: {found}; expected {expected}") from None


def parse_override(text: str) -> tuple[KeyPath, Tree]:
    """Parse one `key.path=value`: the key path and the value with its places."""
    shown = "".join(c if c.isprintable() else " " for c in text)
    label = f"command line: {shown[:80]}{'...' if len(shown) > 80 else ''}"
    key, equals, value = text.partition("=")
    if not equals:
        raise UserError(f"{label}: found no =; expected key.path=value")
    return parse_value(key, value, label)


def parse_value(key: str, value: str, label: str) -> tuple[KeyPath, Tree]:
    """Parse the value, in YAML, of a dotted key; messages begin with `label`."""
    path: KeyPath = tuple(part.strip() for part in key.split("."))
    if not all(path):
        raise UserError(f"{label}: found no key; expected key.path=value")

    def place(line: int, column: int, inner: KeyPath) -> str:
        return label if inner in ((), path) else f"{label}: {dotted(inner)}"

    part = parse_yaml(value, place, path)
    part.keys[path] = label
    for number in range(1, len(path)):
        part.keys[path[:number]] = f"{label}: {dotted(path[:number])}"
    return path, part


def apply_override(tree: Tree, text: str) -> None:
    """Apply one `key.path=value`, and check it."""
    graft(tree, *parse_override(text))
    check_options(tree, complete=False)


def make_absolute(tree: Tree, folder: str | os.PathLike[str]) -> None:
    """Make the paths of inputs absolute; those that already are, and builtin names, stay."""
    for key in _INPUT_PATHS:
        *parents, last = key.split(".")
        block: Any = tree.data
        for part in parents:
            block = block.get(part) if isinstance(block, dict) else None
        value = block.get(last) if isinstance(block, dict) else None
        if isinstance(value, str) and value:
            block[last] = absolute_input(value, folder)


def absolute_input(path: str, folder: str | os.PathLike[str]) -> str:
    """Return the absolute path of an input that is relative to a folder; a builtin name stays."""
    return path if path.startswith(BUILTIN) else os.path.abspath(os.path.join(folder, os.path.expanduser(path)))


def _place_of(tree: Tree, key: str) -> str:
    """Beginning of a message about a key that was written; about keys that clash, the one written last."""
    path: KeyPath = tuple(key.split("."))
    if key in _ONE_OF + _RANGES:
        path = [other for other in tree.values if other[: len(path)] == path][-1]
    return tree.values[path]


def _problems(options: RunOptions) -> Iterator[tuple[str, str]]:
    """Find what is wrong between keys, and what is not built yet: the key and the end of the message."""
    for key, whole in _STEPS:
        step = option_at(options, key)
        if abs(whole / step - round(whole / step)) > 1e-9:
            near = min(_divisors(whole), key=lambda divisor: abs(divisor - step))
            yield key, f"found {step:g}; expected a step that divides {whole} [deg]; did you mean {near:g}?"
    encode = resolve(options).encode
    if encode.basis == "fourier" and isinstance(encode.coefficients, int) and encode.coefficients % 2 == 0:
        yield "encode.coefficients", f"found {encode.coefficients}; expected an odd number, because basis is fourier"
    if encode.basis == "log_data" and options.represent.method in ADDING_METHODS:
        method = options.represent.method
        yield "encode.basis", f"found log_data; expected another, because method {method} adds lobes and harmonics up"
    method, weight = options.resample.method, options.resample.smoothness_weight
    if method == "paper" and weight == "data":
        yield (
            "resample.smoothness_weight",
            "found data, which method paper does not have yet; expected auto or a number",
        )
    if method == "guided" and weight == 0:
        yield "resample.smoothness_weight", "found 0; expected data or a number above 0, because method is guided"
    if method == "guided" and options.input.bilateral is False:
        yield "input.bilateral", "found false; expected auto or true, because method guided folds phi_o"
    if method == "paper" and options.grid.reciprocal:
        yield "grid.reciprocal", "found true; expected false, because method paper has no tie between incident angles"
    if options.validate.folds == 1:
        yield "validate.folds", "found 1; expected 0 (off), or 2 or more"
    for key in _ONE_OF:
        block = _block_at(options, key)
        given = [] if block is None else [name for name, value in vars(block).items() if value is not None]
        if block is not None and len(given) != 1:
            names = ", ".join(vars(block))
            yield key, f"found {' and '.join(given) or 'none'}; expected {key} to have exactly one of {names}"
    for key in _RANGES:
        block = _block_at(options, key)
        if block is not None and not isinstance(block, tuple) and not block.min < block.max:
            yield key, f"found min {block.min:g} and max {block.max:g}; expected min below max"
    for key, (is_refused, available) in NOT_YET.items():
        value = option_at(options, key)
        if is_refused(value):
            yield key, f"found {describe(value)}, which is not available yet; expected what is: {available}"


def _block_at(options: RunOptions, key: str) -> Any:
    """Value of a key, None where the scene above it is null."""
    return None if key.startswith("scene.") and options.scene is None else option_at(options, key)


def _divisors(whole: int) -> list[float]:
    """Steps that divide a range and that a person would write."""
    return [whole / count for count in range(2, 10 * whole + 1) if round(whole / count, 2) == whole / count]


def _fill_autos(record: Any, meaning: dict[str, Any]) -> Any:
    return dataclasses.replace(record, **{key: new for key, new in meaning.items() if getattr(record, key) == "auto"})


def _plain(value: Any) -> Any:
    """Records and tuples as dict and list; where one of several keys is given, that one alone."""
    if dataclasses.is_dataclass(value):
        fields = {name: _plain(inner) for name, inner in vars(value).items()}
        is_one_of = isinstance(value, TargetOptions | OutgoingOptions | ErrorBudget)
        return {name: inner for name, inner in fields.items() if inner is not None} if is_one_of else fields
    return [_plain(inner) for inner in value] if isinstance(value, tuple) else value
