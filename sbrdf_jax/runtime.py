"""Process-wide settings of JAX, made once by the entry points and never by library modules."""

import contextlib
import ctypes
import dataclasses
import functools
import importlib
import os
import threading
from collections.abc import Iterator, Mapping
from types import MappingProxyType

CACHE_VARIABLE = "SBRDF_COMPILE_CACHE"
HELD_MEMORY = {-3: 2**25, -1: 2**27}  # bytes by glibc's M_MMAP_THRESHOLD, as large as it may be, and M_TRIM_THRESHOLD


@dataclasses.dataclass(eq=False)  # two clocks of equal seconds are two
class CompileClock:
    """Seconds spent tracing, lowering and compiling while it was on, and how many programs were compiled."""

    seconds: float = 0.0
    num_compiled: int = 0

    def _add(self, event: str, duration: float, **_details) -> None:
        if event.startswith("/jax/core/compile/"):
            self.seconds += duration
            self.num_compiled += event.endswith("backend_compile_duration")


_clocks: list[CompileClock] = []
_listening = False


@contextlib.contextmanager
def compile_clock() -> Iterator[CompileClock]:
    """Measure compilation inside the block, for the times of a stage to be told apart from it."""
    _listen()
    clock = CompileClock()
    _clocks.append(clock)
    try:
        yield clock
    finally:
        _clocks.remove(clock)


def worker_environment(threads: int, compile_cache: str | None = None) -> dict[str, str]:
    """Environment of a process that computes in so many threads; to be set before it imports NumPy, JAX or h5py.

    XLA's pool of a processor takes its size from NPROC alone, those of NumPy and SciPy from the
    others. HDF5's own file locks are off, which some cluster file systems lack: they guard files
    that are changed in place, and here files are written under another name and renamed.
    """
    names = ("NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {name: str(threads) for name in names} | {"HDF5_USE_FILE_LOCKING": "FALSE"}
    return environment | ({CACHE_VARIABLE: os.path.abspath(compile_cache)} if compile_cache else {})


def usable_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


def set_up_jax() -> None:
    """Switch on float64, and the persistent compile cache where `SBRDF_COMPILE_CACHE` names a folder.

    The cache's folder is keyed by the jaxlib version and the processor's flags, because
    compiled code of another is rejected at best.
    """
    import jax

    keep_freed_memory()
    jax.config.update("jax_enable_x64", True)
    folder = os.environ.get(CACHE_VARIABLE)
    if folder:
        jax.config.update("jax_compilation_cache_dir", os.path.join(folder, _machine_key()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def keep_freed_memory() -> None:
    """Let glibc hold what NumPy's arrays free for the next ones; without it a tenth of a run goes into page faults.

    Other C libraries are left as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for option, size in HELD_MEMORY.items():
            mallopt(option, size)


def import_ahead(*modules: str) -> None:
    """Import modules that are needed later while XLA compiles, for which it leaves the interpreter free."""
    threading.Thread(target=lambda: [importlib.import_module(name) for name in modules]).start()


def require_float64() -> None:
    """Refuse to solve in float32.

    Raises:
        UserError: float64 is off in JAX. Measured then, on amber glass and on a paint: no lane reaches its tolerance,
            and values of method "guided" end up to a third of the largest one off.
    """
    import jax

    from sbrdf_jax.errors import UserError

    if not jax.config.jax_enable_x64:
        raise UserError(
            "float64 is off in JAX, and in float32 no fit converges; "
            'call jax.config.update("jax_enable_x64", True) before anything is computed'
        )


@functools.cache
def versions() -> Mapping[str, str]:
    """Versions of what computes and stores a result."""
    import platform
    from importlib.metadata import version

    packages = ("sbrdf-jax", "jax", "jaxlib", "numpy", "scipy", "h5py", "optimistix", "jaxopt", "colour-science")
    return MappingProxyType({"python": platform.python_version()} | {name: version(name) for name in packages})


def _listen() -> None:
    global _listening
    if not _listening:
        import jax

        def forward(event: str, duration_secs: float, **details) -> None:
            for clock in _clocks:
                clock._add(event, duration_secs, **details)

        jax.monitoring.register_event_duration_secs_listener(forward)
        _listening = True


def _machine_key() -> str:
    import hashlib
    import platform
    from importlib.metadata import version
    from pathlib import Path

    cpuinfo = Path("/proc/cpuinfo")
    flags = ""
    if cpuinfo.exists():
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
        flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    digest = hashlib.sha256((platform.machine() + flags).encode()).hexdigest()[:12]
    return f"jaxlib-{version('jaxlib')}-{digest}"
