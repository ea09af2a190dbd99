"""Every reader against damaged files, in a process of its own: an answer or one line; no crash, no hang, no memory."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from conftest import ROOT
from problems import scattered_samples
from small_results import UNIFORM_NM, small_compact, small_field, small_grid
from test_formats import CSV, NIST, PBRT, write_raw

from sbrdf_jax import store
from sbrdf_jax.cleaning import clean

DEFAULT = {"pbrt": 2000, "csv": 2000, "nist": 2000, "config": 300, "directions": 2000, "folds": 2000}
DEFAULT |= {"raw_hdf5": 300, "result": 300}  # a child process reads these, or an HDF5 file is opened three times
CONFIG = """input: {path: a.csv, format: csv, scale: 2.0}  # a comment
grid:
  theta_i_step_deg: 7.5
represent: {target: {error: 0.01}, max_degree: 4}
"""


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    """Sound files of every kind, by names that start with it."""
    folder = tmp_path_factory.mktemp("fuzz") / "seeds"
    folder.mkdir()
    texts = {"pbrt": PBRT, "csv": CSV, "nist": NIST, "config": CONFIG, "folds": "row,fold\n0,1\n1,1\n2,0\n3,0\n4,2\n"}
    texts["directions"] = "theta_i_deg,theta_o_deg,phi_o_deg\n0,10,0\n45.5,45.5,180\n90,90,-20\n"
    for kind, text in texts.items():
        (folder / kind).write_text(text)
    write_raw(folder / "raw_hdf5")
    rng = np.random.default_rng(3)
    gridded = small_grid(rng, wavelength_nm=UNIFORM_NM)
    result = store.RunResult(
        gridded=gridded,
        field=small_field(gridded),
        compact=small_compact(rng),
        metrics={"relative_error": np.full(5, 0.1)},
        clean=clean(scattered_samples(rng, [0.0, 30.0, 60.0], 10, 11)).report,
        validation={"predicted": np.ones((30, 11)), "fold": np.arange(30) % 5},
        plan={"clean samples": {"needed": 29, "total": 30}},
        warnings=("one",),
        config=CONFIG,
    )
    store.save(folder / "result", result)
    return folder


def fuzz(kind: str, count: int, seeds, folder) -> list[str]:
    """Read damaged files and return what went wrong, an input a line; after each the next process goes on."""
    shutil.copytree(seeds, folder / "seeds")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    wrong, first = [], 0
    while first < count and len(wrong) < 20:
        words = ["-m", "tests.stress.fuzzer", kind, str(first), str(count - first), str(folder)]
        done = subprocess.run(
            [sys.executable, *words], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
        )
        if done.returncode == 0:
            return wrong
        at = int((folder / "at").read_text() or -1) if (folder / "at").exists() else -1
        ended = signal.Signals(-done.returncode).name if done.returncode < 0 else done.stdout + done.stderr[-2000:]
        wrong.append(f"{kind} {at}: {ended}")
        assert at >= first, wrong  # else it never began
        first = at + 1
    return wrong


@pytest.mark.parametrize("kind", DEFAULT)
def test_a_damaged_file_is_an_answer_or_one_line(kind, seeds, tmp_path, request):
    option = request.config.getoption
    count, start = option("--fuzz-inputs") or DEFAULT[kind], time.perf_counter()
    wrong = fuzz(kind, count, seeds, tmp_path)
    if option("--fuzz-records"):
        seconds = time.perf_counter() - start
        record = {"table": "fuzzing", "reader": kind, "inputs": count, "wrong": len(wrong), "seconds": round(seconds)}
        with open(option("--fuzz-records"), "a") as file:
            print(json.dumps(record), file=file)
    assert wrong == []
