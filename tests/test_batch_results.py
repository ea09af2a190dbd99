"""What a batch computes is what `run` computes, whoever runs it, and materials of one geometry share what they can."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import h5py
import jax
import numpy as np
from problems import scattered_samples

from sbrdf_jax.batch.attempt import attempt, compute_material
from sbrdf_jax.batch.dask_cluster import attempt_at_worker
from sbrdf_jax.batch.library import Library, load_library
from sbrdf_jax.batch.memory import Memory
from sbrdf_jax.batch.states import State
from sbrdf_jax.batch.worker import Work
from sbrdf_jax.cli import main
from sbrdf_jax.formats import write_samples
from sbrdf_jax.hdf5 import dataset_of
from sbrdf_jax.resampling import kept
from sbrdf_jax.resampling.kept import Kept

BASE = """
grid: {theta_i_step_deg: 30, theta_o_step_deg: 22.5, phi_o_step_deg: 45}
resample: {method: paper}
represent: {max_degree: 1, lobe: angle_squared}
output: {report: false}
"""


def small_library(folder, count: int) -> Library:
    """A library of small real measurements of one geometry."""
    (folder / "raw").mkdir()
    samples = scattered_samples(np.random.default_rng(3), [0.0, 30.0, 60.0, 80.0], 60, 9)
    for number in range(count):
        value = samples.value * (1 + 0.1 * number)
        write_samples(folder / "raw" / f"m{number}.h5", samples.__class__(**{**vars(samples), "value": value}))
    (folder / "base.yaml").write_text(BASE)
    text = f"base: base.yaml\nmaterials: raw/*.h5\noutput_folder: {folder}/local\nexecutor: {{slurm: {{shards: 8}}}}\n"
    (folder / "library.yaml").write_text(text)
    return load_library(folder / "library.yaml")


def assert_same_datasets(first, second) -> None:
    """Two results hold the same to the last bit, `timing` apart."""
    with h5py.File(first) as one, h5py.File(second) as other:

        def compare(name, item):
            if isinstance(item, h5py.Dataset) and not name.startswith("timing"):
                np.testing.assert_array_equal(item[()], dataset_of(other, name)[()], err_msg=name)

        one.visititems(compare)


def test_a_material_of_a_batch_is_what_run_computes(tmp_path, monkeypatch):
    library = small_library(tmp_path, 2)
    inverted = []
    original = Kept.inverse
    monkeypatch.setattr(Kept, "inverse", lambda self, op: inverted.append(original(self, op)) or inverted[-1])
    memory, compute, compiled = Memory(), compute_material, []
    first = attempt(library.materials[0], compute, memory)
    jax.monitoring.register_event_duration_secs_listener(lambda event, duration_secs, **kwargs: compiled.append(event))
    second = attempt(library.materials[1], compute, memory)
    assert first is not None and second is not None
    assert first.state is second.state is State.DONE and first.computed and second.seconds > 0
    assert [event for event in compiled if event.endswith("backend_compile_duration")] == []
    assert inverted[0] is inverted[1] is not None  # worked out once for the geometry

    material = library.materials[1]
    places = [f"input.path={material.options.input.path}", f"output.path={tmp_path}/alone.h5"]
    assert main(["run", str(tmp_path / "base.yaml"), *places]) == 0
    assert_same_datasets(material.result, tmp_path / "alone.h5")
    again = attempt(material, compute, memory)
    assert again is not None and again.state is State.DONE and not again.computed
    (tmp_path / "raw" / "m0.h5").write_bytes(b"nonsense")
    failed = attempt(library.materials[0], compute, memory)
    assert failed is not None and failed.state is State.FAILED and "m0.h5" in failed.reason


def test_tasks_of_one_thread_share_what_depends_on_angles(tmp_path, monkeypatch):
    library, inverted, original = small_library(tmp_path, 3), [], kept.invert_normal
    monkeypatch.setattr(kept, "invert_normal", lambda operator: inverted.append(None) or original(operator))
    task = pickle.dumps(Work(compute_material))  # as it reaches a worker of dask, anew for each material
    for materials, expected in ((library.materials[:2], 1), (library.materials[2:], 2)):
        with ThreadPoolExecutor(1) as thread:
            for material in materials:
                outcome = thread.submit(attempt_at_worker, material, pickle.loads(task)).result()
                assert outcome is not None and outcome.state is State.DONE and outcome.computed
        assert len(inverted) == expected
