"""Ending on a signal: at once, with one line and nothing half-written left behind.

An exception raised by a signal is lost where it happens to arrive in a callback of compiled code or of the garbage
collector, so the process ends in the handler itself, after the last acts that the work under way has asked for.
"""

import contextlib
import os
import signal
from collections.abc import Callable, Iterator

INTERRUPTED, TERMINATED = 130, 143

_ENDINGS = {signal.SIGINT: (INTERRUPTED, "interrupted"), signal.SIGTERM: (TERMINATED, "terminated")}
_last_acts: list[Callable[[str], object]] = []


@contextlib.contextmanager
def before_stopping(act: Callable[[str], object]) -> Iterator[None]:
    """Call `act("interrupted" or "terminated")` if a signal ends the process within this block."""
    _last_acts.append(act)
    try:
        yield
    finally:
        _last_acts.remove(act)


def do_last_acts(word: str) -> None:
    """Do what the work under way has asked for; for whoever ends the process himself."""
    for act in reversed(_last_acts):
        with contextlib.suppress(OSError, RuntimeError):  # of a full disk, of a log line under way
            act(word)


def stop_on_signals(name: str, remark: str = "nothing was written under the output name") -> None:
    """Let SIGINT and SIGTERM end this process with 130 and 143 and one line that starts with `name`.

    Args:
        name: The command, as the user knows it.
        remark: What the line ends with.
    """

    def stop(number: int, _frame) -> None:
        code, word = _ENDINGS[signal.Signals(number)]
        do_last_acts(word)
        os.write(2, f"\r{name}: {word}; {remark}\n".encode())
        os._exit(code)

    for number in _ENDINGS:
        signal.signal(number, stop)
