"""Kills, full disks, closed folders, rivals and lost terminals: a whole file or none, and one clear line."""

import json
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from problems import scattered_samples
from test_run import FAST
from writers import result_of, write_as_another_user, write_for_ever, write_on_a_full_disk, write_some

from sbrdf_jax.formats import write_samples
from sbrdf_jax.records import Status
from sbrdf_jax.store import load, save

KILLS_OF_A_RUN = 50
CONTEXT = multiprocessing.get_context("forkserver")


def started(work, *arguments) -> Any:
    process = CONTEXT.Process(target=work, args=arguments)
    process.start()
    return process


def whole_number_in(path) -> int:
    """The number of the result in a file, after a look whether it is that result throughout."""
    found = load(path)
    number = int(found.config)
    assert (np.asarray(found.gridded.brdf) == number).all()
    return number


@pytest.mark.parametrize("kills", [5, pytest.param(100, marks=pytest.mark.slow)])
def test_a_kill_while_writing_leaves_a_whole_file(kills, tmp_path):
    rng, path, last = random.Random(5), tmp_path / "result.h5", 0
    save(path, result_of(0))
    for _ in range(kills):
        before, deadline = path.stat().st_mtime_ns, time.monotonic() + 60
        process = started(write_for_ever, path, last + 1)
        while path.stat().st_mtime_ns == before and time.monotonic() < deadline:
            time.sleep(0.001)
        time.sleep(rng.uniform(0.0, 0.2))
        process.kill()
        process.join()
        number = whole_number_in(path)
        assert number > last
        last = number
        assert len(list(tmp_path.iterdir())) <= 2  # what the dead one left is removed by the next
    save(path, result_of(last + 1))
    assert list(tmp_path.iterdir()) == [path] and whole_number_in(path) == last + 1


def test_two_writers_of_one_file_leave_one_of_their_results(tmp_path):
    path = tmp_path / "result.h5"
    writers = [started(write_some, path, first, 20) for first in (100, 200)]
    while any(writer.is_alive() for writer in writers):
        if path.exists():
            assert whole_number_in(path) // 100 in (1, 2)
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert whole_number_in(path) in (119, 219)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("num_bytes", [0, 1_000, 10_000, 40_000])
def test_a_full_disk_is_one_line_and_keeps_the_old_file(num_bytes, tmp_path):
    path, answer = tmp_path / "result.h5", CONTEXT.SimpleQueue()
    save(path, result_of(7))
    assert path.stat().st_size > num_bytes
    process = started(write_on_a_full_disk, path, num_bytes, answer)
    process.join(60)
    assert process.exitcode == 0
    message = answer.get()
    assert message.startswith(f"{path}: cannot be written") and "\n" not in message and len(message) < 600
    assert list(tmp_path.iterdir()) == [path] and whole_number_in(path) == 7


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path):
    folder, answer = tmp_path / "closed", CONTEXT.SimpleQueue()
    folder.mkdir()
    for place in (tmp_path.parent.parent, tmp_path.parent, tmp_path):
        place.chmod(place.stat().st_mode | 0o011)
    save(folder / "result.h5", result_of(7))
    folder.chmod(0o555)
    process = started(write_as_another_user, folder / "result.h5", answer)
    process.join(60)
    folder.chmod(0o755)
    assert process.exitcode == 0
    message = answer.get()
    assert "result.h5: cannot be written: Permission denied" in message and "\n" not in message
    assert list(folder.iterdir()) == [folder / "result.h5"] and whole_number_in(folder / "result.h5") == 7


@pytest.fixture(scope="module")
def words(tmp_path_factory):
    """The command and environment of a run of a small measurement, with compiled code kept."""
    folder = tmp_path_factory.mktemp("faults")
    write_samples(folder / "small.csv", scattered_samples(np.random.default_rng(3), [0.0, 30.0, 60.0, 80.0], 40, 5))
    (folder / "config.yaml").write_text("input: {path: small.csv}\n")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "SBRDF_COMPILE_CACHE": str(folder / "cache")}
    command = [sys.executable, "-m", "sbrdf_jax.run", str(folder / "config.yaml"), *FAST, "output.overwrite=true"]
    return command, environment


@pytest.mark.slow
def test_a_run_killed_at_random_leaves_no_half_file_and_runs_again(words, tmp_path):
    command, environment = words
    rng, output = random.Random(6), tmp_path / "x.h5"
    for _ in range(2):  # the second time with compiled code
        start = time.monotonic()
        subprocess.run([*command, f"output.path={output}"], env=environment, check=True, capture_output=True)
        seconds = time.monotonic() - start
    for _ in range(KILLS_OF_A_RUN):
        process = subprocess.Popen(
            [*command, f"output.path={output}"], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        time.sleep(rng.uniform(0, seconds))
        process.kill()
        assert process.wait() in (0, -signal.SIGKILL)
        if output.exists():
            load(output)
        assert {path.name for path in tmp_path.iterdir() if path.suffix != ".tmp"} <= {"x.h5", "x.h5.log"}
    done = subprocess.run([*command, f"output.path={output}"], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (np.asarray(load(output).gridded.status) == Status.OK).all()
    assert {path.name for path in tmp_path.iterdir()} == {"x.h5", "x.h5.log"}


def at_a_terminal(command, environment, log, act):
    """Run a command at a terminal of its own, `act` once it has begun; its exit code and what it showed."""
    words = [sys.executable, str(Path(__file__).with_name("terminal.py")), act, str(log), *command]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    return found["code"], found["shown"]


@pytest.mark.parametrize(("act", "code"), [("interrupt", 130), ("hang up", -signal.SIGHUP)])
def test_an_interrupted_or_lost_terminal_leaves_nothing_half_written(act, code, words, tmp_path):
    command, environment = words
    output = tmp_path / "x.h5"
    fine = ["grid.theta_o_step_deg=7.5", "grid.phi_o_step_deg=7.5"]  # not compiled yet: it takes a while
    log = tmp_path / "x.h5.log"
    found, shown = at_a_terminal([*command, *fine, f"output.path={output}"], environment, log, act)
    assert found == code, shown
    assert [path.name for path in tmp_path.iterdir()] == ["x.h5.log"]
    assert "Traceback" not in shown
    if act == "interrupt":
        assert shown.splitlines()[-1].endswith("nothing was written under the output name")
