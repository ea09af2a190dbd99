"""Files that are whole or absent: written under another name, synced, then renamed."""

import contextlib
import os
import re
import socket
from collections.abc import Iterator
from pathlib import Path

from sbrdf_jax.errors import UserError
from sbrdf_jax.stopping import before_stopping


@contextlib.contextmanager
def whole_file(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path in the same folder; on success it is synced and takes the name `path`, else it is removed.

    A kill at any moment leaves the old file or the new one under the name, never a part. What
    dead processes of this machine left beside it is removed first.

    Args:
        path: The file to write; its folder is made where it is missing.

    Yields:
        The path to write to and close.

    Raises:
        UserError: the folder or the file cannot be written, or the disk is full.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{_host()}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise UserError(f"{path}: cannot be written: it is a folder, expected a file name")
        remove_leftovers(path)
        with before_stopping(lambda _: temporary.unlink(missing_ok=True)):
            yield temporary
            _sync(temporary)
            os.replace(temporary, path)
        _sync(path.parent)
    except OSError as error:
        reason = error.strerror or str(error).splitlines()[0]
        raise UserError(f"{path}: cannot be written: {reason}") from error
    finally:
        with contextlib.suppress(OSError):  # a folder that cannot be written holds nothing of ours
            temporary.unlink(missing_ok=True)


def remove_leftovers(path: Path) -> list[Path]:
    """Remove the temporary files of `path` whose processes, on this machine, are dead; return them."""
    pattern = re.compile(rf"\.{re.escape(path.name)}\.{re.escape(_host())}\.(\d{{1,9}})\.tmp")
    removed = []
    for name in os.listdir(path.parent):
        match = pattern.fullmatch(name)
        if match and not _is_alive(int(match[1])):
            leftover = path.parent / name
            leftover.unlink(missing_ok=True)
            removed.append(leftover)
    return removed


def _host() -> str:
    return re.sub(r"[^\w-]", "_", socket.gethostname())


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # it lives, and is another user's
        return True
    return True


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
