"""What stands on disk for a material: a whole result of its source and config, a failure, or nothing of use."""

import dataclasses
import enum
import json
import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from sbrdf_jax.batch.library import Material
from sbrdf_jax.batch.memory import Memory, Seen, config_key
from sbrdf_jax.errors import UserError
from sbrdf_jax.files import whole_file

FAILED_FOLDER = ".failed"


class State(enum.StrEnum):
    """Where a material stands."""

    DONE = "done"
    FAILED = "failed"
    MISSING = "missing"
    OUTDATED = "outdated"  # a result of another source or config
    DAMAGED = "damaged"  # a result that cannot be read


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How one material stands, and what its computation took where this batch did it."""

    name: str
    state: State
    reason: str = ""  # of a failure, or why a result is of no use
    failed_lanes: int = 0
    seconds: float = 0.0
    compile_seconds: float = 0.0
    cpu_seconds: float = 0.0
    worst_error: float = math.nan  # relative, of the compact form, over incident angles with data
    computed: bool = False
    result: Seen | None = None  # what its process has read, so that others need not
    source: Seen | None = None


class Failure(NamedTuple):
    """How a material failed, and with which config and source."""

    key: tuple[str, str]
    reason: str


def look(material: Material, memory: Memory) -> Outcome:
    """Say where a material stands, from its files; a source is hashed only where there is something to compare."""
    reason, is_there = "", material.result.exists()
    failure = _read_failure(material)
    if not is_there and failure is None:
        return Outcome(material.name, State.MISSING)
    key = config_key(material.options)
    try:
        source = memory.source(material.options.input.path)
    except UserError as error:
        return Outcome(material.name, State.FAILED, str(error))
    state = State.MISSING
    try:
        checked = memory.result(material.result)
        if checked is not None and (checked.config, checked.source) == (key, source):
            return Outcome(
                material.name,
                State.DONE,
                failed_lanes=checked.failed_lanes,
                seconds=checked.seconds,
                compile_seconds=checked.compile_seconds,
                worst_error=checked.worst_error,
            )
        if checked is not None:
            state, reason = State.OUTDATED, f"its {'source' if checked.config == key else 'config'} has changed"
    except UserError as error:
        state, reason = State.DAMAGED, str(error)
    if failure is not None and failure.key == (key, source):
        state, reason = State.FAILED, failure.reason
    return Outcome(material.name, state, reason)


def write_failure(material: Material, reason: str, memory: Memory) -> None:
    """Note that a material failed with its present source and config."""
    try:
        source = memory.source(material.options.input.path)
    except UserError:
        source = ""  # an input that is not there is looked for again each time
    with whole_file(_failure(material)) as temporary:
        note = {"config": config_key(material.options), "source": source, "reason": reason}
        temporary.write_text(json.dumps(note), encoding="utf-8")


def remove_failure(material: Material) -> None:
    """Forget that a material failed."""
    _failure(material).unlink(missing_ok=True)


def remove_leftovers_of(material: Material) -> None:
    """Remove every temporary file of a material; its lock is held, so no living process writes one."""
    for path in (material.result, _failure(material)):
        for leftover in _temporaries(path):
            leftover.unlink(missing_ok=True)


def _temporaries(path: Path) -> Iterator[Path]:
    pattern = re.compile(rf"\.{re.escape(path.name)}\.[\w-]+\.\d+\.tmp")
    if path.parent.is_dir():
        yield from (path.parent / name for name in os.listdir(path.parent) if pattern.fullmatch(name))


def _failure(material: Material) -> Path:
    return material.result.parent / FAILED_FOLDER / f"{material.name}.json"


def _read_failure(material: Material) -> Failure | None:
    """Read how a material failed; None where it did not, or where the note is damaged: then it is tried again."""
    try:
        note = json.loads(_failure(material).read_text(encoding="utf-8"))
        return Failure((note["config"], note["source"]), str(note["reason"]))
    except (FileNotFoundError, NotADirectoryError, ValueError, KeyError, TypeError):
        return None
