"""What an earlier result holds is not computed again, and is the same."""

import dataclasses

import numpy as np
import pytest
from problems import scattered_samples

import sbrdf_jax.pipeline
import sbrdf_jax.resampling.guided as guided
from sbrdf_jax import reuse
from sbrdf_jax.cli import main
from sbrdf_jax.config import parse_config, resolve
from sbrdf_jax.formats import read, write_samples
from sbrdf_jax.grid import make_grid
from sbrdf_jax.masks import write_footprint
from sbrdf_jax.metrics import measure
from sbrdf_jax.needs import everything
from sbrdf_jax.options import GridOptions, ResampleOptions
from sbrdf_jax.pipeline import prepare
from sbrdf_jax.resampling import resample
from sbrdf_jax.runtime import versions
from sbrdf_jax.store import load

GRID = ["grid.theta_i_step_deg=22.5", "grid.theta_o_step_deg=22.5", "grid.phi_o_step_deg=45", "output.report=false"]
GUIDED = ResampleOptions("guided", "data", "factor", 1e-6)


def measured():
    return scattered_samples(np.random.default_rng(3), [0.0, 30.0, 60.0, 80.0], 60, 9)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a measurement, its config, and a result of three of its wavelengths."""
    folder = tmp_path_factory.mktemp("reuse")
    samples = measured()
    write_samples(folder / "small.csv", samples)
    (folder / "config.yaml").write_text("input: {path: small.csv}\n")
    assert main(command(folder, "some.h5", scene_of(samples.wavelength_nm[[1, 4, 7]]))) == 0
    return folder


def scene_of(wavelength_nm) -> str:
    return f"scene={{wavelength_nm: {list(map(float, wavelength_nm))}}}"


def command(folder, output: str, *overrides: str, earlier: str | None = None) -> list[str]:
    resume = [] if earlier is None else [f"runtime.resume_from={folder / earlier}"]
    return ["run", str(folder / "config.yaml"), *GRID, f"output.path={folder / output}", *resume, *overrides]


@pytest.fixture
def solved(monkeypatch):
    """How many wavelengths each call of the solver was given, and how often a whole measurement was estimated."""
    counts: dict[str, list[int]] = {"solved": [], "estimated": []}
    solve, estimate = guided.solve_field, guided.estimate

    def count_solved(estimates, centres, needed, *args):
        counts["solved"].append(int(needed.sum()))
        return solve(estimates, centres, needed, *args)

    def count_estimated(*args):
        counts["estimated"].append(1)
        return estimate(*args)

    monkeypatch.setattr(guided, "solve_field", count_solved)
    monkeypatch.setattr(guided, "estimate", count_estimated)
    return counts


def test_another_target_recomputes_the_representation_only(folder, solved):
    some = load(folder / "some.h5")
    nm = some.gridded.wavelength_nm
    more = ["represent.target={numbers: 100}"]
    assert main(command(folder, "target.h5", scene_of(nm), *more, earlier="some.h5")) == 0
    found = load(folder / "target.h5")
    assert solved == {"solved": [], "estimated": []}
    np.testing.assert_array_equal(found.gridded.brdf, some.gridded.brdf)
    np.testing.assert_array_equal(found.gridded.standard_error, some.gridded.standard_error)
    assert found.metrics["compression_ratio"] != some.metrics["compression_ratio"]


def test_another_storage_recomputes_the_representation_only(folder, solved, capsys):
    wide = load(folder / "some.h5")
    scene = scene_of(wide.gridded.wavelength_nm)
    assert main(command(folder, "narrow.h5", scene, "represent.storage=quantised", earlier="some.h5")) == 0
    assert solved == {"solved": [], "estimated": []}
    found = load(folder / "narrow.h5")
    np.testing.assert_array_equal(found.gridded.brdf, wide.gridded.brdf)
    assert (wide.compact.storage, found.compact.storage) == ("float64", "quantised")
    assert found.metrics["stored_bytes"] < 0.6 * wide.metrics["stored_bytes"]
    assert (wide.metrics["storage_error"] == 0).all() and np.nanmax(found.metrics["storage_error"]) > 0
    assert "bytes as quantised, whose rounding adds at most" in capsys.readouterr().err
    # what is stored of the form is what is read back, not the numbers before rounding
    again = measure(found.gridded, found.field, found.compact)
    for name in ("relative_error", "relative_error_between", "delta_e_median"):
        np.testing.assert_allclose(again.value[name], found.metrics[name], rtol=1e-6, atol=1e-12)
    assert (found.metrics["relative_error"] != wide.metrics["relative_error"]).any()


def test_more_wavelengths_compute_what_is_new(folder, solved):
    some = load(folder / "some.h5")
    nm = load_wavelengths(folder)
    assert main(command(folder, "more.h5", scene_of(nm[1:8]), earlier="some.h5")) == 0
    assert solved == {"solved": [4], "estimated": []}
    assert main(command(folder, "alone.h5", scene_of(nm[1:8]))) == 0
    found, alone = load(folder / "more.h5").gridded, load(folder / "alone.h5").gridded
    np.testing.assert_array_equal(found.wavelength_nm, nm[1:8])
    np.testing.assert_array_equal(found.brdf[..., [0, 3, 6]], some.gridded.brdf)
    for name in ("brdf", "standard_error"):
        wanted = getattr(alone, name)
        np.testing.assert_allclose(getattr(found, name), wanted, rtol=0, atol=1e-9 * wanted.max())
    np.testing.assert_allclose(found.field.half, alone.field.half, rtol=0, atol=1e-9)


def test_fewer_of_a_result_are_taken_from_it(folder, solved):
    nm = load_wavelengths(folder)
    scene = f"scene={{theta_i_deg: [45], wavelength_nm: [{nm[4]}]}}"
    assert main(command(folder, "fewer.h5", scene, earlier="some.h5")) == 0
    found, some = load(folder / "fewer.h5").gridded, load(folder / "some.h5").gridded
    assert solved == {"solved": [], "estimated": []}
    np.testing.assert_array_equal(found.brdf, some.brdf[2:3, ..., 1:2])


def test_another_grid_keeps_the_fit(folder, solved):
    known = load(folder / "some.h5").gridded
    samples, chosen = measured(), np.isin(np.arange(9), [1, 4, 7])
    finer = make_grid(samples, GridOptions(22.5, 22.5, 30.0), bilateral=True)
    needs = dataclasses.replace(everything(finer, 9), wavelength=chosen)
    found = resample(samples, finer, GUIDED, needs=needs, known=known)
    assert solved["estimated"] == [] and sum(solved["solved"]) == 0
    assert found.brdf.shape[2] == 13
    np.testing.assert_allclose(found.brdf[:, :, ::3], np.asarray(known.brdf)[:, :, ::2], rtol=1e-9, atol=1e-12)


def test_a_change_of_output_recomputes_nothing(folder, solved, monkeypatch):
    nm = load(folder / "some.h5").gridded.wavelength_nm

    def refuse(*_args, **_kwargs):
        raise AssertionError("computed again")

    for stage in ("resample", "represent_with_plan", "encode_field", "measure"):
        monkeypatch.setattr(sbrdf_jax.pipeline, stage, refuse)
    assert main(command(folder, "same.h5", scene_of(nm), earlier="some.h5")) == 0
    found, some = load(folder / "same.h5"), load(folder / "some.h5")
    np.testing.assert_array_equal(found.gridded.brdf, some.gridded.brdf)
    np.testing.assert_array_equal(found.compact.core, some.compact.core)
    assert f"resume_from: {folder / 'some.h5'}" in found.config


def test_a_mask_that_has_changed_is_computed_anew(folder, solved):
    grid = make_grid(measured(), GridOptions(22.5, 22.5, 45.0), bilateral=True)
    axes = (grid.theta_i, grid.theta_o, grid.phi_o[: grid.num_azimuths])
    count, nm = np.zeros(tuple(map(len, axes)), int), load(folder / "some.h5").gridded.wavelength_nm
    scene = f"scene={{footprint: {folder / 'foot.h5'}, wavelength_nm: {list(map(float, nm))}}}"
    sizes = []
    for place, output in ((1, "first.h5"), (3, "second.h5")):
        count[place, 1, 2] = 1
        write_footprint(folder / "foot.h5", axes, {"paint": count})
        earlier = "some.h5" if place == 1 else "first.h5"
        assert main(command(folder, output, scene, earlier=earlier)) == 0
        sizes.append(len(load(folder / output).gridded.theta_i))
    assert sizes == [3, 5]


def test_a_dead_wavelength_does_not_hinder_resuming(solved):
    samples = measured()
    value = samples.value.copy()
    value[:, 0], value[:, 8] = np.nan, 0.0
    samples = dataclasses.replace(samples, value=value)
    grid = make_grid(samples, GridOptions(22.5, 22.5, 45.0), bilateral=True)
    whole = everything(grid, 9)
    some = dataclasses.replace(whole, wavelength=np.isin(np.arange(9), [1, 4, 7]))
    known = resample(samples, grid, GUIDED, needs=some)
    found = resample(samples, grid, GUIDED, needs=whole, known=known)
    assert solved["solved"] == [3, 4] and solved["estimated"] == [1]
    np.testing.assert_array_equal(np.asarray(found.brdf)[..., [1, 4, 7]], known.brdf)
    assert np.isnan(np.asarray(found.brdf)[..., 0]).all() and not np.asarray(found.brdf)[..., 8].any()


def test_method_paper_takes_over_wavelengths():
    samples, options = measured(), ResampleOptions("paper", 1.0, "factor", 1e-8)
    grid = make_grid(samples, GridOptions(22.5, 22.5, 45.0), bilateral=True)
    whole = everything(grid, 9)
    some, more = (dataclasses.replace(whole, wavelength=np.isin(np.arange(9), w)) for w in ([0, 1, 2], [1, 2, 3, 4]))
    first = resample(samples, grid, options, needs=some)
    second = resample(samples, grid, options, needs=more, known=first)
    np.testing.assert_array_equal(second.brdf[..., :2], np.asarray(first.brdf)[..., 1:])
    np.testing.assert_array_equal(second.wavelength_nm, samples.wavelength_nm[1:5])
    assert np.isfinite(second.brdf).all() and (np.asarray(second.kkt_residual) <= 1e-8).all()


def test_what_cannot_be_reused_is_said(folder, capsys, solved):
    nm = load_wavelengths(folder)
    other = ["resample.smoothness_weight=0.01"]
    assert main(command(folder, "other.h5", scene_of(nm[:3]), *other, earlier="some.h5")) == 0
    assert "nothing of it is used" in " ".join(load(folder / "other.h5").warnings) and solved["solved"] == [3]
    capsys.readouterr()
    assert main(command(folder, "none.h5", earlier="nowhere.h5")) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "runtime.resume_from" in error and "no such file" in error


@pytest.mark.parametrize("package", ["sbrdf-jax", "jax", "numpy"])
def test_what_other_code_has_computed_is_not_reused(folder, monkeypatch, package):
    path = folder / "some.h5"
    options = resolve(parse_config(load(path).config))
    raw = read(options.input.path, options.input)
    ready = prepare(raw, options)
    assert reuse.read_earlier(str(path), raw, options, ready.needs, ready.folds) is not None
    other = versions() | {package: "0.0"}
    monkeypatch.setattr(reuse, "versions", lambda: other)
    assert reuse.read_earlier(str(path), raw, options, ready.needs, ready.folds) is None


def load_wavelengths(folder) -> np.ndarray:
    """All wavelengths of the measurement."""
    return np.asarray(load(folder / "some.h5").plan["scene"]["wavelength_nm"])


def test_the_reused_options_are_those_that_were_stored(folder):
    config = load(folder / "some.h5").config
    assert resolve(parse_config(config)).output.path == str(folder / "some.h5")
