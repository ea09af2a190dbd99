"""The local executor: worker processes of this machine, each with its own share of the threads.

One that dies is replaced, and its material is tried again after the others. Materials whose
measurements look alike stay on one worker, so that nothing compiles twice without need.
"""

import contextlib
import dataclasses
import multiprocessing
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from multiprocessing import connection
from typing import Any, Protocol, runtime_checkable

from sbrdf_jax.batch.attempt import give_up
from sbrdf_jax.batch.library import Material
from sbrdf_jax.batch.memory import Memory, config_key
from sbrdf_jax.batch.states import Outcome
from sbrdf_jax.batch.worker import Work, serve
from sbrdf_jax.config import BUILTIN

WORTH_COMPILING = 4  # materials left of a group for another worker to compile their code too
SECONDS_BETWEEN_TRIES = 1.0  # of a material that another batch is at
MOST_FAILED_STARTS = 3
HDF5_MAGIC = b"\x89HDF"
Group = deque[Material]


@runtime_checkable
class Watcher(Protocol):
    """What an executor reports to."""

    def started(self, name: str) -> None:
        """A worker has begun with a material."""

    def ended(self, outcome: Outcome) -> None:
        """A material has come to its result or its failure."""


@dataclasses.dataclass(eq=False)
class _Worker:
    process: Any
    connection: connection.Connection
    group: Group = dataclasses.field(default_factory=deque)  # that it stays with
    material: Material | None = None  # that it is at
    ready: bool = False


class Queue:
    """Materials that wait, in groups that look alike."""

    def __init__(self, materials: Sequence[Material], likeness: Callable[[Material], object]):
        groups: dict[object, Group] = {}
        for material in materials:
            groups.setdefault(likeness(material), deque()).append(material)
        self._groups = sorted(groups.values(), key=len, reverse=True)
        self._again: deque[tuple[float, Material]] = deque()  # not before this time

    def take(
        self, group: deque[Material], others: Sequence[deque[Material]]
    ) -> tuple[Material, deque[Material]] | None:
        """Return the next material for a worker, and the group it then stays with; None: nothing for it now.

        Args:
            group: That it stays with.
            others: Groups that other workers stay with.
        """
        if not group:
            waiting = [other for other in self._groups if other]
            free = [other for other in waiting if not any(other is taken for taken in others)]
            shared = [other for other in waiting if len(other) >= WORTH_COMPILING]
            group = max(free or shared, key=len, default=deque())
        if group:
            return group.popleft(), group
        if self._again and self._again[0][0] <= time.monotonic():
            return self._again.popleft()[1], group
        return None

    def put_back(self, material: Material, seconds: float = 0.0) -> None:
        """Let a material wait for what else there is, and for some seconds."""
        self._again.append((time.monotonic() + seconds, material))

    def __len__(self) -> int:
        return sum(map(len, self._groups)) + len(self._again)


def run_local(materials: Sequence[Material], work: Work, workers: int, tries: int, watcher: Watcher) -> None:
    """Bring every material to its result or its failure.

    Args:
        materials: Those that are not done.
        work: What a worker does.
        workers: How many processes at a time; they inherit this process's environment.
        tries: How often a material is tried whose worker dies.
        watcher: Told of every start and end.

    Raises:
        RuntimeError: Workers do not even start.
    """
    pool = _Pool(Queue(materials, likeness), work, tries, watcher)
    try:
        pool.run(min(workers, len(materials)))
    finally:
        _stop(pool.workers)


class _Pool:
    """Worker processes, and what is left for them."""

    def __init__(self, queue: Queue, work: Work, tries: int, watcher: Watcher):
        self.workers: list[_Worker] = []
        self._queue, self._work, self._tries, self._watcher = queue, work, tries, watcher
        self._deaths: Counter[str] = Counter()
        self._failed_starts = 0
        self._memory = Memory()

    def run(self, count: int) -> None:
        """Start workers, and give and take until nothing is left."""
        self.workers += [_start(self._work) for _ in range(count)]
        while len(self._queue) or any(worker.material for worker in self.workers):
            for worker in self.workers:
                if worker.ready and worker.material is None:
                    others = [other.group for other in self.workers if other is not worker]
                    _give(worker, self._queue, others, self._watcher)
            readable = connection.wait([worker.connection for worker in self.workers], SECONDS_BETWEEN_TRIES)
            for index, worker in enumerate(self.workers):
                if worker.connection in readable:
                    try:
                        answer = worker.connection.recv()
                    except (EOFError, OSError):  # it died
                        self.workers[index] = _replace(worker, self._work)
                        self._bury(worker)
                    else:
                        self._take(worker, answer)

    def _take(self, worker: _Worker, answer: Outcome | None) -> None:
        """Note that a worker is ready, or how it ended its material."""
        material, worker.material = worker.material, None
        if not worker.ready:
            worker.ready, self._failed_starts = True, 0
        elif answer is not None:
            self._watcher.ended(answer)
        elif material is not None:  # another batch is at it
            self._queue.put_back(material, SECONDS_BETWEEN_TRIES)

    def _bury(self, worker: _Worker) -> None:
        """Put the material of a dead worker back, or give it up."""
        self._failed_starts += not worker.ready
        if self._failed_starts >= MOST_FAILED_STARTS:
            raise RuntimeError(f"workers end before they start, {_how(worker)}")
        material = worker.material
        if material is None:
            return
        self._deaths[material.name] += 1
        if self._deaths[material.name] < self._tries:
            self._queue.put_back(material)
        else:
            reason = f"its worker died, {_how(worker)}, {self._tries} times"
            self._watcher.ended(give_up(material, reason, self._memory))


def likeness(material: Material) -> tuple[object, ...]:
    """What materials of one geometry and config share, without parsing: a guess that costs time only where wrong."""
    path, key = material.options.input.path, config_key(material.options)
    if path.startswith(BUILTIN):
        return key, BUILTIN
    try:
        with open(path, "rb") as file:
            head = file.read(len(HDF5_MAGIC))
            if head == HDF5_MAGIC:
                return key, file.seek(0, 2)
            return key, head, sum(chunk.count(b"\n") for chunk in iter(lambda: file.read(1 << 20), b""))
    except OSError:  # its own attempt says so
        return key, None


def _start(work: Work, group: Group | None = None) -> _Worker:
    context = multiprocessing.get_context("spawn")  # a fork would copy locks of the threads of JAX and HDF5
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs, work), daemon=True)
    process.start()
    theirs.close()  # so that its end is the end of the connection
    return _Worker(process, ours, deque() if group is None else group)


def _give(worker: _Worker, queue: Queue, others: list[Group], watcher: Watcher) -> None:
    taken = queue.take(worker.group, others)
    if taken is not None:
        worker.material, worker.group = taken
        try:
            worker.connection.send(worker.material)
        except BrokenPipeError:  # it died while it waited: the loop finds that
            queue.put_back(worker.material)
            worker.material = None
            return
        watcher.started(worker.material.name)


def _replace(worker: _Worker, work: Work) -> _Worker:
    worker.connection.close()
    worker.process.join()
    return _start(work, worker.group)


def _how(worker: _Worker) -> str:
    code = worker.process.exitcode
    return f"signal {-code}" if code < 0 else f"exit code {code}"


def _stop(workers: Sequence[_Worker]) -> None:
    """End workers: those that wait by their own will, all others at once."""
    for worker in workers:
        if worker.material is None and worker.ready:
            with contextlib.suppress(BrokenPipeError):  # it is dead already
                worker.connection.send(None)
        else:
            worker.process.kill()
    for worker in workers:
        worker.process.join(timeout=5)
        worker.process.kill()
        worker.process.join()
        worker.connection.close()
