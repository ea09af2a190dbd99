"""What a run is doing: one updating line on a terminal, one line per stage in the log file."""

import contextlib
import dataclasses
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

SECONDS_BETWEEN_UPDATES = 0.1
ERASE_LINE = "\r\x1b[2K"


@dataclasses.dataclass
class StageClock:
    """Seconds of one stage; `compile_seconds` is a part of `seconds`, filled in by whoever knows it."""

    name: str
    seconds: float = 0.0
    compile_seconds: float = 0.0


class Progress:
    """Progress of one run, for its stages to report to.

    On a terminal the current stage is one line that updates in place and ends as a line of its own; elsewhere each
    stage is one line when it is done. The log file gets one line per stage, and every `log` line.

    Usage:
        with Progress(log_path) as progress:
            with progress.stage("resample") as clock:
                progress.update("12 of 31 wavelengths converged")
                clock.compile_seconds = ...
    """

    def __init__(
        self,
        log_path: Path | str | None = None,
        *,
        stream: Any = None,
        quiet: bool = False,
        clock: Callable[[], float] = time.perf_counter,
    ):
        """Open the log (appending is the caller's choice of name; an existing log is replaced).

        Args:
            log_path: Log file, or None for none.
            stream: Where the lines go, with `write`, `flush` and `isatty`; standard error unless given.
            quiet: No line on the stream at all.
            clock: Seconds from any zero, for tests.

        Raises:
            OSError: The log cannot be written.
        """
        self.stages: list[StageClock] = []
        self._stream = sys.stderr if stream is None else stream
        self._quiet = quiet
        self._clock = clock
        self._start = clock()
        self._last_update = -float("inf")
        self._is_terminal = not quiet and self._stream.isatty()
        self._open: list[tuple[StageClock, float]] = []
        self._text = ""
        self._log = open(log_path, "w", encoding="utf-8") if log_path is not None else None

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_exception) -> None:
        self.close()

    def close(self) -> None:
        """Close the log; calling it twice is harmless."""
        if self._log is not None:
            self._log.close()
            self._log = None

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds per finished stage, summed over stages of one name, in the order of their first end."""
        total: dict[str, float] = {}
        for stage in self.stages:
            total[stage.name] = total.get(stage.name, 0.0) + stage.seconds
        return total

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[StageClock]:
        """Time one stage and report its end, also where it fails; stages may nest.

        Args:
            name: A word or two: "resample".

        Yields:
            The stage's clock, whose `compile_seconds` the caller may set.
        """
        clock = StageClock(name)
        begin = self._clock()
        self._open.append((clock, begin))
        self._text = ""
        self._show(force=True)
        ended = "failed"
        try:
            yield clock
            ended = "done"
        finally:
            clock.seconds = self._clock() - begin
            self._open.pop()
            self.stages.append(clock)
            self._finish(f"{name:<12} {ended:<6} {format_seconds(clock.seconds):>8}", clock)

    def update(self, text: str) -> None:
        """Say how far the current stage is: "12 of 31 wavelengths converged". Kept for the stage's last line."""
        self._text = text
        self._show()

    def log(self, line: str) -> None:
        """Write a line to the log file only."""
        if self._log is not None:
            self._log.write(f"{self._clock() - self._start:9.3f} s  {line}\n")
            self._log.flush()

    def say(self, text: str) -> None:
        """Write whole lines to the log and, unless quiet, to the stream."""
        for line in text.splitlines():
            self.log(line)
        if not self._quiet:
            self._stream.write((ERASE_LINE if self._is_terminal else "") + text + "\n")
            self._stream.flush()
        self._show(force=True)

    def _finish(self, line: str, clock: StageClock) -> None:
        if clock.compile_seconds:
            line += f" (compile {format_seconds(clock.compile_seconds)})"
        if self._text:
            line += f"  {self._text}"
        self._text = ""
        self.say(line)

    def _show(self, *, force: bool = False) -> None:
        """Redraw the terminal's line, at most every `SECONDS_BETWEEN_UPDATES`."""
        now = self._clock()
        if not self._is_terminal or not self._open or (not force and now - self._last_update < SECONDS_BETWEEN_UPDATES):
            return
        self._last_update = now
        clock, begin = self._open[-1]
        line = f"{clock.name:<12} {format_seconds(now - begin):>8}  {self._text}"
        self._stream.write(ERASE_LINE + line[:100])
        self._stream.flush()


def format_seconds(seconds: float) -> str:
    """Seconds for a reader: "0.032 s", "4.1 s", "75 s", "12 min 5 s"."""
    if seconds < 0.9995:
        return f"{seconds:.3f} s"
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    if seconds < 599.5:
        return f"{seconds:.0f} s"
    whole = round(seconds)
    return f"{whole // 60} min {whole % 60} s"
