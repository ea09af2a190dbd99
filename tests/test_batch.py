"""Batches: resume, failures, dying workers, locks, the index, random kills. The computing itself takes milliseconds."""

import collections
import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import quick_library
from conftest import ROOT
from quick_library import write_library

from sbrdf_jax.batch import executors
from sbrdf_jax.batch.index import read_memory
from sbrdf_jax.batch.library import Material, load_library
from sbrdf_jax.batch.local import Queue
from sbrdf_jax.batch.locks import hold, is_held
from sbrdf_jax.batch.memory import Memory
from sbrdf_jax.batch.states import State, look
from sbrdf_jax.cli import main
from sbrdf_jax.hdf5 import dataset_of
from sbrdf_jax.options import InputOptions, RunOptions
from sbrdf_jax.runtime import worker_environment


@pytest.fixture
def batch(monkeypatch):
    """The command with quick computing, two workers unless it is told otherwise; its exit code."""
    monkeypatch.setattr(executors, "compute_material", quick_library.compute)
    for name, value in worker_environment(1).items():
        monkeypatch.setenv(name, value)  # the command sets them; so they are as before when the test is over
    return lambda library, *words: main(["batch", str(library), "--workers", "2", *words])


def computed(library: Path) -> collections.Counter[str]:
    """How often each material was computed."""
    lines = (library.parent / "computed.txt").read_text().splitlines()
    return collections.Counter(line.split()[0] for line in lines)


def states(library: Path) -> dict[str, State]:
    return {m.name: look(m, Memory()).state for m in load_library(library).materials}


def hidden_files(library: Path) -> list[str]:
    """Temporary files and locks in the folder of the results."""
    return [str(p) for p in (library.parent / "out").rglob("*") if p.suffix == ".tmp" or p.parent.name == ".locks"]


def test_a_batch_survives_what_its_materials_do(batch, tmp_path, capsys):
    texts = {"a": "ok", "b": "fail", "c": "crash", "d": "die once", "e": "die", "f": "ok", "g": "lane"}
    library = write_library(tmp_path, texts)
    assert batch(library) == 3
    shown = capsys.readouterr().err
    assert computed(library) == {"a": 1, "b": 1, "c": 1, "d": 2, "e": 3, "f": 1, "g": 1}
    done = {name for name, state in states(library).items() if state is State.DONE}
    assert done == {"a", "d", "f", "g"}
    assert "b: failed" in shown and "found 'fail'" in shown
    assert "unexpected ZeroDivisionError: division by zero" in shown
    assert "its worker died, signal 9, 3 times" in shown
    assert "g: done" in shown and "1 lanes failed" in shown
    assert "7 materials: 4 done, 3 failed" in shown
    assert hidden_files(library) == []
    log = (tmp_path / "out" / "batch.log").read_text()
    assert "a: started" in log and "a: done" in log

    # done and failed ones are left alone, until they are asked for
    assert batch(library) == 3
    assert computed(library).total() == 10
    (tmp_path / "raw" / "e.txt").write_text("ok")  # another source: its failure says nothing of this one
    assert batch(library, "--retry-failed") == 3
    assert computed(library) - collections.Counter(b=1, c=1, e=1) == {
        "a": 1,
        "b": 1,
        "c": 1,
        "d": 2,
        "e": 3,
        "f": 1,
        "g": 1,
    }
    assert states(library)["e"] is State.DONE


def test_what_has_changed_or_is_damaged_is_computed_again(batch, tmp_path, capsys):
    library = write_library(tmp_path, {name: "ok" for name in "abcde"})
    assert batch(library) == 0
    out = tmp_path / "out"
    (tmp_path / "raw" / "a.txt").write_text("slow 0")
    whole = (out / "b.h5").read_bytes()
    (out / "b.h5").write_bytes(whole[: len(whole) // 2])
    with h5py.File(out / "c.h5") as file:
        offset = file["grid/brdf"].id.get_chunk_info(0).byte_offset
    with open(out / "c.h5", "r+b") as file:
        file.seek(offset + 3)
        file.write(b"?")
    (out / "d.h5").unlink()
    (out / ".d.h5.elsewhere.123.tmp").touch()  # of a process of another machine
    assert states(library) == {
        "a": State.OUTDATED,
        "b": State.DAMAGED,
        "c": State.DAMAGED,
        "d": State.MISSING,
        "e": State.DONE,
    }
    capsys.readouterr()
    assert batch(library, "--plan") == 0
    assert "5 materials: 2 damaged, 1 outdated, 1 missing, 1 done; 4 to compute" in capsys.readouterr().out
    assert batch(library) == 0
    assert set(states(library).values()) == {State.DONE} and hidden_files(library) == []
    assert computed(library) == {"a": 2, "b": 2, "c": 2, "d": 2, "e": 1}
    assert batch(library, "represent.max_degree=2") == 0  # another config
    assert computed(library)["e"] == 2


def test_plan_and_status_compute_nothing(batch, tmp_path, capsys):
    library = write_library(tmp_path, {"a": "ok", "b": "fail"})
    assert batch(library, "--plan") == batch(library, "--status") == 0
    assert "2 materials: 2 missing; 2 to compute" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
    assert batch(library, "--shard", "1/2") == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [".locks", "a.h5", "batch-1-of-2.log"]
    with hold(tmp_path / "out", "b"):
        assert batch(library, "--status") == 0
    assert "b                            running" in capsys.readouterr().out
    assert (tmp_path / "out" / "index.h5").exists()
    assert batch(library) == batch(library, "--status") == 3


@pytest.mark.parametrize("words", [["--shard", "0/2"], ["--shard", "3/2"], ["--shard", "x"], ["--plan", "--status"]])
def test_wrong_command_is_one_line(words, batch, tmp_path, capsys):
    library = write_library(tmp_path, {"a": "ok"})
    with pytest.raises(SystemExit) as error:
        batch(library, *words)
    assert error.value.code == 2 and capsys.readouterr().err.count("\n") == 1


def test_wrong_folder_is_one_line(batch, tmp_path, capsys):
    library = write_library(tmp_path, {"a": "ok"})
    assert batch(library, f"output_folder={library}") == batch(library, f"output_folder={library}/x") == 2
    first, second = capsys.readouterr().err.splitlines()
    assert "a file; expected a folder" in first and "cannot be written" in second


def test_the_index_opens_all_results_as_one(batch, tmp_path, monkeypatch):
    library = write_library(tmp_path, {"a": "ok", "bb": "ok", "c": "fail"})
    assert batch(library) == 3
    monkeypatch.chdir("/")
    with h5py.File(tmp_path / "out" / "index.h5") as file:

        def read(name: str) -> list:
            return dataset_of(file, name)[()].tolist()

        assert read("materials/name") == [b"a", b"bb", b"c"]
        assert read("materials/state") == [b"done", b"done", b"failed"]
        assert read("materials/worst_error")[:2] == [0.25, 0.25]
        assert read("stacks/0/name") == [b"a", b"bb"]
        brdf = np.array(read("stacks/0/grid/brdf"))
        assert brdf.shape == (2, 3, 2, 2, 4)
        np.testing.assert_array_equal(brdf[:, 0, 0, 0, 0], [1.0, 2.0])
    memory = read_memory(tmp_path / "out")
    direct = Memory()
    for material in load_library(library).materials[:2]:
        look(material, direct)
    np.testing.assert_equal({k: tuple(v) for k, v in memory.results.items()}, direct.results)
    assert {k: memory.sources[k] for k in direct.sources} == direct.sources
    (tmp_path / "out" / "index.h5").write_bytes(b"damaged")
    assert read_memory(tmp_path / "out") == Memory() and batch(library) == 3
    assert computed(library) == {"a": 1, "bb": 1, "c": 1}


def test_a_lock_is_released_by_its_owners_death(tmp_path):
    code = f"from pathlib import Path\nfrom sbrdf_jax.batch.locks import hold\nwith hold(Path({str(tmp_path)!r}), 'a'):"
    code += "\n    print('held', flush=True)\n    input()"
    owner = subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert owner.stdout is not None and owner.stdout.readline() == "held\n"
    with hold(tmp_path, "a") as held, hold(tmp_path, "b") as other:
        assert not held and other
    assert is_held(tmp_path, "a")
    owner.kill()
    owner.wait()
    owner.stdout.close()
    assert owner.stdin is not None
    owner.stdin.close()
    with hold(tmp_path, "a") as held:
        assert held
    assert not is_held(tmp_path, "a") and list((tmp_path / ".locks").iterdir()) == []


def test_two_batches_on_one_folder_share_the_work(batch, tmp_path):
    library = write_library(tmp_path, {f"m{k:02}": "slow 0.1" for k in range(12)})
    with _driver(library) as other:
        assert batch(library) == 0
        assert other.wait(60) == 0
    assert computed(library) == {f"m{k:02}": 1 for k in range(12)}


def test_materials_that_look_alike_stay_on_one_worker():
    options = RunOptions(input=InputOptions(path="x"))
    materials = [Material(name, options) for name in ("a1", "a2", "b1", "a3", "b2", "a4", "a5", "a6")]
    queue = Queue(materials, lambda material: material.name[0])

    def take(group, others):
        taken = queue.take(group, others)
        return ("", group) if taken is None else (taken[0].name, taken[1])

    none = collections.deque()
    first, group_a = take(none, [])
    second, group_b = take(none, [group_a])
    assert (first, second) == ("a1", "b1")
    assert take(group_b, [group_a])[0] == "b2"
    assert take(group_b, [group_a])[0] == "a2"  # enough are left for another to help
    assert [take(group_a, [])[0] for _ in range(2)] == ["a3", "a4"]
    assert take(none, [group_a])[0] == ""  # too few to compile their code for
    queue.put_back(materials[0])
    assert take(none, [group_a])[0] == "a1" and len(queue) == 2


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)])
def test_workers_end_with_their_parent(tmp_path, sent, code):
    library = write_library(tmp_path, {name: "slow 60" for name in "abcdefgh"})
    with _driver(library) as process:
        deadline = time.monotonic() + 60
        while len(list((tmp_path / "out").glob(".*.tmp"))) < 2 and time.monotonic() < deadline:
            time.sleep(0.02)
        workers = _workers(process.pid)
        process.send_signal(sent)
        assert process.wait(30) == code
        _, errors = process.communicate()
    assert len(workers) == 2
    while any(map(_is_running, workers)) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not any(map(_is_running, workers))
    if code > 0:
        assert not list((tmp_path / "out").glob(".*.tmp"))
        assert errors.splitlines()[-1].endswith("finished results stay; the same command goes on from there")
    assert "Traceback" not in errors


@pytest.mark.parametrize("wanted", [12, pytest.param(200, marks=pytest.mark.slow)])
def test_random_kills_lose_nothing(tmp_path, wanted):
    rng = random.Random(11)
    names = [f"m{k:02}" for k in range(40)]
    library = write_library(tmp_path, dict.fromkeys(names, "slow 0.15"))
    kills, finished = kill_at_random(library, rng, wanted, seconds=0.5)
    assert kills == wanted
    with _driver(library) as process:
        assert process.wait(120) == 0
    assert states(library) == dict.fromkeys(names, State.DONE)
    assert hidden_files(library) == []
    assert {name: (tmp_path / "out" / f"{name}.h5").stat().st_mtime_ns for name in finished} == finished


def kill_at_random(library: Path, rng: random.Random, kills: int, seconds: float) -> tuple[int, dict[str, int]]:
    """Start batches and kill them or their workers, half of the times each; return kills and times of results.

    A result that was seen once must never change.
    """
    finished: dict[str, int] = {}
    count = 0
    while count < kills:
        with _driver(library) as process:
            while process.poll() is None and count < kills:
                time.sleep(rng.uniform(0, 2 * seconds))
                workers = _workers(process.pid)
                victim = process.pid if rng.random() < 0.5 or not workers else rng.choice(workers)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(victim, signal.SIGKILL)
                    count += 1
                for result in (library.parent / "out").glob("m*.h5"):
                    assert finished.setdefault(result.stem, result.stat().st_mtime_ns) == result.stat().st_mtime_ns
            if process.poll() == 0:  # all is done: make some work
                for name in rng.sample(sorted(finished), len(finished) // 2):
                    (library.parent / "out" / f"{name}.h5").unlink()
                    del finished[name]
    return count, finished


@contextlib.contextmanager
def _driver(library: Path):
    """A batch in a process of its own, with quick computing and two workers."""
    words = [str(ROOT / "tests" / "quick_library.py"), str(library), "executor.workers=2", "executor.tries=1000"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, *words], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        assert process.stderr is not None
        process.stderr.close()


def _workers(parent: int) -> list[int]:
    """Worker processes of a batch."""
    try:
        children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
        commands = {int(pid): Path(f"/proc/{pid}/cmdline").read_text() for pid in children}
    except (FileNotFoundError, ProcessLookupError):
        return []
    return [pid for pid, command in commands.items() if "spawn_main" in command]


def _is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
