"""A library whose materials take milliseconds, for tests of everything around the computing.

Run as a program, it is `sbrdf batch` with that computing in place of the real one.
"""

import os
import signal
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np

from sbrdf_jax.batch import executors, slurm
from sbrdf_jax.batch.library import Material
from sbrdf_jax.cli import main_exit
from sbrdf_jax.config import resolved_yaml
from sbrdf_jax.errors import UserError
from sbrdf_jax.files import whole_file

BASE = "output: {report: false}\nresample: {method: paper}\n"


def write_library(folder: Path, sources: dict[str, str], *lines: str) -> Path:
    """Write a library of one measurement for each name: "ok", "slow", "fail", "crash", "die" or "die once"."""
    (folder / "raw").mkdir(parents=True)
    for name, text in sources.items():
        (folder / "raw" / f"{name}.txt").write_text(text + "\n")
    (folder / "base.yaml").write_text(BASE)
    path = folder / "library.yaml"
    keys = {"base": "base.yaml", "materials": "raw/*.txt", "output_folder": str(folder / "out")}
    path.write_text("\n".join([*(f"{key}: '{value}'" for key, value in keys.items()), *lines]) + "\n")
    return path


def compute(material: Material) -> None:
    """Write a small result, or do what the measurement says."""
    source = Path(material.options.input.path)
    text = source.read_text().strip()
    with open(material.result.parent.parent / "computed.txt", "a") as file:
        file.write(f"{material.name} {os.environ['NPROC']} {os.getpid()}\n")
    mark = source.with_suffix(".mark")
    if text == "fail":
        raise UserError(f"{source}: found 'fail', expected a measurement")
    if text == "crash":
        raise ZeroDivisionError("division\nby zero")
    if text == "die" or (text == "die once" and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    write_result(material, text)


def write_result(material: Material, text: str = "") -> None:
    """Write a result of a material, slowly where the text says so."""
    with whole_file(material.result) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["schema_name"], file.attrs["schema_version"] = "sbrdf-result", 1
        file.attrs["config"] = resolved_yaml(material.options)
        file.attrs["source_sha256"] = _sha256(Path(material.options.input.path))
        file.attrs["created_utc"] = datetime.now(UTC).isoformat(timespec="seconds")
        value = np.full((3, 2, 2, 4), float(len(material.name)))
        file.create_dataset("grid/brdf", data=value, chunks=(1, 2, 2, 4), fletcher32=True)
        file["grid/status"] = np.array([int(text == "lane"), 0, 0, 0])
        file["metrics/relative_error"] = np.array([0.01, 0.25, 0.9])
        file["grid/extrapolated"] = np.repeat([0, 1, 2], 4).reshape(3, 2, 2)  # the last incident angle has no data
        file["timing/resample/total"], file["timing/resample/compile"] = 1.5, 0.5
        file.flush()
        time.sleep(float(text.removeprefix("slow ")) if text.startswith("slow ") else 0.0)


def _sha256(path: Path) -> str:
    import hashlib

    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    executors.compute_material = compute
    slurm.PROGRAM = (sys.executable, __file__)
    sys.argv[0] = "sbrdf"
    main_exit("batch")
