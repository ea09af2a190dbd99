"""Scenes: what they leave is that of the full run, what they skip is nan, and what is impossible is one clear line."""

import dataclasses

import h5py
import numpy as np
import pytest
from problems import scattered_samples
from scipy.interpolate import RegularGridInterpolator

from sbrdf_jax.cli import main
from sbrdf_jax.config import parse_config, resolve
from sbrdf_jax.encoding import encode_field, make_basis
from sbrdf_jax.evaluation import evaluate_in_chunks
from sbrdf_jax.formats import write_samples
from sbrdf_jax.grid import make_grid
from sbrdf_jax.masks import write_footprint
from sbrdf_jax.metrics import error_between
from sbrdf_jax.needs import Needs, everything
from sbrdf_jax.options import GridOptions, RepresentOptions, ResampleOptions, RunOptions
from sbrdf_jax.pipeline import prepare, process
from sbrdf_jax.plan import EQUAL
from sbrdf_jax.progress import Progress
from sbrdf_jax.records import RawSamples
from sbrdf_jax.representation import represent_with_plan
from sbrdf_jax.resampling import resample
from sbrdf_jax.resampling.kept import Kept
from sbrdf_jax.scene import find_needs
from sbrdf_jax.store import load

GRID = ["grid.theta_i_step_deg=22.5", "grid.theta_o_step_deg=22.5", "grid.phi_o_step_deg=45", "output.report=false"]
GUIDED = ResampleOptions(method="guided", smoothness_weight="data", tolerance=1e-6)
PAPER = ["resample.method=paper", "represent.method=paper", "represent.max_degree=1", "represent.lobe=tan"]
NUM_SCENES = 20


@pytest.fixture(scope="module")
def samples() -> RawSamples:
    return scattered_samples(np.random.default_rng(3), [0.0, 30.0, 60.0, 80.0], 60, 9)


@pytest.fixture(scope="module")
def grid(samples):
    return make_grid(samples, GridOptions(22.5, 22.5, 45.0), bilateral=True)


@pytest.fixture(scope="module")
def kept():
    return Kept()


@pytest.fixture(scope="module")
def full(samples, grid, kept):
    return resample(samples, grid, GUIDED, None, kept)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, samples):
    """A folder with the measurement, its config, a full result and one of some wavelengths."""
    folder = tmp_path_factory.mktemp("scene")
    write_samples(folder / "small.csv", samples)
    (folder / "config.yaml").write_text("input: {path: small.csv}\n")
    assert main(command(folder, "full.h5")) == 0
    assert main(command(folder, "some.h5", f"scene={{wavelength_nm: {some_nm(samples)}}}")) == 0
    return folder


def command(folder, output: str, *overrides: str) -> list[str]:
    return ["run", str(folder / "config.yaml"), *GRID, f"output.path={folder / output}", *overrides]


def some_nm(samples) -> list[float]:
    return samples.wavelength_nm[[1, 4, 7]].tolist()


def options_of(*overrides: str) -> RunOptions:
    return resolve(parse_config("input: {path: 'builtin:amber_glass'}", [*GRID, *overrides]))


def test_a_measurement_is_cleaned_once(samples):
    kept, changed = Kept(), dataclasses.replace(samples, value=2 * samples.value)
    first = kept.cleaned(samples, "auto", "guided")
    assert kept.cleaned(dataclasses.replace(samples, value=samples.value.copy()), "auto", "guided") is first
    for other in (kept.cleaned(samples, "auto", "paper"), kept.cleaned(changed, "auto", "guided")):
        assert other is not first
    np.testing.assert_array_equal(kept.cleaned(changed, "auto", "guided").samples.value, changed.value)


def test_what_a_fit_knows_of_the_grid_between_its_nodes_is_not_evaluated_again(full, monkeypatch):
    compact, plan = represent_with_plan(
        encode_field(full, make_basis(np.asarray(full.wavelength_nm), "cosine", 5)), RepresentOptions(), full
    )
    expected = error_between(compact, full)
    monkeypatch.setattr("sbrdf_jax.evaluation.evaluate_directions", None)
    monkeypatch.setattr("sbrdf_jax.evaluation.field_on_axes", None)
    for name, value in error_between(compact, full, plan["half_field"]).items():
        np.testing.assert_allclose(value, expected[name], rtol=1e-12)


def random_needs(rng, grid, number: int) -> Needs:
    """A random cone of directions, at random incident angles and 1, 3 or all wavelengths."""
    whole = everything(grid, 9)
    wavelength = np.isin(np.arange(9), rng.choice(9, (1, 3, 9)[number % 3], replace=False))
    theta_i = np.isin(np.arange(len(grid.theta_i)), rng.choice(len(grid.theta_i), rng.integers(1, 4), replace=False))
    node = whole.node & theta_i[:, None, None]
    if number % 2:
        node &= (grid.theta_o <= rng.uniform(0.2, 1.5))[:, None]
    return Needs(wavelength, node)


@pytest.mark.parametrize("number", range(NUM_SCENES))
def test_what_a_scene_needs_is_that_of_the_full_run(samples, grid, kept, full, number):
    needs = random_needs(np.random.default_rng(number), grid, number)
    found = resample(samples, grid, GUIDED, None, kept, needs)
    for name in ("brdf", "standard_error"):
        wanted = np.asarray(getattr(full, name))[needs.theta_i][..., needs.wavelength]
        part = np.asarray(getattr(found, name))
        needed = needs.node[needs.theta_i]
        assert np.isnan(part[~needed]).all()
        np.testing.assert_allclose(part[needed], wanted[needed], rtol=0, atol=EQUAL["guided"] * wanted.max())
    np.testing.assert_array_equal(found.theta_i, grid.theta_i[needs.theta_i])
    np.testing.assert_array_equal(found.wavelength_nm, samples.wavelength_nm[needs.wavelength])
    np.testing.assert_array_equal(np.asarray(found.status), np.asarray(full.status)[needs.wavelength])


def test_a_new_run_needs_no_kept_estimates(samples, grid, full):
    needs = random_needs(np.random.default_rng(1), grid, 1)
    found = resample(samples, grid, GUIDED, None, None, needs)
    wanted = np.asarray(full.brdf)[needs.theta_i][..., needs.wavelength]
    needed = needs.node[needs.theta_i]
    np.testing.assert_allclose(np.asarray(found.brdf)[needed], wanted[needed], rtol=0, atol=1e-9 * wanted.max())


def test_a_picture_needs_none_of_the_nodes_that_were_skipped(samples, grid, kept, full, rng, tmp_path):
    """Linear interpolation of the nodes, as a renderer does it, in directions that the scene lists."""
    count = 40
    theta_i, theta_o, phi_o = (
        rng.uniform(0.3, 0.6, count),
        rng.uniform(0.2, 1.2, count),
        rng.uniform(0, 2 * np.pi, count),
    )
    rows = np.degrees(np.stack([theta_i, theta_o, phi_o], axis=1))
    path = tmp_path / "directions.csv"
    np.savetxt(path, rows, delimiter=",", header="theta_i_deg,theta_o_deg,phi_o_deg", comments="", fmt="%.17g")
    options = options_of(f"scene={{outgoing: {{directions: {path}}}}}")
    needs = find_needs(options, grid, samples.wavelength_nm)
    assert 0.05 < needs.node.mean() < 0.6
    found = resample(samples, grid, GUIDED, None, kept, needs)
    seen = np.stack([theta_i, theta_o, phi_o], axis=1)
    pictures = []
    for gridded in (found, full):
        axes = (np.asarray(gridded.theta_i), grid.theta_o, grid.phi_o)
        pictures.append(RegularGridInterpolator(axes, np.asarray(gridded.brdf))(seen))
    assert np.isfinite(pictures[0]).all()
    np.testing.assert_allclose(*pictures, rtol=0, atol=1e-6 * pictures[1].max())


def test_needs_are_the_nodes_around_what_a_scene_names(samples, grid):
    def nodes(*overrides):
        return find_needs(options_of(*overrides), grid, samples.wavelength_nm)

    degrees = np.degrees(grid.theta_i)
    assert degrees[nodes("scene={theta_i_deg: [45]}").theta_i].tolist() == [45.0]
    assert degrees[nodes("scene={theta_i_deg: [50, 0]}").theta_i].tolist() == [0.0, 45.0, 67.5]
    assert degrees[nodes("scene={theta_i_deg: {min: 10, max: 45}}").theta_i].tolist() == [0.0, 22.5, 45.0]
    cone = nodes("scene={outgoing: {theta_o_max_deg: 30}}").node
    assert cone[:, :3].all() and not cone[:, 3:].any()
    some = nodes(f"scene={{wavelength_nm: {some_nm(samples)}}}").wavelength
    np.testing.assert_array_equal(np.flatnonzero(some), [1, 4, 7])
    whole = nodes("scene={outgoing: {theta_o_max_deg: 30}}", *PAPER[:1])
    assert whole.node.all()  # its nodes are coupled
    assert nodes("scene={theta_i_deg: [45], outgoing: {theta_o_max_deg: 30}}", *PAPER[1:2]).node[2].all()


def test_a_mask_means_the_cells_that_it_names(samples, grid, tmp_path):
    axes = (grid.theta_i, grid.theta_o, grid.phi_o[: grid.num_azimuths])
    count = np.zeros(tuple(map(len, axes)), int)
    count[2, 1, 2] = 7
    path = tmp_path / "foot.h5"
    write_footprint(path, axes, {"paint": count})
    node = find_needs(options_of(f"scene={{footprint: {path}}}"), grid, samples.wavelength_nm).node
    expected = np.zeros_like(node)
    expected[1:4, 0:3, [1, 2, 3, -2, -3, -4]] = True  # the cell, its neighbours, and their mirror twins
    expected[1:4, 0] = True  # one node at the pole
    np.testing.assert_array_equal(node, expected)
    finer = make_grid(samples, GridOptions(11.25, 11.25, 22.5), bilateral=True)
    fine = find_needs(options_of(f"scene={{footprint: {path}}}"), finer, samples.wavelength_nm).node
    assert fine[::2, ::2, ::2][expected].all() and not fine.all()
    write_footprint(tmp_path / "two.h5", axes, {"paint": count, "wood": count * 0})
    two = f"{tmp_path / 'two.h5'}#paint"
    np.testing.assert_array_equal(
        find_needs(options_of(f"scene={{footprint: '{two}'}}"), grid, samples.wavelength_nm).node, expected
    )


IMPOSSIBLE = {
    "no wavelength in range": ("{wavelength_nm: {min: 900, max: 1000}}", "found 900 to 1000 nm"),
    "not a measured wavelength": ("{wavelength_nm: [123.4]}", "found 123.4 nm"),
    "beyond 90 degrees": ("{theta_i_deg: [95]}", "found 95"),
    "no directions": ("{outgoing: {directions: nowhere.csv}}", "no such file"),
    "a mask that is none": ("{outgoing: {mask: small.csv}}", "found no HDF5 file"),
    "an empty footprint": ("{footprint: empty.h5}", "found no direction that footprint leave"),
    "two materials": ("{footprint: two.h5}", "found the materials a, b"),
    "not one of its materials": ("{footprint: 'two.h5#c'}", "expected 'c' among them"),
    "another file": ("{footprint: full.h5}", "schema_name: found 'sbrdf-result'"),
    "no such illuminant": ("{colour: {illuminant: D66}}", "scene.colour.illuminant: found 'D66'"),
}


@pytest.mark.parametrize("scene, words", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_an_impossible_scene_is_one_line_and_no_file(folder, grid, capsys, scene, words):
    axes = (grid.theta_i, grid.theta_o, grid.phi_o[: grid.num_azimuths])
    nothing = np.zeros(tuple(map(len, axes)), int)
    write_footprint(folder / "empty.h5", axes, {"a": nothing})
    write_footprint(folder / "two.h5", axes, {"a": nothing + 1, "b": nothing})
    (folder / "impossible.yaml").write_text(f"input: {{path: small.csv}}\nscene: {scene}\n")
    words_of_command = ["run", str(folder / "impossible.yaml"), *GRID, f"output.path={folder / 'none.h5'}"]
    assert main(words_of_command) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and words in error
    assert not (folder / "none.h5").exists()


def test_method_paper_solves_a_wavelength_as_the_full_run_does(samples, grid):
    options = ResampleOptions(method="paper", smoothness_weight=1.0, tolerance=1e-8)
    whole = resample(samples, grid, options)
    needs = dataclasses.replace(everything(grid, 9), wavelength=np.isin(np.arange(9), [2, 5]))
    found = resample(samples, grid, options, None, None, needs)
    wanted = np.asarray(whole.brdf)[..., [2, 5]]
    np.testing.assert_allclose(found.brdf, wanted, rtol=0, atol=EQUAL["paper"] * wanted.max())


@pytest.mark.slow
def test_lanes_of_method_paper_are_those_of_the_full_run(samples, tmp_path):
    """The coefficients are the same, and so is the compact form of the incident angles that are left."""
    results = {}
    for name, scene in (("full", ()), ("part", ("scene={theta_i_deg: [22.5, 67.5]}",))):
        options = options_of(*PAPER, *scene)
        with Progress(tmp_path / "log", quiet=True) as progress:
            results[name] = process(samples, prepare(samples, options), options, progress)
    full, part = results["full"], results["part"]
    np.testing.assert_array_equal(np.degrees(part.compact.theta_i), [22.5, 67.5])
    np.testing.assert_array_equal(part.gridded.brdf, full.gridded.brdf)
    for name in ("background", "lobe_height", "lobe_width", "lobe_kind", "lobe_peak_theta_o"):
        np.testing.assert_allclose(getattr(part.compact, name), np.asarray(getattr(full.compact, name))[[1, 3]], 1e-9)
    error = np.asarray(part.metrics["relative_error"])
    assert np.isnan(error[[0, 2, 4]]).all() and np.isfinite(error[[1, 3]]).all()


def test_a_result_keeps_its_scene_and_reads_back(folder, samples):
    whole, some = load(folder / "full.h5"), load(folder / "some.h5")
    assert some.gridded.needed is None and some.gridded.brdf.shape[-1] == 3
    mask = some.plan["scene"]["wavelength_needed"]
    np.testing.assert_array_equal(np.flatnonzero(mask), [1, 4, 7])
    steps = np.asarray(whole.gridded.num_steps)
    assert whole.plan["wavelengths_met_at_start"] == np.count_nonzero(steps == 0)
    kept = np.shape(whole.gridded.field.measured.to_component)[1] or whole.gridded.brdf.shape[-1]
    assert some.plan["spectral_components_kept"] == whole.plan["spectral_components_kept"] == kept
    np.testing.assert_allclose(
        some.gridded.brdf, whole.gridded.brdf[..., [1, 4, 7]], rtol=0, atol=1e-9 * whole.gridded.brdf.max()
    )
    assert (
        main(command(folder, "cone.h5", "scene={outgoing: {theta_o_max_deg: 40}}", "represent.target={error: 0.01}"))
        == 0
    )
    cone = load(folder / "cone.h5")
    assert cone.gridded.needed is not None and np.isnan(cone.gridded.brdf[~cone.gridded.needed]).all()
    assert np.isnan(np.asarray(cone.metrics["albedo"])).all()  # of a part of the hemisphere
    known = ~np.all(cone.gridded.extrapolated == 2, axis=(1, 2))
    assert np.asarray(cone.metrics["relative_error"])[known].max() <= 0.01
    assert np.asarray(cone.metrics["relative_error_between"])[known].max() < 0.05
    value = evaluate_in_chunks(cone.gridded, *np.meshgrid([0.4], [0.1, 0.6], [0.0, 2.0], indexing="ij"))
    wanted = evaluate_in_chunks(whole.gridded, *np.meshgrid([0.4], [0.1, 0.6], [0.0, 2.0], indexing="ij"))
    np.testing.assert_array_equal(value, wanted)


def test_the_error_budget_of_a_scene_ends_the_search(folder):
    assert main(command(folder, "rough.h5", "scene={error_budget: {error: 0.2}}")) == 0
    rough, full = load(folder / "rough.h5"), load(folder / "full.h5")
    known = ~np.all(rough.gridded.extrapolated == 2, axis=(1, 2))
    assert np.asarray(rough.metrics["relative_error"])[known].max() <= 0.2
    assert rough.metrics["compression_ratio"] > full.metrics["compression_ratio"]


def test_the_plan_says_what_is_needed_of_what_there_is(folder, capsys):
    assert main([*command(folder, "planned.h5", "scene={theta_i_deg: [45]}"), "--plan"]) == 0
    text = capsys.readouterr().out
    row = next(line for line in text.splitlines() if line.startswith("represent"))
    assert row.split()[2:4] == ["1", "5"] and "seconds" in text and "MiB" in text
    assert not (folder / "planned.h5").exists()
    with h5py.File(folder / "some.h5") as file:
        assert file["plan/scene/node_needed"].shape == (5, 5, 9)
