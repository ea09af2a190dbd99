"""The slurm executor on a real one-node Slurm that these tests start and stop; skipped by name where there is none."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import quick_library
from conftest import IN_CI, ROOT, shared_file
from quick_library import write_library
from test_batch_results import assert_same_datasets, small_library

from sbrdf_jax.batch.library import load_library
from sbrdf_jax.batch.memory import Memory
from sbrdf_jax.batch.states import State, look
from sbrdf_jax.cli import main

TOOLS = ("slurmctld", "slurmd", "munged", "sbatch")


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    """A Slurm of one node, started and stopped; the environment of its commands."""
    path = os.environ["PATH"] + os.pathsep + "/usr/sbin"
    missing = [tool for tool in TOOLS if not shutil.which(tool, path=path)]
    if missing or os.geteuid() != 0:
        reason = f"no Slurm to start here: missing {', '.join(missing) or 'the right to, as root'}"
        pytest.fail(reason) if IN_CI and not missing else pytest.skip(reason)
    script = shared_file("slurm/start-single-node.sh")
    folder = tmp_path_factory.mktemp("slurm")
    environment = os.environ | {"SLURM_TEST_DIR": str(folder), "PATH": path}
    subprocess.run(["sh", script], env=environment, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    yield environment | {"SLURM_CONF": str(folder / "slurm.conf"), "PYTHONPATH": str(ROOT)}
    subprocess.run(["sh", script, "stop"], env=environment, check=True)


def submit(library: Path, slurm, *words: str) -> str:
    """Submit a library with quick computing; return the number of its job."""
    program = [sys.executable, str(ROOT / "tests" / "quick_library.py"), str(library), "--executor", "slurm", *words]
    done = subprocess.run(program, env=slurm, capture_output=True, text=True, cwd=library.parent)
    assert done.returncode == 0, done.stderr
    return next(line.split()[2].rstrip(":") for line in done.stderr.splitlines() if line.startswith("submitted job"))


def jobs(slurm) -> list[str]:
    """Jobs and tasks that wait or run."""
    return subprocess.run(["squeue", "-h", "-r", "-o", "%i"], env=slurm, capture_output=True, text=True).stdout.split()


def wait_for(condition, seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_an_array_with_a_cancelled_task_is_finished_by_the_next(slurm, tmp_path):
    names = [f"m{k}" for k in range(8)]
    library = write_library(tmp_path, dict.fromkeys(names, "ok") | {"m0": "slow 60"}, "executor: {slurm: {shards: 4}}")
    out = tmp_path / "out"
    job = submit(library, slurm)
    wait_for(lambda: len(list(out.glob("*.h5"))) >= 6 and list(out.glob(".m0.h5.*.tmp")))
    subprocess.run(["scancel", f"{job}_1"], env=slurm, check=True)
    wait_for(lambda: not jobs(slurm))
    assert not (out / "m0.h5").exists() and (out / "index.h5").exists(), (out / "slurm-index.out").read_text()
    done = {path: path.stat().st_mtime_ns for path in out.glob("m*.h5")}

    (tmp_path / "raw" / "m0.txt").write_text("ok")
    submit(library, slurm)
    assert "#SBATCH --array=1\n" in (out / "slurm_array.sh").read_text()
    wait_for(lambda: not jobs(slurm))
    assert {look(material, Memory()).state for material in load_library(library).materials} == {State.DONE}
    assert {path: path.stat().st_mtime_ns for path in done} == done
    lines = (tmp_path / "computed.txt").read_text().splitlines()
    assert sorted(line.split()[0] for line in lines) == sorted([*names, "m0"])
    assert not list(out.glob(".*.tmp")) and not list((out / ".locks").iterdir())


def test_without_slurm_it_is_one_line(tmp_path, monkeypatch, capsys):
    library = write_library(tmp_path, {"a": "ok"})
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["batch", str(library), "--executor", "slurm"]) == 2
    assert "no sbatch on PATH" in capsys.readouterr().err.splitlines()[-1]


def test_the_script_in_scripts_is_the_template():
    assert (ROOT / "scripts" / "slurm_array.sh").resolve() == ROOT / "sbrdf_jax" / "batch" / "slurm_array.sh"
    assert quick_library.slurm.TEMPLATE.read_text().startswith("#!/bin/sh\n")


@pytest.mark.slow
def test_dask_jobqueue_runs_two_workers_and_survives_a_kill(slurm, tmp_path):
    pytest.importorskip("dask_jobqueue", reason="the extra cluster is not installed")
    names = [f"m{k}" for k in range(8)]
    executor = "{kind: dask, workers: 2, dask: {cluster: slurm, memory: 1GiB, walltime: '00:05'}}"
    texts = dict.fromkeys(names, "slow 1") | {"m0": "die once"}
    library = write_library(tmp_path, texts, f"executor: {executor}")
    program = [sys.executable, str(ROOT / "tests" / "quick_library.py"), str(library)]
    with open(tmp_path / "shown.txt", "w") as shown:
        process = subprocess.Popen(program, env=slurm, stderr=shown, cwd=tmp_path)
        wait_for(lambda: (tmp_path / "out").is_dir() and list((tmp_path / "out").glob("m*.h5")))
        subprocess.run(["scancel", jobs(slurm)[0]], env=slurm, check=True)
        assert process.wait(120) == 0, (tmp_path / "shown.txt").read_text()
    assert {look(material, Memory()).state for material in load_library(library).materials} == {State.DONE}
    assert not list((tmp_path / "out").glob(".*.tmp"))
    wait_for(lambda: not jobs(slurm))


@pytest.mark.slow
@pytest.mark.parametrize("executor", ["slurm", "dask"])
def test_slurm_and_dask_jobqueue_give_the_datasets_of_a_local_batch(executor, slurm, tmp_path):
    library = small_library(tmp_path, 8)
    command = [sys.executable, "-m", "sbrdf_jax.batch", str(tmp_path / "library.yaml"), "executor.threads=1"]
    command += [f"executor.compile_cache={tmp_path}/compiled"]
    subprocess.run(command, env=slurm, check=True, cwd=tmp_path)
    there = [*command, f"output_folder={tmp_path}/there", "--executor", executor]
    if executor == "dask":
        dask = "executor.dask={cluster: slurm, memory: 2GiB, walltime: '00:10'}"
        subprocess.run([*there, "--workers", "2", dask], env=slurm, check=True, cwd=tmp_path)
    else:
        subprocess.run(there, env=slurm, check=True, cwd=tmp_path)
        wait_for(lambda: not jobs(slurm), 500)
    for material in library.materials:
        assert_same_datasets(material.result, tmp_path / "there" / material.result.name)
    assert (tmp_path / "there" / "index.h5").exists()
