"""The harness of the benchmarks: what a record must hold, and what is made of records; no time is ever asserted."""

import dataclasses
import json
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from problems import scattered_samples

from benchmarks import lobe_fits, roofline
from benchmarks.library import summary
from benchmarks.pages import MARKS, newest, page, with_quick_table
from benchmarks.peers import missing
from benchmarks.plots import draw
from benchmarks.records import MEASURED, Record, Timing, as_line, machine, read_lines, read_runs, record_of, timed
from benchmarks.stability import certified
from benchmarks.tables import USUAL, exponents, print_tables
from sbrdf_jax.grid import make_grid
from sbrdf_jax.options import GridOptions
from sbrdf_jax.records import Status
from sbrdf_jax.resampling.normal import normal_equations


def a_record(*, error=0.1, seconds=(2.0, 1.0, 1.5), samples=100, residual: float | None = None) -> Record:
    return record_of(
        Timing(seconds[0], tuple(seconds[1:]), 2**20),
        group="resampling",
        problem="planted",
        method="own",
        setting=f"samples {samples}",
        size={"samples": samples},
        error=error,
        error_kind="relative error",
        kkt_residual=residual,
    )


def test_a_record_holds_a_finite_time_and_error():
    record = a_record()
    assert (record.seconds_min, record.seconds_median, record.seconds_spread, record.repeats) == (1.0, 1.25, 0.5, 2)
    assert record.compile_seconds == 1.0
    once = a_record(seconds=(2.0,))
    assert (once.seconds_min, once.compile_seconds, once.repeats) == (2.0, 0.0, 1)
    many: tuple[dict[str, Any], ...] = ({"error": np.nan}, {"error": np.inf}, {"seconds": (np.inf,)})
    for wrong in many:
        with pytest.raises(ValueError, match="must be finite"):
            a_record(**wrong)


def test_timing_runs_once_and_then_warm():
    runs = []
    result, timing = timed(lambda: runs.append(0) or len(runs), 3)
    assert result == 4 and len(timing.warm) == 3 and timing.peak_bytes > 2**20


def test_lines_of_json_read_back_and_say_where_they_come_from(tmp_path):
    records, shared = [a_record(residual=1e-9), a_record(samples=200)], machine()
    path = tmp_path / "records.jsonl"
    path.write_text("".join(as_line(record, shared) + "\n" for record in records))
    assert read_lines(path) == records
    assert read_runs(path) == [(record, shared) for record in records]
    line = json.loads(path.read_text().splitlines()[0])
    assert line.keys() >= {"problem", "method", "precision", "size", "error", "error_kind", "repeats", "kkt_residual"}
    assert line.keys() >= set(MEASURED) | {"versions", "cpu", "device", "threads", "load", "commit", "created_utc"}
    assert "jax" in line["versions"] and "commit" in line


def test_a_group_yields_whole_records():
    found = list(lobe_fits.records(40, loop_lanes=4, repeats=1))
    assert len(found) == 3 and all(record.size and record.precision == "float64" for record in found)
    assert all(record.peak_bytes > 2**20 and record.error < 0.1 for record in found)


def test_the_step_of_the_roofline_has_as_many_operations_as_xla_counts(tmp_path, rng):
    samples = scattered_samples(rng, [0.0, 30.0, 60.0], 60, 1)
    options = GridOptions(theta_i_step_deg=15.0, theta_o_step_deg=15.0, phi_o_step_deg=15.0)
    grid = make_grid(samples, options, bilateral=True)
    operator, rhs = normal_equations(samples, grid, 1.0)
    double = jnp.dtype("float64")
    roofs = roofline.product_record(double, 64, 1), roofline.copy_record(double, 2**16, 1)
    roof = roofs[0].more["GFLOP/s"], roofs[1].more["GB/s"]
    step = roofline.step_record(operator, rhs, 3, double, roof, 1, "planted")
    assert 0.9 < step.more["XLA's operations over counted"] < 1.1
    assert step.more["XLA's bytes over counted"] > 1  # those counted are the least that must move
    copy = dataclasses.replace(roofs[1], problem="planted")
    assert all(record.error < 1e-13 for record in (*roofs, step))
    assert draw([*roofs, copy, step], tmp_path)["roofline"].stat().st_size > 1000


def test_tables_and_plots_are_made_of_records(tmp_path, capsys):
    records = [a_record(samples=count, seconds=(9.0, count**1.5)) for count in (100, 200, 400)]
    print_tables(records)
    printed = capsys.readouterr().out
    assert "over samples, exponent of the warm time 1.50, of the peak memory 0.00" in printed
    assert list(exponents(records[:2])) == []
    pictures = draw(records, tmp_path / "pictures")
    assert pictures.keys() == {"resampling"}
    assert pictures["resampling"].name == "benchmark_resampling.png" and pictures["resampling"].stat().st_size > 1000


def test_a_sweep_holds_the_usual_size(tmp_path):
    usual = dataclasses.replace(a_record(samples=200, seconds=(9.0, 4.0)), setting=USUAL, group="pipeline")
    swept = [a_record(samples=count, seconds=(9.0, count / 50)) for count in (400, 100)]
    (line,) = exponents([usual, *swept])
    assert "exponent of the warm time 1.00" in line
    assert draw([usual], tmp_path) == {}  # one size is no sweep
    in_group = [dataclasses.replace(record, group="pipeline") for record in swept]
    assert draw([usual, *in_group], tmp_path)["pipeline"].stat().st_size > 1000


def run_of(device: str, created_utc: str) -> dict[str, Any]:
    return machine() | {"device": device, "created_utc": created_utc, "suite": "quick"}


def test_pages_take_the_last_run_and_set_devices_side_by_side():
    old, new, other = run_of("cpu", "1"), run_of("cpu", "2"), run_of("a GPU", "3")
    fast = a_record(seconds=(1.0, 0.5))
    found = newest([(a_record(error=0.7), old), (a_record(), new), (fast, other)])
    assert [run["created_utc"] for _, run in found] == ["2", "3"]
    text = "\n\n".join(page(found, {"fuzzing": [{"reader": "csv", "inputs": 9, "wrong": 0, "seconds": 1.0}]}, {}))
    assert "| planted | own | samples 100 | float64 | 1 | 0.5 | 2 |" in text  # seconds, and how many times as fast
    assert "| csv | 9 | 0 | 1 |" in text and "0.7" not in text
    assert "| own | samples 100 | float64 | 0 | 1 | 1 | 1.25 | 0.5 | 1 | 0.1 |" in text


def test_the_table_of_the_readme_stands_between_its_marks():
    found = [(a_record(), run_of("cpu", "1"))]
    text = with_quick_table(f"before\n{MARKS[0]}\nold\n{MARKS[1]}\nafter", found)
    assert text.startswith("before\n") and text.endswith("\nafter") and "old" not in text
    assert "| resampling: planted | own | samples 100 | float64 | 1 | 1 | 0.1 |" in text
    assert with_quick_table(text, found) == text
    for wrong in ("", MARKS[0], f"{MARKS[1]} {MARKS[0]}"):
        with pytest.raises(ValueError, match="found no marks"):
            with_quick_table(wrong, found)


def test_a_status_that_its_residual_belies_is_not_honest():
    ok, stopped = int(Status.OK), int(Status.MAX_STEPS)
    assert certified([ok, stopped], [1e-9, 1e-3], 1e-8) == {"KKT": 1e-3, "status": "ok 1, max_steps 1", "honest": True}
    assert certified([int(Status.NONFINITE)], [np.nan], 1e-8)["honest"]
    assert not certified([ok], [1e-3], 1e-8)["honest"] and not certified([stopped], [1e-9], 1e-8)["honest"]


def test_missing_peers_are_named_as_they_are_installed():
    assert set(missing()) <= {"optax", "osqp", "scikit-learn"}


def test_the_table_of_a_library_scales_separate_runs_and_says_so():
    worker = {"median_after_first": 2.0, "cpu_median_after_first": 1.9}
    record = {"materials": 64, "samples": 9, "wavelengths": 3, "separate": 2}
    record |= {"workers_1": {"seconds": 160.0} | worker, "workers_2": {"seconds": 80.0} | worker}
    text = "\n".join(summary(record, 20.0))
    assert (record["two_over_one"], record["separate_over_one"], record["separate_over_two"]) == (2.0, 8.0, 16.0)
    assert "20.0 s each, the mean of 2, times 64" in text and "2.00 times as fast (wanted: 1.7)" in text
