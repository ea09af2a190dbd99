"""YAML text to plain data, with the place of every key and value; and back.

The only importer of the YAML parser. Numbers, true, false and null are those of YAML 1.2
(so `1e-8` is a number and `off` is text); a date stays the text that was typed. A repeated
key, an alias of a block and a tag of any other kind are errors.
"""

import io
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import CollectionEndEvent, CollectionStartEvent
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError

from sbrdf_jax.errors import UserError

KeyPath = tuple[str | int, ...]
Place = Callable[[int, int, KeyPath], str]

_CONSTRUCTOR = YAML(typ="safe", pure=True).constructor  # used for what one scalar means, which keeps no state
_MAX_DEPTH = 20
_STANDARD = "tag:yaml.org,2002:"
_TEXT_TAGS = {"str", "timestamp"}
_NUMBER_TAGS = {"int", "float"}


@dataclass
class Tree:
    """Plain data, and what a message about a key or a value begins with, in the order of the text."""

    data: Any = None
    keys: dict[KeyPath, str] = field(default_factory=dict)
    values: dict[KeyPath, str] = field(default_factory=dict)


def dotted(path: KeyPath) -> str:
    """Write a key path for a message: grid.theta_i_step_deg, scene.theta_i_deg[1]."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            word = part if part.isprintable() and 0 < len(part) <= 60 else repr(part[:60])
            text += f".{word}" if text else word
    return text


def parse_yaml(text: str, place: Place, root: KeyPath = ()) -> Tree:
    """Parse one YAML document.

    Args:
        text: The document; an empty one is None.
        place: Of line and column (from 1) and key path, the beginning of a message.
        root: Key path at which the document stands.

    Returns:
        Data of dict, list, str, int, float, bool and None, and their places.

    Raises:
        UserError: The text is not YAML, or uses what is not supported here.
    """
    try:
        _check_depth(text, place)
        node = YAML(typ="safe", pure=True).compose(io.StringIO(text))
        tree = Tree()
        if node is not None:
            tree.data = _convert(node, root, tree, place, set())
        else:
            tree.values[root] = place(1, 1, root)
        return tree
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark is not None else (1, 1)
        reason = " ".join(str(error.problem or error.context).split())
        raise UserError(f"{place(line, column, ())}: found text that is not YAML ({reason}); expected YAML") from None
    except ReaderError as error:
        line, column = _line_and_column(text, error.position)
        reason = f"the character #x{error.character:04x}"
        raise UserError(f"{place(line, column, ())}: found {reason}, which YAML forbids; expected text") from None
    except YAMLError as error:
        raise UserError(f"{place(1, 1, ())}: found text that is not YAML ({' '.join(str(error).split())})") from None


def graft(tree: Tree, path: KeyPath, part: Tree) -> None:
    """Put a value at a key path, in place of what was there; blocks above it are made where they are missing.

    Args:
        tree: Changed.
        path: Where the value goes.
        part: The value, with its places, and those of the keys above it that may have to be made.
    """
    block = tree.data
    for number, name in enumerate(path[:-1], start=1):
        if not isinstance(block.get(name), dict):
            _forget(tree, path[:number])
            block[name] = {}
            tree.keys[path[:number]] = tree.values[path[:number]] = part.keys[path[:number]]
        block = block[name]
    _forget(tree, path)
    block[path[-1]] = part.data
    tree.keys.update({key: place for key, place in part.keys.items() if key[: len(path)] == path})
    tree.values.update(part.values)


def _forget(tree: Tree, path: KeyPath) -> None:
    """Drop the places of a value that is replaced, so that the order of places stays that of writing."""
    for places in (tree.keys, tree.values):
        for old in [old for old in places if old[: len(path)] == path]:
            del places[old]


def dump_yaml(data: Any) -> str:
    """Write plain data as YAML, keys in their order, a key a line."""
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # pyright: ignore[reportAttributeAccessIssue]
    yaml.width = 10**6  # a long path stays on its line
    stream = io.StringIO()
    yaml.dump(data, stream)
    return stream.getvalue()


def _check_depth(text: str, place: Place) -> None:
    """Refuse what is nested so deeply that the recursion of the parser itself would fail."""
    depth = 0
    for event in YAML(typ="safe", pure=True).parse(io.StringIO(text)):
        depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
        if depth > _MAX_DEPTH:
            mark = event.start_mark
            where = place(mark.line + 1, mark.column + 1, ())
            raise UserError(
                f"{where}: found lists or blocks in each other, {depth} deep; expected at most {_MAX_DEPTH}"
            )


def _convert(node: Node, path: KeyPath, tree: Tree, place: Place, seen: set[int]) -> Any:
    """Turn a node into data, noting places on the way."""
    here = place(node.start_mark.line + 1, node.start_mark.column + 1, path)
    tree.values[path] = here
    if isinstance(node, ScalarNode):
        return _scalar(node, here)
    if id(node) in seen:
        # one rule against blocks that hold themselves and against small files that unfold into huge ones
        raise UserError(f"{here}: found an alias of a block or list; expected it written out")
    seen.add(id(node))
    tag = str(node.tag).removeprefix(_STANDARD)
    if tag != ("seq" if isinstance(node, SequenceNode) else "map"):
        raise UserError(f"{here}: found the tag {str(node.tag)[:40]!r}; expected plain YAML")
    if isinstance(node, SequenceNode):
        return [_convert(item, (*path, index), tree, place, seen) for index, item in enumerate(node.value)]
    assert isinstance(node, MappingNode)
    block: dict[str, Any] = {}
    for key_node, value_node in node.value:
        line, column = key_node.start_mark.line + 1, key_node.start_mark.column + 1
        if not isinstance(key_node, ScalarNode):
            raise UserError(f"{place(line, column, path)}: found a key that is a list or block; expected a word")
        key = key_node.value
        here = place(line, column, (*path, key))
        if key in block:
            raise UserError(f"{here}: duplicate key: found it a second time; expected it once")
        tree.keys[(*path, key)] = here
        block[key] = _convert(value_node, (*path, key), tree, place, seen)
    return block


def _scalar(node: ScalarNode, here: str) -> Any:
    """Value of a scalar by its YAML 1.2 tag."""
    text = node.value
    tag = str(node.tag).removeprefix(_STANDARD)
    if tag == "null":
        return None
    if tag == "bool" and text.lower() in ("true", "false"):
        return text.lower() == "true"
    if tag in _NUMBER_TAGS:
        try:
            return _CONSTRUCTOR.construct_yaml_int(node) if tag == "int" else _CONSTRUCTOR.construct_yaml_float(node)
        except (ValueError, IndexError):  # an explicit tag on other text, or more digits than Python reads
            raise UserError(f"{here}: found {text[:40]!r}; expected a number that can be read") from None
    if tag not in _TEXT_TAGS:
        raise UserError(f"{here}: found the tag {str(node.tag)[:40]!r}; expected plain YAML")
    if "\0" in text or any("\ud800" <= character <= "\udfff" for character in text):
        raise UserError(f"{here}: found text with a character that no file name can hold; expected plain text")
    return text


def _line_and_column(text: str, position: int) -> tuple[int, int]:
    before = text[:position]
    return before.count("\n") + 1, position - (before.rfind("\n") + 1) + 1
