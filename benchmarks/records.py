"""A record of a benchmark: run time and error together, or it is no result; and what it was measured on."""

import dataclasses
import json
import math
import os
import platform
import resource
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "optimistix", "jaxopt", "optax", "osqp", "scikit-learn")
SECONDS = ("set_up_seconds", "compile_seconds", "seconds_min", "seconds_median", "seconds_spread")
MEASURED = (*SECONDS, "peak_bytes", "error")


class Timing(NamedTuple):
    """Seconds of the first and of the warm runs, and the largest memory of the process meanwhile."""

    first: float
    warm: tuple[float, ...]
    peak_bytes: int

    @property
    def runs(self) -> tuple[float, ...]:
        """What counts as the run time: the warm runs, or the first where it is the only one."""
        return self.warm or (self.first,)


@dataclasses.dataclass(frozen=True)
class Record:
    """One point of error against time."""

    group: str  # which table it belongs to
    problem: str
    method: str
    setting: str  # tolerance, steps, size: what is swept
    size: Mapping[str, int]
    error: float  # finite
    error_kind: str
    seconds_min: float  # warm, finite
    seconds_median: float
    seconds_spread: float  # slowest less fastest
    repeats: int
    set_up_seconds: float
    compile_seconds: float
    peak_bytes: int
    precision: str = "float64"
    kkt_residual: float | None = None
    more: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        """Refuse a record without a time, an error or a memory."""
        found = {name: getattr(self, name) for name in MEASURED}
        wrong = [f"{name} {value}" for name, value in found.items() if not (math.isfinite(value) and value >= 0)]
        if wrong or not self.peak_bytes:
            what = ", ".join(wrong) or "peak_bytes 0"
            raise ValueError(f"{self.problem}, {self.method}: found {what}: all must be finite, none below 0")


def record_of(timing: Timing, *, set_up_seconds: float = 0.0, **named: Any) -> Record:
    """Make a record of a timing; `named` are the other fields of `Record`."""
    return Record(
        seconds_min=min(timing.runs),
        seconds_median=statistics.median(timing.runs),
        seconds_spread=max(timing.runs) - min(timing.runs),
        repeats=len(timing.runs),
        set_up_seconds=set_up_seconds,
        compile_seconds=max(timing.first - min(timing.runs), 0.0),
        peak_bytes=timing.peak_bytes,
        **named,
    )


def timed(work: Callable[[], Any], repeats: int) -> tuple[Any, Timing]:
    """Run once, then `repeats` times warm, each blocked on its result; 0 for code that compiles nothing."""
    import jax

    forget_peak()
    seconds = []
    result = None
    for _ in range(repeats + 1):
        start = time.perf_counter()
        result = jax.block_until_ready(work())
        seconds.append(time.perf_counter() - start)
    return result, Timing(seconds[0], tuple(seconds[1:]), peak_bytes())


def forget_peak() -> None:
    """Let the kernel measure this process' largest memory anew, where it can."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return  # then the peak is that of the process so far


def peak_bytes() -> int:
    """Largest resident memory since `forget_peak`, or of the process."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    for line in lines:
        if line.startswith("VmHWM:"):
            return 1024 * int(line.split()[1])
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def machine() -> dict[str, Any]:
    """What the records of one run share: versions, processor, device, threads, commit."""
    import jax

    return {
        "python": platform.python_version(),
        "versions": {name: found for name in PACKAGES if (found := version_of(name))},
        "cpu": _cpu(),
        "device": jax.devices()[0].device_kind,  # of JAX; "cpu" where there is no accelerator
        "threads": int(os.environ.get("NPROC", len(os.sched_getaffinity(0)))),
        "load": round(os.getloadavg()[0], 2),
        "commit": _commit(),
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def version_of(name: str) -> str | None:
    """Version of an installed package; None where it is not."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def as_line(record: Record, shared: Mapping[str, Any]) -> str:
    """A record and what its run shares as one line of JSON."""
    return json.dumps(dataclasses.asdict(record) | dict(shared), sort_keys=True)


def read_runs(path: str | Path) -> list[tuple[Record, dict[str, Any]]]:
    """Read the records of a file of JSON lines, each with what its run shares."""
    names = [field.name for field in dataclasses.fields(Record)]
    lines = [json.loads(line) for line in Path(path).read_text().splitlines()]
    return [(Record(**{name: line.pop(name) for name in names}), line) for line in lines]


def read_lines(path: str | Path) -> list[Record]:
    """Read the records of a file of JSON lines."""
    return [record for record, _ in read_runs(path)]


def _cpu() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(errors="replace").splitlines() if info.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def _commit() -> str:
    folder = Path(__file__).parent
    words = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return done.stdout.strip()
