"""`sbrdf evaluate`: CSV in, CSV out, and every wrong input one line with exit code 2 and nothing written."""

import csv

import numpy as np
import pytest
from small_results import UNIFORM_NM, small_compact, small_field, small_grid

from sbrdf_jax import store
from sbrdf_jax.cli import main
from sbrdf_jax.evaluation import evaluate

HEADER = "theta_i_deg,theta_o_deg,phi_o_deg"


@pytest.fixture
def result(tmp_path, rng):
    grid = small_grid(rng, wavelength_nm=UNIFORM_NM)
    result = store.RunResult(gridded=grid, field=small_field(grid), compact=small_compact(rng))
    store.save(tmp_path / "result.h5", result)
    return result


def run(folder, rows, *options, stage="grid", header=HEADER):
    (folder / "at.csv").write_text("\n".join([header, *rows]) + "\n")
    files = [str(folder / name) for name in ("result.h5", "at.csv", "values.csv")]
    return main(["evaluate", files[0], "--at", files[1], "--stage", stage, "--output", files[2], *options])


@pytest.mark.parametrize("stage", ["grid", "compact"])
def test_values_are_those_of_the_function_in_full_precision(tmp_path, result, stage):
    rows = ["30,45,180", "7.50,0,-30", "# a comment", "", "90,90.0,725.5", " 0 , 12.25 , 1e2 "]
    assert run(tmp_path, rows, stage=stage) == 0
    with open(tmp_path / "values.csv", newline="") as file:
        header, *values = csv.reader(file)
    assert header == [*HEADER.split(","), *(f"{w:g}nm" for w in UNIFORM_NM)]
    assert [row[:3] for row in values] == [
        ["30", "45", "180"],
        ["7.50", "0", "-30"],
        ["90", "90.0", "725.5"],
        ["0", "12.25", "1e2"],
    ]
    loaded = store.load_stage(tmp_path / "result.h5", stage)
    angles = np.deg2rad(np.array([row[:3] for row in values], float)).T
    np.testing.assert_array_equal(np.array([row[3:] for row in values], float), evaluate(loaded, *angles))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["at.csv", "result.h5", "values.csv"]


def test_wavelengths_between_the_measured_ones(tmp_path, result):
    assert run(tmp_path, ["30,45,180"], "--wavelengths", "380,555.25", stage="compact") == 0
    header, row = (tmp_path / "values.csv").read_text().splitlines()
    assert header.endswith("phi_o_deg,380nm,555.25nm")
    angles = np.deg2rad([[30.0], [45.0], [180.0]])
    expected = evaluate(store.load_stage(tmp_path / "result.h5", "compact"), *angles, np.array([380, 555.25]))
    np.testing.assert_array_equal(np.array(row.split(",")[3:], float), np.asarray(expected)[0])


def test_no_directions_make_no_rows(tmp_path, result):
    assert run(tmp_path, []) == 0
    assert len((tmp_path / "values.csv").read_text().splitlines()) == 1


@pytest.mark.parametrize(
    ("rows", "options", "text"),
    [
        (
            ["30,45,180", "30,90.5,0"],
            [],
            "at.csv:3: row 1: theta_o_deg: found 90.5, below the horizon, expected 0 to 90",
        ),
        (["30,-1,0"], [], "at.csv:2: row 0: theta_o_deg: found -1, expected 0 to 90"),
        (["91,1,0"], [], "row 0: theta_i_deg"),
        (["30,45,180", "30,nan,0"], [], "row 1: theta_o_deg: found nan, expected a finite number"),
        (["30," + "9" * 400 + ",0"], [], "theta_o_deg: found '" + "9" * 37 + "...', expected a finite number"),
        (["30,45,inf"], [], "row 0: phi_o_deg"),
        (["30,45,x"], [], "row 0: phi_o_deg: found 'x', expected a number"),
        (["30,45"], [], "row 0: found 2 columns, expected 3"),
        (["30,45,0"], ["--uncertainty"], "--uncertainty: the grid stage"),
        (["30,45,0"], ["--wavelengths", "379"], "found 379, expected 380 to 780 nm"),
        (["30,45,0"], ["--wavelengths", "nan"], "found nan, expected 380 to 780 nm"),
        (["30,45,0"], ["--wavelengths", "red"], "expected numbers"),
    ],
)
def test_wrong_input_is_one_line_and_writes_nothing(tmp_path, result, capsys, rows, options, text):
    assert run(tmp_path, rows, *options) == 2
    error = capsys.readouterr().err
    assert text in error and error.count("\n") == 1
    assert not (tmp_path / "values.csv").exists()


def test_wrong_files_are_one_line(tmp_path, result, capsys):
    assert run(tmp_path, ["30,45,0"], header="theta_i,theta_o,phi_o") == 2
    assert "at.csv:1: header: found" in capsys.readouterr().err
    (tmp_path / "empty.csv").touch()
    files = [str(tmp_path / name) for name in ("result.h5", "empty.csv", "values.csv")]
    assert main(["evaluate", files[0], "--at", files[1], "--stage", "grid", "--output", files[2]]) == 2
    assert "found no header" in capsys.readouterr().err
    assert main(["evaluate", files[0], "--at", "none.csv", "--stage", "grid", "--output", files[2]]) == 2
    assert "none.csv: no such file" in capsys.readouterr().err
    assert main(["evaluate", "none.h5", "--at", files[1], "--stage", "grid", "--output", files[2]]) == 2
    assert "none.h5: no such file" in capsys.readouterr().err
    (tmp_path / "at.csv").write_text(f"{HEADER}\n1,2,3\n")
    at = str(tmp_path / "at.csv")
    assert main(["evaluate", files[0], "--at", at, "--stage", "grid", "--output", at]) == 2
    assert "expected another file" in capsys.readouterr().err


def test_a_result_without_the_stage_says_so(tmp_path, rng, capsys):
    store.save(tmp_path / "result.h5", store.RunResult(gridded=small_grid(rng, wavelength_nm=UNIFORM_NM)))
    assert run(tmp_path, ["30,45,0"], stage="compact") == 2
    assert "stage compact: not in this result" in capsys.readouterr().err
