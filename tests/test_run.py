"""The command as its user meets it: exit codes, one clear line, whole files or none, the same result twice."""

import dataclasses
import os
import signal
import subprocess
import sys
import time

import h5py
import jax
import numpy as np
import pytest
from conftest import ROOT
from problems import scattered_samples

from sbrdf_jax.cli import main
from sbrdf_jax.formats import write_samples
from sbrdf_jax.store import load

SMALL_GRID = ["grid.theta_i_step_deg=30", "grid.theta_o_step_deg=22.5", "grid.phi_o_step_deg=45"]
FAST = [
    *SMALL_GRID,
    "resample.method=paper",
    "represent.method=paper",
    "represent.max_degree=1",
    "represent.lobe=angle_squared",
    "output.report=false",
]
HELD_OUT = ["validate.folds=2", "validate.leave_one_theta_i_out=true"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a small measurement and its config."""
    folder = tmp_path_factory.mktemp("run")
    samples = scattered_samples(np.random.default_rng(3), [0.0, 30.0, 60.0, 80.0], 60, 9)
    write_samples(folder / "small.csv", samples)
    (folder / "config.yaml").write_text("input:\n  path: small.csv\n")
    return folder


def command(folder, *overrides: str, output: str = "out.h5") -> list[str]:
    return ["run", str(folder / "config.yaml"), *FAST, *HELD_OUT, f"output.path={folder / output}", *overrides]


@pytest.fixture(scope="module")
def result_path(folder):
    assert main(command(folder)) == 0
    return folder / "out.h5"


def test_result_holds_what_the_contract_names(result_path):
    with h5py.File(result_path) as file:
        for name in ("config", "config_sha256", "source_sha256", "created_utc", "versions"):
            assert name in file.attrs, name
        assert file.attrs["schema_name"] == "sbrdf-result" and file.attrs["schema_version"] == 1
        shape = (4, 5, 9, 9)
        assert file["grid/brdf"].shape == shape and file["grid/extrapolated"].shape == shape[:3]
        for name in ("kkt_residual", "num_steps", "status"):
            assert file[f"grid/{name}"].shape == (9,)
        assert (file["grid/kkt_residual"][()] <= 1e-8).all() and (file["grid/status"][()] == 0).all()
        assert file["spectral/coefficients"].shape == (*shape[:3], 7)
        assert file["compact/background"].shape == (4, 7, 4)
        for name in ("lobe_kind", "lobe_height", "lobe_width", "critical_angle_deg", "status"):
            assert file[f"compact/{name}"].shape == (4, 7), name
        assert file["compact/lobe_peak_theta_o_deg"].shape == (4,)
        assert file["metrics/relative_error"].shape == file["metrics/relative_error_between"].shape == (4,)
        assert file["metrics/relative_error_between_theta_i"].shape == (3,)
        for name in ("compression_ratio", "compression_ratio_paper", "negative_share", "negative_depth"):
            assert file[f"metrics/{name}"].shape == (), name
        for group in ("validation", "validation/leave_one_theta_i_out"):
            assert file[f"{group}/predicted"].shape == (240, 9) and file[f"{group}/fold"].shape == (240,)
            assert np.isfinite(file[f"{group}/predicted"][()]).all() and (file[f"{group}/status"][()] == 0).all()
            assert 0 < file[f"{group}/scores/median_rel"][()] < 1
        assert "plan" in file and "timing/validate" in file

        def check(_name, item):
            if isinstance(item, h5py.Dataset):
                assert "units" in item.attrs, item.name

        file.visititems(check)
        assert [scale.name for scale in file["grid/brdf"].dims[0].values()] == ["/grid/theta_i_deg"]
        brdf = file["grid/brdf"][()]
        assert np.isfinite(brdf).all() and (brdf >= 0).all()
        assert np.ptp(brdf[:, 0], axis=1).max() == 0 and np.ptp(brdf[0], axis=1).max() == 0


def test_same_input_gives_the_same_datasets(folder, result_path):
    assert main(command(folder, output="again.h5")) == 0
    with h5py.File(result_path) as first, h5py.File(folder / "again.h5") as second:

        def compare(name, item):
            if isinstance(item, h5py.Dataset) and not name.startswith("timing"):
                np.testing.assert_array_equal(item[()], second[name][()], err_msg=name)

        first.visititems(compare)


def test_float32_first_gives_the_same_result(folder, result_path):
    assert main(command(folder, "runtime.precision=float32", output="mixed.h5")) == 0
    with h5py.File(result_path) as whole, h5py.File(folder / "mixed.h5") as mixed:
        for name in ("grid/brdf", "validation/predicted"):
            one, other = whole[name][()], mixed[name][()]
            assert one.dtype == other.dtype == np.float64
            np.testing.assert_allclose(other, one, rtol=0, atol=1e-6 * np.abs(one).max())
        assert (mixed["grid/kkt_residual"][()] <= 1e-8).all() and (mixed["grid/status"][()] == 0).all()


def test_a_second_measurement_of_equal_geometry_compiles_nothing(folder, result_path):
    events = []
    jax.monitoring.register_event_duration_secs_listener(lambda event, _seconds, **_kw: events.append(event))
    assert main(command(folder, "input.scale=0.5", output="scaled.h5")) == 0
    assert [event for event in events if event.endswith("backend_compile_duration")] == []


def test_plan_computes_nothing(folder, capsys):
    assert main([*command(folder, output="planned.h5"), "--plan"]) == 0
    planned = capsys.readouterr().out
    assert "wavelengths" in planned and "leave_one_theta_i_out" in planned
    assert not (folder / "planned.h5").exists() and not (folder / "planned.h5.log").exists()


def test_existing_result_is_kept_unless_overwritten(folder, result_path, capsys):
    before = result_path.read_bytes()
    assert main(command(folder)) == 2
    assert "overwrite" in capsys.readouterr().err
    assert result_path.read_bytes() == before


def test_a_dead_wavelength_is_exit_code_3_and_flagged(folder, capsys):
    samples = scattered_samples(np.random.default_rng(3), [0.0, 30.0, 60.0], 60, 9)
    samples.value[:, 4] = np.nan
    write_samples(folder / "dead.h5", samples)
    (folder / "dead.yaml").write_text("input:\n  path: dead.h5\n")
    assert main(["run", str(folder / "dead.yaml"), *FAST, f"output.path={folder / 'dead_out.h5'}"]) == 3
    assert "550 nm" in capsys.readouterr().err
    whole = load(folder / "dead_out.h5")
    assert len(whole.field.basis.wavelength_nm) == 8 and np.isfinite(whole.field.coefficient).all()
    with h5py.File(folder / "dead_out.h5") as file:
        assert list(np.flatnonzero(file["grid/status"][()])) == [4]
        assert np.isfinite(file["grid/brdf"][..., :4]).all()


@pytest.mark.parametrize("methods", [[], ["resample.method=paper", "represent.method=paper"]], ids=["default", "paper"])
def test_a_dead_wavelength_has_a_report_and_can_be_read(folder, methods):
    samples = scattered_samples(np.random.default_rng(3), [0.0, 30.0, 60.0], 60, 9)
    samples.value[:, 4] = np.nan
    write_samples(folder / "dead.h5", samples)
    (folder / "dead.yaml").write_text("input:\n  path: dead.h5\n")
    words = ["run", str(folder / "dead.yaml"), *SMALL_GRID, *methods, f"output.path={folder / 'reported.h5'}"]
    assert main([*words, "output.overwrite=true"]) == 3
    found = load(folder / "reported.h5")
    assert 550.0 not in found.field.basis.wavelength_nm and found.gridded.brdf.shape[-1] == 9
    assert list((folder / "reported_report").glob("*.html"))


def test_what_a_user_would_not_guess_is_a_warning(folder, capsys, monkeypatch):
    monkeypatch.setattr("sbrdf_jax.representation.lobe_tensor.USELESS", 0.1)  # a smooth field: 25 % with 5 numbers
    samples = scattered_samples(np.random.default_rng(3), [0.0, 30.0, 60.0], 150, 5)
    samples.value[:, 2] *= -1
    samples.value[:] *= 1 + 0.5 * np.sin(samples.phi_o)[:, None]
    write_samples(folder / "odd.h5", samples)
    (folder / "odd.yaml").write_text("input:\n  path: odd.h5\n")
    words = [
        *SMALL_GRID,
        "output.report=false",
        "represent.target={numbers: 5}",
        f"output.path={folder / 'odd_out.h5'}",
    ]
    assert main(["run", str(folder / "odd.yaml"), *words]) == 0
    said = capsys.readouterr().err
    assert "no positive value at 550 nm" in said
    assert "the two sides of the plane of incidence differ by" in said
    assert "so few numbers leave an error of" in said


def _lines(folder, name: str, change) -> None:
    lines = (folder / "small.csv").read_text().splitlines()
    (folder / name).write_text("\n".join(change(lines)) + "\n")


def _with_cell(column: int, text: str):
    def change(lines):
        header = next(k for k, line in enumerate(lines) if not line.startswith("#"))
        cells = lines[header + 3].split(",")
        cells[column] = text
        return [*lines[: header + 3], ",".join(cells), *lines[header + 4 :]]

    return change


def _header(change):
    def apply(lines):
        header = next(k for k, line in enumerate(lines) if not line.startswith("#"))
        return [*lines[:header], change(lines[header]), *lines[header + 1 :]]

    return apply


WRONG_FILES = {
    "truncated row": (lambda lines: [*lines[:-1], lines[-1][:25]], "wrong.csv:245"),
    "text where a number belongs": (_with_cell(4, "bright"), "bright"),
    "incident angle above 90": (_with_cell(0, "123"), "123"),
    "duplicate wavelengths": (_header(lambda h: h.replace(h.split(",")[4], h.split(",")[3])), "wavelength"),
    "unknown unit of wavelength": (_header(lambda h: h.replace("nm", "furlong")), "furlong"),
    "three samples": (lambda lines: [line for line in lines if line.startswith(("#", "theta"))] + lines[-3:], "3"),
    "empty": (lambda lines: [], "header"),
}


@pytest.mark.parametrize("case", WRONG_FILES)
def test_wrong_file_is_one_line_and_leaves_nothing(case, folder, tmp_path, capsys):
    change, expected = WRONG_FILES[case]
    _lines(folder, "wrong.csv", change)
    config = folder / "wrong.yaml"
    config.write_text("input:\n  path: wrong.csv\n  format: csv\n")
    assert main(["run", str(config), *FAST, f"output.path={tmp_path / 'new' / 'x.h5'}"]) == 2
    _assert_one_line(capsys, expected)
    assert list(tmp_path.iterdir()) == []


WRONG_COMMANDS = {
    "missing config": (["absent.yaml"], "absent.yaml"),
    "missing input": (["{config}", "input.path=absent.csv"], "absent.csv"),
    "input is a folder": (["{config}", "input.path=."], "folder"),
    "typo in a key": (["{config}", "resample.windw=none"], "window"),
    "unknown quantity": (["{config}", "input.quantity=radiance"], "quantity"),
    "wrong type": (["{config}", "grid.theta_o_step_deg=wide"], "grid.theta_o_step_deg"),
    "step that does not divide": (["{config}", "grid.theta_o_step_deg=7"], "7.5"),
    "output is a folder": (["{config}", "output.path={folder}"], "folder"),
    "output below a file": (["{config}", "output.path={config}/x.h5"], "file"),
    "unknown builtin": (["{config}", "input.path=builtin:green_glass"], "green_glass"),
    "not built yet": (["{config}", "input.format=merl"], "not available yet"),
    "no earlier result": (["{config}", "runtime.resume_from=old.h5"], "runtime.resume_from: old.h5: no such file"),
    "missing fold file": (["{config}", "validate.fold_file=absent.csv"], "absent.csv"),
    "more folds than directions": (["{config}", "validate.folds=1000"], "validate.folds: found 1000"),
    "unknown flag": (["{config}", "--fast"], "--fast"),
}


@pytest.mark.parametrize("case", WRONG_COMMANDS)
def test_wrong_command_is_one_line(case, folder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words, expected = WRONG_COMMANDS[case]
    names = {"config": folder / "config.yaml", "folder": folder}
    try:
        code = main(["run", *(word.format(**names) for word in words)])
    except SystemExit as error:
        code = error.code
    assert code == 2
    _assert_one_line(capsys, expected)
    assert list(tmp_path.iterdir()) == []


def test_no_positive_value_is_refused(folder, tmp_path, capsys):
    samples = scattered_samples(np.random.default_rng(3), [0.0, 30.0, 60.0], 60, 9)
    write_samples(tmp_path / "dark.h5", dataclasses.replace(samples, value=-np.abs(samples.value)))
    places = [f"input.path={tmp_path / 'dark.h5'}", f"output.path={tmp_path / 'out.h5'}"]
    assert main(["run", str(folder / "config.yaml"), *places, *FAST]) == 2
    _assert_one_line(capsys, "no positive value")


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_run_leaves_nothing_under_the_output_name(folder, tmp_path, sent, code):
    words = ["-m", "sbrdf_jax.run", str(folder / "config.yaml"), "grid.theta_i_step_deg=7.5", "output.path=x.h5"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}

    process = subprocess.Popen(
        [sys.executable, *words], cwd=tmp_path, stderr=subprocess.PIPE, text=True, env=environment
    )
    deadline = time.monotonic() + 120
    while not (tmp_path / "x.h5.log").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(sent)
    try:
        _, errors = process.communicate(timeout=240)
    finally:
        process.kill()
    assert process.returncode == code, errors
    assert "Traceback" not in errors
    assert errors.splitlines()[-1].endswith("nothing was written under the output name")
    assert "stopped: " in (tmp_path / "x.h5.log").read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.h5.log"]


def _assert_one_line(capsys, expected: str) -> None:
    errors = capsys.readouterr().err.strip().splitlines()
    assert len(errors) == 1, errors
    assert expected in errors[0]
    assert "Traceback" not in errors[0]
