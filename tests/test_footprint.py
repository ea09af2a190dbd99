"""Footprints: counters in place of materials, what a scene reaches, and what is refused."""

import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT

from sbrdf_jax.builtin import measure
from sbrdf_jax.cli import main
from sbrdf_jax.config import parse_config, resolve
from sbrdf_jax.errors import UserError
from sbrdf_jax.footprints import PROBE, counters_in_place, find_footprint
from sbrdf_jax.masks import read_mask, widen, write_footprint
from sbrdf_jax.pipeline import prepare, process
from sbrdf_jax.progress import Progress
from sbrdf_jax.resampling.kept import Kept

PATCH = ROOT / "configs" / "scenes" / "flat_patch.xml"


@pytest.fixture(scope="module")
def mitsuba_works():
    """Skip by name where Mitsuba or an LLVM that it takes is not installed."""
    pytest.importorskip("mitsuba", reason="the extra `render` is not installed")
    if subprocess.run([sys.executable, "-c", PROBE], capture_output=True, timeout=120).returncode:
        pytest.skip("Mitsuba's LLVM variant does not start here")


def test_every_named_material_becomes_a_counter(tmp_path):
    path = tmp_path / "scene.xml"
    inner = '<bsdf type="twosided" id="paint"><bsdf type="diffuse"/></bsdf><bsdf type="conductor" id="metal"/>'
    path.write_text(f'<scene version="3.0.0">{inner}<shape type="sphere"><bsdf type="diffuse"/></shape></scene>')
    text, names = counters_in_place(path)
    assert names == ["paint", "metal"] and text.count("sbrdf_counter") == 2
    assert "twosided" not in text and text.count('type="diffuse"') == 1  # the one without a name stays


@pytest.mark.parametrize("text, words", [("<scene", "found no XML"), ("<scene/>", "found no material")])
def test_a_scene_without_materials_is_refused(tmp_path, text, words):
    (tmp_path / "scene.xml").write_text(text)
    with pytest.raises(UserError, match=words):
        counters_in_place(tmp_path / "scene.xml")


def test_a_step_that_divides_nothing_is_refused(tmp_path, capsys):
    assert main(["footprint", str(PATCH), "--output", str(tmp_path / "f.h5"), "--step", "7"]) == 2
    assert "--step: found 7" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_flat_patch_needs_few_directions(mitsuba_works, tmp_path):
    path = tmp_path / "patch.h5"
    words = ["footprint", str(PATCH), "--output", str(path), "--width", "32", "--samples", "16"]
    command = [sys.executable, "-m", "sbrdf_jax.footprint", *words[1:]]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    mask = read_mask(str(path), "scene.footprint")
    assert mask.needed.shape == (13, 13, 25) and 0.01 < mask.needed.mean() < 0.1
    theta_i = np.degrees(mask.theta_i)[mask.needed.any(axis=(1, 2))]
    assert 15 <= theta_i.min() < theta_i.max() <= 75  # the light stands at 45 degrees
    azimuth = np.degrees(mask.phi_o)[mask.needed.any(axis=(0, 1))]
    assert azimuth.max() == pytest.approx(180) and azimuth.min() > 60  # the camera looks from the mirror side
    assert (tmp_path / "patch.png").stat().st_size > 10_000


def test_a_picture_of_what_was_needed_is_that_of_everything(mitsuba_works, tmp_path):
    """Rendered with other samples than the footprint's; what was skipped is nan, and so is what it is read for."""
    found = find_footprint(PATCH, width=48, samples=32)
    write_footprint(tmp_path / "patch.h5", found.axes, found.counts)
    raw, kept = measure("amber_glass", count=120), Kept()
    raw = dataclasses.replace(raw, wavelength_nm=raw.wavelength_nm[::40], value=raw.value[:, ::40])
    grids = {}
    for name, scene in (("everything", "null"), ("needed", f"{{footprint: {tmp_path / 'patch.h5'}}}")):
        options = resolve(parse_config("input: {path: 'builtin:amber_glass'}", [f"scene={scene}"]))
        ready = prepare(raw, options, kept)
        gridded = process(raw, ready, options, Progress(quiet=True), kept).gridded
        whole = np.full((13, 13, 49, 3), np.nan)
        whole[np.isin(np.round(ready.grid.theta_i, 9), np.round(gridded.theta_i, 9))] = gridded.brdf
        grids[name] = whole[:, :, :25]
    skipped = np.isnan(grids["needed"])
    assert skipped.mean() > 0.9 and np.isfinite(grids["everything"]).all()
    grids["spoiled"] = np.where(skipped, np.nan, 2 * grids["everything"])
    np.savez(tmp_path / "grids.npz", **grids)
    words = ["tests.picture", str(PATCH), str(tmp_path / "grids.npz"), str(tmp_path / "pictures.npy")]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-m", *words], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    whole, needed, spoiled = np.load(tmp_path / "pictures.npy")
    assert np.isfinite(needed).all() and whole.max() > 0.01
    assert np.abs(needed - whole).max() < 1e-6
    assert np.abs(spoiled - whole).max() > 1e-3  # the material is what the picture shows


def test_widening_adds_the_neighbours_of_a_cell():
    needed = np.zeros((4, 4, 4), bool)
    needed[1, 1, 0] = True
    wide = widen(needed)
    assert wide.sum() == 3 * 3 * 2 and wide[:3, :3, :2].all()
