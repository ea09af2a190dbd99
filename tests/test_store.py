"""The result file: what comes back, the contract's names, equal bytes, and kills and damage of every kind."""

import dataclasses
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest
from small_results import UNIFORM_NM, small_compact, small_field, small_grid

from sbrdf_jax import hdf5, store
from sbrdf_jax.cleaning import clean
from sbrdf_jax.errors import UserError
from sbrdf_jax.evaluation import evaluate_in_chunks
from sbrdf_jax.files import whole_file
from sbrdf_jax.hdf5 import attribute, dataset_of
from sbrdf_jax.metrics import METRIC_AXES, stored_numbers
from sbrdf_jax.records import RawSamples


def raw_samples(rng, count=30) -> RawSamples:
    value = rng.uniform(0.1, 1.0, (count, len(UNIFORM_NM)))
    value[3, 2], value[4, 1] = np.nan, -0.1
    theta_i, theta_o, phi_o = rng.choice([0.1, 0.4, 0.9], count), rng.uniform(0, 1.5, count), rng.uniform(0, 6, count)
    return RawSamples(theta_i, theta_o, phi_o, UNIFORM_NM, value, np.arange(count), "brdf", "made up", "csv", "ab" * 32)


@pytest.fixture
def result(rng) -> store.RunResult:
    grid = small_grid(rng, wavelength_nm=UNIFORM_NM)
    shape = {"theta_i": 5, "theta_i_between": 4, "wavelength": 11}
    metrics = {name: rng.uniform(size=[shape[axis] for axis in axes]) for name, axes in METRIC_AXES.items()}
    return store.RunResult(
        gridded=grid,
        field=small_field(grid),
        compact=small_compact(rng),
        metrics=metrics | {"relative_error": rng.uniform(size=5), "compression_ratio": np.array(110.5)},
        clean=clean(raw_samples(rng)).report,
        input={"source": "builtin:amber_glass", "quantity": "brdf", "notes": ["a µ", "b"]},
        validation={"predicted": rng.uniform(size=(30, 11)), "fold": np.arange(30) % 5},
        plan={"clean samples": {"needed": 29, "total": 30, "reason": "one dropped"}, "coefficients_used": 5},
        timing={"resample": {"total": 1.5, "compile": 0.5, "run": 1.0}},
        warnings=("not measured: much",),
        config="input:\n  path: builtin:amber_glass  # θ\n",
        source_sha256="cd" * 32,
        created_utc="2024-06-07T00:00:00Z",
        versions={"jax": "0.10.2"},
    )


def same(a, b, path="result"):
    """Assert that two records are equal, angles to the rounding of degrees."""
    if dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            same(getattr(a, field.name), getattr(b, field.name), f"{path}.{field.name}")
    elif isinstance(a, dict):
        assert set(a) == set(b), path
        for key in a:
            same(a[key], b[key], f"{path}[{key}]")
    elif isinstance(a, (np.ndarray, jax.Array, float)):
        np.testing.assert_allclose(np.asarray(b), np.asarray(a), rtol=1e-15, atol=1e-15, err_msg=path)
    else:
        assert a == b, path


def test_what_is_saved_comes_back(tmp_path, result):
    path = tmp_path / "new folder" / "result.h5"
    store.save(path, result)
    same(result, store.load(path))
    assert list(path.parent.iterdir()) == [path]
    bare = store.RunResult(gridded=result.gridded)
    store.save(path, bare)
    same(bare, store.load(path))


def test_angles_are_stored_as_a_user_would_write_them(tmp_path, result):
    grid = dataclasses.replace(result.gridded, theta_i=np.deg2rad(np.linspace(0, 90, 13)[:5]))
    store.save(tmp_path / "r.h5", dataclasses.replace(result, gridded=grid))
    with h5py.File(tmp_path / "r.h5") as file:
        np.testing.assert_array_equal(file["grid/theta_i_deg"], [0, 7.5, 15, 22.5, 30])
        np.testing.assert_array_equal(file["grid/phi_o_deg"], np.arange(0, 361, 30))


def test_the_layout_is_the_contracts(tmp_path, result):
    path = tmp_path / "r.h5"
    store.save(path, result)
    shapes = {
        "grid/brdf": (5, 5, 13, 11),
        "grid/extrapolated": (5, 5, 13),
        "grid/kkt_residual": (11,),
        "grid/num_steps": (11,),
        "grid/status": (11,),
        "spectral/coefficients": (5, 5, 13, 5),
        "compact/background": (5, 5, 9),
        "compact/lobe_kind": (5, 5),
        "compact/lobe_height": (5, 5),
        "compact/lobe_width": (5, 5),
        "compact/critical_angle_deg": (5, 5),
        "compact/status": (5, 5),
        "compact/lobe_peak_theta_o_deg": (5,),
        "metrics/relative_error": (5,),
        "metrics/relative_error_between_theta_i": (4,),
        "metrics/compression_ratio": (),
        "validation/predicted": (30, 11),
    }
    with h5py.File(path) as file:
        assert file.attrs["schema_name"] == "sbrdf-result"
        assert file.attrs["schema_version"] == 1
        for name in ("config", "config_sha256", "source_sha256", "created_utc", "versions"):
            assert isinstance(file.attrs[name], str)
        for name, shape in shapes.items():
            assert dataset_of(file, name).shape == shape, name
        assert dataset_of(file, "grid/brdf").chunks == (1, 5, 13, 8)
        assert dataset_of(file, "grid/brdf").dtype == np.float64
        assert file["spectral/coefficients"].attrs["basis"] == "fourier"
        assert file["spectral/coefficients"].attrs["coefficient_order"] == "a_0,a_1,b_1,a_2,b_2"
        assert file["compact/lobe_kind"].attrs["names"] == "none,angle_squared,tan_squared,tan"
        np.testing.assert_array_equal(
            attribute(dataset_of(file, "compact/background"), "harmonic_order")[:4], [[0, 0], [1, -1], [1, 0], [1, 1]]
        )
        assert file["compact"].attrs["method"] == "paper"
        assert file["compact/status"].attrs["names"] == "ok,max_steps,nonfinite,skipped,clamped,no_lobe"

        held = []

        def check(name, item):
            if isinstance(item, h5py.Dataset):
                assert isinstance(item.attrs["units"], str), name
                if name.startswith("compact/"):
                    held.append(item.size)
                if not item.is_scale and not name.startswith("input/cleaning"):
                    assert all(len(item.dims[k]) == 1 for k in range(item.ndim)), name

        file.visititems(check)
        assert sum(held) == file["compact"].attrs["stored_numbers"] == stored_numbers(result.compact)


def test_the_compact_group_alone_is_enough(tmp_path, rng, result):
    store.save(tmp_path / "whole.h5", result)
    with h5py.File(tmp_path / "whole.h5") as whole, h5py.File(tmp_path / "part.h5", "w") as part:
        part.attrs["schema_name"], part.attrs["schema_version"] = "sbrdf-result", 1
        whole.copy("compact", part)
    compact = store.load_stage(tmp_path / "part.h5", "compact")
    directions = rng.uniform(0, 1.5, (3, 20))
    wavelength = np.array([400.0, 555.5])
    theta_i, theta_o, phi_o = directions
    expected = evaluate_in_chunks(result.compact, theta_i, theta_o, phi_o, wavelength, chunk_size=20)
    found = evaluate_in_chunks(compact, theta_i, theta_o, phi_o, wavelength, chunk_size=20)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    with pytest.raises(UserError, match="stage grid: not in this result"):
        store.load_stage(tmp_path / "part.h5", "grid")


def test_equal_input_gives_equal_bytes(tmp_path, result):
    store.save(tmp_path / "a.h5", result)
    time.sleep(1.1)  # a time stamp would differ by then
    store.save(tmp_path / "b.h5", result)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_a_kill_while_writing_leaves_nothing_under_the_name(tmp_path, result):
    path = tmp_path / "result.h5"
    script = f"""
import os, signal, sys
sys.path[:0] = {[str(Path(__file__).parent.parent), str(Path(__file__).parent)]}
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
from sbrdf_jax import files, store
from small_results import UNIFORM_NM, small_grid
files._sync = lambda path: os.kill(os.getpid(), signal.SIGKILL)
store.save({str(path)!r}, store.RunResult(gridded=small_grid(np.random.default_rng(0), wavelength_nm=UNIFORM_NM)))
"""
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
        assert done.returncode == -signal.SIGKILL, done.stderr
        (leftover,) = tmp_path.iterdir()
        assert leftover.name.endswith(".tmp")
    store.save(path, result)
    assert list(tmp_path.iterdir()) == [path]
    same(result, store.load(path))


def test_an_error_while_writing_leaves_the_old_file(tmp_path, result, monkeypatch):
    path = tmp_path / "result.h5"
    store.save(path, result)
    before = path.read_bytes()

    def fails(*_):
        raise RuntimeError("in the middle")

    monkeypatch.setattr(store, "write_metrics", fails)
    with pytest.raises(RuntimeError, match="in the middle"):
        store.save(path, result)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_files_of_living_processes_and_other_files_are_left_alone(tmp_path):
    sleeper = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        with whole_file(tmp_path / "a.txt") as temporary:
            mine = temporary.name
            temporary.write_text("whole")
        theirs = tmp_path / mine.replace(str(os.getpid()), str(sleeper.pid))
        kept = [theirs, tmp_path / ".a.txt.elsewhere.1.tmp", tmp_path / ".b.txt.1.tmp"]
        for leftover in kept:
            leftover.touch()
        with whole_file(tmp_path / "a.txt") as temporary:
            temporary.write_text("again")
        assert sorted(tmp_path.iterdir()) == sorted([tmp_path / "a.txt", *kept])
    finally:
        sleeper.kill()
        sleeper.wait()
    with whole_file(tmp_path / "a.txt") as temporary:
        temporary.write_text("again")
    assert not theirs.exists()


def test_what_cannot_be_written_is_one_line(tmp_path, result):
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "result.h5", tmp_path, Path("/proc/result.h5")):
        with pytest.raises(UserError, match="cannot be written") as caught:
            store.save(path, result)
        assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def refused(path, match):
    with pytest.raises(UserError, match=match) as caught:
        store.load(path)
    assert "\n" not in str(caught.value) and path.name in str(caught.value)


def test_what_is_no_result_is_refused_in_one_line(tmp_path, result):
    path = tmp_path / "r.h5"
    refused(path, "no such file")
    path.write_text("text")
    refused(path, "not an HDF5 file")
    with h5py.File(path, "w"):
        pass
    refused(path, "this is not a result")
    store.save(path, result)
    with h5py.File(path, "a") as file:
        file.attrs["schema_version"] = 2
    refused(path, "schema_version: found 2, expected 1 or older")


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.__delitem__("grid/brdf"),
        lambda file: file.__delitem__("compact/lobe_kind"),
        lambda file: file["grid"].attrs.__delitem__("window"),
        lambda file: (
            file.__delitem__("compact/background"),
            file.create_dataset("compact/background", data=[1.0, 2.0]),
        ),
        lambda file: (file.__delitem__("grid/brdf"), file.create_dataset("grid/brdf", data="text")),
        lambda file: (file.__delitem__("grid/brdf"), file.create_group("grid/brdf")),
        lambda file: file["compact"].attrs.__setitem__("basis", "wavelets"),
        lambda file: file["compact"].attrs.__setitem__("method", "unheard_of"),
        lambda file: file.attrs.__setitem__("versions", "{"),
        lambda file: (
            file.__delitem__("grid/theta_i_deg"),
            file["grid"].create_dataset("theta_i_deg", shape=(2**40,), chunks=(2**20,), dtype="f8"),
        ),
        lambda file: file["plan"].__setitem__("loop", file["plan"]),
    ],
    ids=["no brdf", "no kind", "no window", "shape", "text", "group", "basis", "method", "json", "huge", "cycle"],
)
def test_a_damaged_result_is_refused_in_one_line(tmp_path, result, damage):
    path = tmp_path / "r.h5"
    store.save(path, result)
    with h5py.File(path, "a") as file:
        damage(file)
    refused(path, "r.h5")


@pytest.mark.parametrize("change", [8, 2**8, 2**60])
def test_a_text_of_another_length_is_refused_before_the_library_follows_it(tmp_path, result, change):
    path = tmp_path / "r.h5"
    store.save(path, result)
    whole = path.read_bytes()
    heaps = [match.start() for match in re.finditer(re.escape(hdf5.TEXTS), whole)]
    assert heaps
    for heap in heaps:
        damaged = bytearray(whole)
        place = (
            heap + 16 + 8
        )  # the size of its first object; where the next one begins elsewhere, HDF5 may loop for ever
        damaged[place : place + 8] = (int.from_bytes(damaged[place : place + 8], "little") + change).to_bytes(
            8, "little"
        )
        path.write_bytes(damaged)
        refused(path, f"the texts at byte {heap} do not end")
    damaged = bytearray(whole)
    damaged[heaps[0] + 8 : heaps[0] + 16] = len(whole).to_bytes(8, "little")
    path.write_bytes(damaged)
    refused(path, "do not end")


def test_flipped_and_cut_bytes_are_refused_or_harmless(tmp_path, rng, result):
    path = tmp_path / "r.h5"
    store.save(path, result)
    whole = path.read_bytes()
    for length in rng.integers(1, len(whole), 10):
        path.write_bytes(whole[:length])
        refused(path, "r.h5")
    with h5py.File(tmp_path / "r.h5", "w"):
        pass
    path.write_bytes(whole)
    with h5py.File(path) as file:
        start = file["grid/brdf"].id.get_chunk_info(0).byte_offset
    path.write_bytes(whole[: start + 100] + bytes([whole[start + 100] ^ 1]) + whole[start + 101 :])
    refused(path, "damaged")


def test_describe_says_what_it_is(tmp_path, result):
    store.save(tmp_path / "r.h5", result)
    lines = store.describe(tmp_path / "r.h5")
    assert "schema 1" in lines[0]
    assert any("method paper" in line for line in lines)
    assert any("29 of 30" in line for line in lines)
