"""Progress: what a terminal, a pipe and the log get to see."""

import io

import pytest

from sbrdf_jax.progress import Progress, format_seconds


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Clock:
    """Seconds that pass only when told."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def run(stream, log_path=None, **options):
    clock = Clock()
    with Progress(log_path, stream=stream, clock=clock, **options) as progress:
        with progress.stage("resample") as stage:
            for done in range(3):
                clock.now += 1.5
                progress.update(f"{done + 1} of 3 wavelengths converged")
            stage.compile_seconds = 2.5
        progress.log("only in the log")
        with progress.stage("encode"):
            clock.now += 0.25
        progress.say("a table\nof two lines")
    return progress


def test_a_pipe_gets_one_line_a_stage(tmp_path):
    stream = io.StringIO()
    progress = run(stream, tmp_path / "run.log")
    assert stream.getvalue().splitlines() == [
        "resample     done      4.5 s (compile 2.5 s)  3 of 3 wavelengths converged",
        "encode       done    0.250 s",
        "a table",
        "of two lines",
    ]
    assert progress.seconds == {"resample": 4.5, "encode": 0.25}
    log = (tmp_path / "run.log").read_text().splitlines()
    assert log[1].split(" s  ", 1)[1] == "only in the log"
    assert len(log) == 5 and log[0].startswith("    4.500 s  resample")


def test_a_terminal_gets_one_updating_line():
    stream = Terminal()
    run(stream)
    text = stream.getvalue()
    assert "\r\x1b[2Kresample        3.0 s  2 of 3 wavelengths converged" in text
    assert text.count("\n") == 4  # whole lines only for what is done


def test_updates_are_not_drawn_more_often_than_anyone_reads():
    stream, clock = Terminal(), Clock()
    with Progress(stream=stream, clock=clock) as progress, progress.stage("represent"):
        for lane in range(1000):
            clock.now += 0.001
            progress.update(f"{lane} lanes done")
    assert 5 < stream.getvalue().count("\r") < 20


def test_quiet_writes_only_the_log(tmp_path):
    stream = Terminal()
    run(stream, tmp_path / "run.log", quiet=True)
    assert stream.getvalue() == ""
    assert "resample" in (tmp_path / "run.log").read_text()


def test_a_failing_stage_is_reported_and_not_swallowed(tmp_path):
    stream = io.StringIO()
    with pytest.raises(RuntimeError, match="boom"), Progress(tmp_path / "run.log", stream=stream) as progress:
        with progress.stage("resample"):
            raise RuntimeError("boom")
    assert "failed" in stream.getvalue() and "failed" in (tmp_path / "run.log").read_text()


def test_stages_of_one_name_are_summed_and_stages_nest():
    clock = Clock()
    with Progress(stream=io.StringIO(), clock=clock) as progress:
        for _ in range(2):
            with progress.stage("outer"):
                clock.now += 1
                with progress.stage("inner"):
                    clock.now += 2
    assert progress.seconds == {"inner": 4.0, "outer": 6.0}


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0, "0.000 s"), (0.0324, "0.032 s"), (0.9996, "1.0 s"), (4.06, "4.1 s"), (75.2, "75 s"), (725.0, "12 min 5 s")],
)
def test_seconds_for_a_reader(seconds, text):
    assert format_seconds(seconds) == text
