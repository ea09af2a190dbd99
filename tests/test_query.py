"""Evaluation of a result file at a few wavelengths: the values of the whole result, from few of its bytes."""

import csv
import dataclasses

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_results import small_compact, small_grid
from tolerances import ROUNDING, tolerance

from sbrdf_jax import store
from sbrdf_jax.cli import main
from sbrdf_jax.errors import UserError
from sbrdf_jax.evaluation import evaluate_in_chunks, evaluate_standard_error
from sbrdf_jax.layout import read_guided
from sbrdf_jax.resampling.guided.error_model import ResidualScale
from sbrdf_jax.resampling.guided.field import GuidedField, WholeSpectrum
from sbrdf_jax.resampling.guided.lanes import take_field
from sbrdf_jax.resampling.guided.lobe_model import LobeModel
from sbrdf_jax.resampling.guided.nodes import GRIDS, mirror, mode_variance
from sbrdf_jax.resampling.guided.smoothing import CONSTANT, PRIOR

MEASURED_NM = np.linspace(400.0, 700.0, 101)  # as of the embedded sample
ROUND = tolerance(ROUNDING, np.float64)
ONE = [[555.5], [552.0], [400.0], [699.9]]  # between two measured ones, on one, at either end
NEVER_READ = {"standard_error", "extrapolated", "residual_variance"}


def guided_field(rng, group=6, member=8) -> GuidedField:
    """A field of random numbers, as large as a real one but for its centres."""
    lanes = len(MEASURED_NM)
    residual = {
        name: mirror(jnp.asarray(0.1 * rng.standard_normal((*(axis.count for axis in grid.axes), lanes))))
        for name, grid in GRIDS.items()
    }
    centre = np.stack([*rng.uniform(0.1, 1.2, (2, group, member)), rng.uniform(0, np.pi, (group, member))])
    amplitude = rng.uniform(-3.0, -1.0, (4, lanes))
    return GuidedField(
        wavelength_nm=MEASURED_NM,
        floor=np.array(0.01),
        lobe=LobeModel(np.array([-0.7, -3.0, -1.6, -0.7, 1.0, 1.0, 1.0, 1.0, 0.5]), amplitude),
        theta_limit=np.deg2rad([85.0, 85.0]),
        centre=centre,
        noise=rng.uniform(0.1, 1.0, (group, member)),
        noise_factor=np.ones((group, member)),
        noise_level=np.array(1e-4),
        variance=mode_variance(PRIOR, CONSTANT),
        scale=ResidualScale(rng.uniform(-1, 1, (3, 3, 4)), np.zeros(3), np.array([0.6, 0.6, 2.0])),
        multiplier=rng.standard_normal((group, member, lanes)),
        model_residual=rng.uniform(0, 1e-6, lanes),
        reciprocity_cost=np.array(1.0),
        curve=rng.uniform(size=(2, 5)),
        measured=WholeSpectrum(
            MEASURED_NM, amplitude, np.zeros(lanes), rng.normal(size=(lanes, 3)), rng.normal(size=(3, lanes))
        ),
        **residual,
    )


def grid_of(method: str, rng, interpolate_theta_i: bool):
    """A grid of 101 wavelengths."""
    grid = small_grid(rng, wavelength_nm=MEASURED_NM, interpolate_theta_i=interpolate_theta_i)
    if method == "paper":
        return grid
    errors = {"standard_error": np.ones_like(grid.brdf), "residual_variance": np.ones(grid.brdf.shape[:3])}
    return dataclasses.replace(grid, method="guided", field=guided_field(rng), **errors)


@pytest.fixture(scope="module", params=["guided", "paper"])
def path(request, tmp_path_factory):
    """A result file of either method, its incident angles interpolated."""
    return saved(tmp_path_factory.mktemp("query") / "result.h5", request.param, np.random.default_rng(5))


def saved(path, method, rng, interpolate_theta_i=True):
    grid = grid_of(method, rng, interpolate_theta_i)
    store.save(path, store.RunResult(gridded=grid, compact=small_compact(rng, wavelength_nm=MEASURED_NM)))
    return path


@pytest.fixture
def bytes_read(monkeypatch):
    """Bytes of all chunks that were read, by dataset: a chunk has a checksum, so that it is read whole."""
    found: dict[str, int] = {}
    plain = h5py.Dataset.__getitem__

    def spy(stored, args):
        share = 1.0
        if stored.chunks and isinstance(args, tuple) and args:
            start, stop, _ = args[-1].indices(stored.shape[-1])  # anything but a slice fails here
            length = stored.chunks[-1]
            share = min(1.0, ((stop - 1) // length - start // length + 1) * length / stored.shape[-1])
        found[stored.name] = found.get(stored.name, 0) + round(share * stored.nbytes)
        return plain(stored, args)

    monkeypatch.setattr(h5py.Dataset, "__getitem__", spy)
    return found


def random_directions(rng, num=8):
    return (*rng.uniform(0, 1.5, (2, num)), rng.uniform(0, 6, num))


@pytest.mark.parametrize("wavelength_nm", [*ONE, [650.2, 405.0, 555.5, 405.0], None], ids=str)
def test_the_grid_gives_the_values_of_the_whole_result(path, rng, wavelength_nm):
    whole, part = store.load(path).gridded, store.load_stage(path, "grid", wavelength_nm)
    angles = random_directions(rng)
    expected = evaluate_in_chunks(whole, *angles, wavelength_nm)
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(evaluate_in_chunks(part, *angles, wavelength_nm), expected, rtol=ROUND, atol=1e-14)
    assert len(part.status) == len(part.kkt_residual) == len(part.wavelength_nm)


def test_standard_errors_are_those_of_the_whole_result(tmp_path, rng):
    path, angles, wanted = saved(tmp_path / "r.h5", "guided", rng), random_directions(rng), [552.0, 405.0, 554.5]
    whole, part = store.load(path).gridded, store.load_stage(path, "grid", wanted)
    expected = evaluate_standard_error(whole, *angles, wanted)
    np.testing.assert_allclose(evaluate_standard_error(part, *angles, wanted), expected, rtol=ROUND)


@pytest.mark.parametrize("method", ["guided", "paper"])
def test_few_incident_angles_are_not_interpolated_either_way(tmp_path, rng, method):
    path, angles = saved(tmp_path / "r.h5", method, rng, interpolate_theta_i=False), random_directions(rng)
    expected = evaluate_in_chunks(store.load(path).gridded, *angles, [555.5])
    found = evaluate_in_chunks(store.load_stage(path, "grid", [555.5]), *angles, [555.5])
    np.testing.assert_allclose(found, expected, rtol=ROUND, atol=1e-14)


@pytest.mark.parametrize("wavelength_nm", ONE, ids=str)
def test_one_wavelength_reads_few_bytes_and_no_other_dataset(path, bytes_read, wavelength_nm):
    with h5py.File(path) as file:
        nodes_are_the_field = "field" not in file
        names = ["grid/brdf"] if nodes_are_the_field else ["field/half", "field/azimuth", "field/multiplier"]
        total = sum(file[name].nbytes for name in names)
    store.load_stage(path, "grid", wavelength_nm)
    assert not NEVER_READ & {name.rsplit("/", 1)[-1] for name in bytes_read}
    assert ("/grid/brdf" in bytes_read) == nodes_are_the_field
    assert {name.split("/")[1] for name in bytes_read} <= {"grid", "field"}
    assert sum(bytes_read.values()) < 0.2 * total


def test_scattered_wavelengths_read_no_chunk_twice(path, bytes_read):
    store.load_stage(path, "grid", [405.0, 410.0, 555.5, 690.0])
    large = {name: count for name, count in bytes_read.items() if name.endswith(("/half", "/azimuth", "/brdf"))}
    with h5py.File(path) as file:
        for name, count in large.items():
            if not name.startswith("/field/variance"):
                assert count <= 0.5 * file[name].nbytes, name


def test_the_compact_stage_reads_its_group_alone(path, rng, bytes_read):
    part = store.load_stage(path, "compact", [555.5])
    assert {name.split("/")[1] for name in bytes_read} == {"compact"}
    angles = random_directions(rng)
    expected = evaluate_in_chunks(store.load(path).compact, *angles, [555.5])
    np.testing.assert_allclose(evaluate_in_chunks(part, *angles, [555.5]), expected, rtol=ROUND)


def test_some_wavelengths_of_a_field_are_those_of_the_whole(tmp_path, rng):
    grid = grid_of("guided", rng, True)
    store.save(tmp_path / "r.h5", store.RunResult(gridded=grid))
    for lanes in (np.array([0]), np.array([3, 4, 5, 6]), np.array([0, 9, 10, 60, 100])):
        with h5py.File(tmp_path / "r.h5") as file:
            part, whole = read_guided(file["field"], lanes), read_guided(file["field"])
        jax.tree.map(np.testing.assert_array_equal, part, jax.tree.map(np.asarray, take_field(whole, lanes)))


def test_a_file_of_other_chunks_is_read_alike(path, tmp_path, rng):
    with h5py.File(path) as new, h5py.File(tmp_path / "old.h5", "w") as old:
        old.attrs.update(new.attrs)
        for name in new:
            new.copy(name, old)
        for name in ("grid/brdf", "field/half", "field/azimuth", "field/multiplier"):
            if name in old:
                value = old[name][()]
                del old[name]
                chunks = (1, *value.shape[1:]) if name != "field/azimuth" else None  # contiguous too
                old.create_dataset(name, data=value, chunks=chunks)
    angles, wanted = random_directions(rng), [405.0, 650.2]
    expected = evaluate_in_chunks(store.load_stage(path, "grid", wanted), *angles, wanted)
    found = evaluate_in_chunks(store.load_stage(tmp_path / "old.h5", "grid", wanted), *angles, wanted)
    np.testing.assert_array_equal(found, expected)


def test_a_flipped_bit_is_an_error_where_it_is_read_and_nothing_elsewhere(path, tmp_path):
    with h5py.File(path) as file:
        name = "field/half" if "field" in file else "grid/brdf"
        start = file[name].id.get_chunk_info(0).byte_offset  # of the shortest wavelengths
    image = bytearray(path.read_bytes())
    image[start + 100] ^= 1
    (tmp_path / "r.h5").write_bytes(image)
    with pytest.raises(UserError, match="damaged"):
        store.load_stage(tmp_path / "r.h5", "grid", [405.0])
    store.load_stage(tmp_path / "r.h5", "grid", [655.0])


@pytest.mark.parametrize("stage", ["grid", "compact"])
@pytest.mark.parametrize(("wavelength_nm", "shown"), [([399.0], "399"), ([500, np.nan], "nan"), ([], "none")], ids=str)
def test_a_wavelength_that_was_not_measured_is_one_line(path, stage, wavelength_nm, shown):
    with pytest.raises(UserError, match=f"wavelength: found {shown}, expected 400 to 700 nm, as measured") as caught:
        store.load_stage(path, stage, wavelength_nm)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_what_is_no_stage_is_one_line(path):
    with pytest.raises(UserError, match="stage metrics: not in this result, found grid, compact"):
        store.load_stage(path, "metrics")


def test_the_command_reads_no_more_and_writes_the_same(path, tmp_path, bytes_read, capsys):
    (tmp_path / "at.csv").write_text("theta_i_deg,theta_o_deg,phi_o_deg\n30,45,90\n12,7,200\n")
    words = ["evaluate", str(path), "--at", str(tmp_path / "at.csv"), "--stage", "grid", "--wavelengths", "640,452.5"]
    whole = store.load(path).gridded
    angles = np.deg2rad([[30.0, 12.0], [45.0, 7.0], [90.0, 200.0]])
    expected = [evaluate_in_chunks(whole, *angles, [640, 452.5])]
    if whole.field is not None:
        expected.append(evaluate_standard_error(whole, *angles, [640, 452.5])[0])
        words.append("--uncertainty")
    bytes_read.clear()
    assert main([*words, "--output", str(tmp_path / "values.csv")]) == 0
    assert not NEVER_READ & {name.rsplit("/", 1)[-1] for name in bytes_read}
    with open(tmp_path / "values.csv", newline="") as file:
        _, *rows = csv.reader(file)
    found = np.array([row[3:] for row in rows], float)
    np.testing.assert_allclose(found, np.stack(expected, axis=-1).reshape(2, -1), rtol=ROUND)
    assert main([*words, "--wavelengths", "701", "--output", str(tmp_path / "none.csv")]) == 2
    error = capsys.readouterr().err
    assert "found 701, expected 400 to 700 nm" in error and error.count("\n") == 1
    assert not (tmp_path / "none.csv").exists()
