"""A lock by name that its owner's death releases: `flock` on a small file, which goes with the lock.

The kernel releases it however its owner ends, on other nodes too where the file system
has locks at all. Results are whole or absent with or without it: a lock only keeps two
batches from computing one material twice.
"""

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

FOLDER = ".locks"
NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)


@contextlib.contextmanager
def hold(folder: Path, name: str) -> Iterator[bool]:
    """Hold the lock `name` of a folder within the block, or find it taken.

    Args:
        folder: Where the results are.
        name: Of a material, or of what else only one process does at a time.

    Yields:
        Whether it is held; True too where the file system has no locks.

    Raises:
        OSError: The folder cannot be written.
    """
    path = folder / FOLDER / name
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = _take(path)
    if descriptor is None:
        yield False
        return
    try:
        yield True
    finally:
        path.unlink(missing_ok=True)  # before the lock goes: whoever waits for this file finds it gone, and makes anew
        os.close(descriptor)


def has_locks(folder: Path) -> bool:
    """Whether the file system of a folder has locks."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        return _lock(descriptor) is not None
    finally:
        os.close(descriptor)


def is_held(folder: Path, name: str) -> bool:
    """Whether a living process holds a lock; what a dead one left is removed."""
    if not (folder / FOLDER / name).exists():
        return False
    with hold(folder, name) as held:
        return not held


def remove_dead(folder: Path) -> None:
    """Remove the lock files that dead processes left."""
    for path in list((folder / FOLDER).glob("*")):
        is_held(folder, path.name)


def _take(path: Path) -> int | None:
    """Return the descriptor of a lock file that is now locked, None where another holds it."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            if _lock(descriptor) is False:
                os.close(descriptor)
                return None
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                    return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # its last owner removed it between our opening and locking it


def _lock(descriptor: int) -> bool | None:
    """Lock an open file: True, False where another holds it, None where there are no locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno in NO_LOCKS:
            return None
        raise
    return True
