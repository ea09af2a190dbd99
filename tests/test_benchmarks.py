"""The harness of the benchmarks: what a record must hold, and what is made of records; no time is ever asserted."""

import json
from typing import Any

import numpy as np
import pytest

from benchmarks.library import summary
from benchmarks.peers import missing
from benchmarks.plots import draw
from benchmarks.records import Record, Timing, as_line, machine, read_lines, record_of, timed
from benchmarks.tables import exponents, print_tables


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
    line = json.loads(path.read_text().splitlines()[0])
    assert {"versions", "cpu", "threads", "commit", "created_utc"} <= line.keys() and "jax" in line["versions"]


def test_tables_and_plots_are_made_of_records(tmp_path, capsys):
    records = [a_record(samples=count, seconds=(9.0, count**1.5)) for count in (100, 200, 400)]
    print_tables(records)
    assert "over samples, exponent of the warm time 1.50, of the peak memory 0.00" in capsys.readouterr().out
    assert list(exponents(records[:2])) == []
    (picture,) = draw(records, tmp_path / "pictures")
    assert picture.name == "resampling.png" and picture.stat().st_size > 1000


def test_missing_peers_are_named_as_they_are_installed():
    assert set(missing()) <= {"optax", "osqp", "scikit-learn"}


def test_the_table_of_a_library_scales_separate_runs_and_says_so():
    worker = {"median_after_first": 2.0, "cpu_median_after_first": 1.9}
    record = {"materials": 64, "samples": 9, "wavelengths": 3, "separate": 2}
    record |= {"workers_1": {"seconds": 160.0} | worker, "workers_2": {"seconds": 80.0} | worker}
    text = "\n".join(summary(record, 20.0))
    assert (record["two_over_one"], record["separate_over_one"], record["separate_over_two"]) == (2.0, 8.0, 16.0)
    assert "20.0 s each, the mean of 2, times 64" in text and "2.00 times as fast (wanted: 1.7)" in text
