"""A command at a terminal of its own, interrupted or left: python terminal.py ACT LOG COMMAND ...

A process of its own, because a process with threads, as the tests' is, must not fork.
"""

import json
import os
import pty
import signal
import sys
import time
from pathlib import Path

SECONDS = 60


def main(act: str, log: str, command: list[str]) -> None:
    """Print the command's exit code and what it showed, as JSON; `act` is "interrupt" or "hang up"."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # whoever started the tests may ignore it
    pid, terminal = pty.fork()
    if pid == 0:
        os.execvp(command[0], command)
    deadline = time.monotonic() + SECONDS
    while not Path(log).exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    if act == "interrupt":
        os.write(terminal, b"\x03")
    else:
        os.close(terminal)
    shown = b""
    while True:
        try:
            part = os.read(terminal, 4096)
        except OSError:  # the other end, or this one, is closed
            break
        if not part:
            break
        shown += part
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    print(json.dumps({"code": code, "shown": shown.decode()}))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3:])
