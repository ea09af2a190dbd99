"""The dask executor: workers that it starts, a scheduler that runs already, and what is said where there is none."""

import os
import subprocess
import sys

import pytest
from conftest import ROOT
from quick_library import write_library

from sbrdf_jax.batch.library import load_library
from sbrdf_jax.batch.memory import Memory
from sbrdf_jax.batch.states import State, look

pytest.importorskip("distributed", reason="the extra cluster is not installed")
TEXTS = {"a": "ok", "b": "fail", "c": "die once", "d": "ok", "e": "die", "f": "ok"}


def run(library, *words: str) -> subprocess.CompletedProcess:
    program = [sys.executable, str(ROOT / "tests" / "quick_library.py"), str(library), "--executor", "dask"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run([*program, *words], env=environment, capture_output=True, text=True, timeout=120)


def test_it_starts_workers_and_survives_their_deaths(tmp_path):
    library = write_library(tmp_path, TEXTS)
    done = run(library, "executor.workers=2", "executor.threads=1")
    assert done.returncode == 3, done.stderr
    states = {m.name: look(m, Memory()).state for m in load_library(library).materials}
    assert {name for name, state in states.items() if state is State.FAILED} == {"b", "e"}
    assert "its worker died" in done.stderr and "6 materials: 4 done, 2 failed" in done.stderr
    lines = (tmp_path / "computed.txt").read_text().splitlines()
    assert {line.split()[1] for line in lines} == {"1"}  # NPROC, before anything was imported
    assert sorted(line.split()[0] for line in lines if line[0] in "abdf") == list("abdf")


def test_no_scheduler_is_one_line(tmp_path):
    library = write_library(tmp_path, {"a": "ok"})
    done = run(library, "executor.dask.address=tcp://127.0.0.1:9")
    assert done.returncode == 2
    assert "executor.dask.address: found 'tcp://127.0.0.1:9'" in done.stderr.splitlines()[-1]
