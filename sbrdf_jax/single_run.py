"""One measurement, prepared, to one result file, and figures beside it."""

import contextlib
import dataclasses
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from sbrdf_jax.config import resolved_yaml
from sbrdf_jax.errors import UserError
from sbrdf_jax.options import RunOptions
from sbrdf_jax.pipeline import Prepared, process
from sbrdf_jax.progress import Progress
from sbrdf_jax.records import RawSamples
from sbrdf_jax.resampling.kept import Kept
from sbrdf_jax.runtime import versions
from sbrdf_jax.stopping import before_stopping
from sbrdf_jax.store import RunResult, save


@contextlib.contextmanager
def open_progress(output: Path, *, quiet: bool = False) -> Iterator[Progress]:
    """Yield what writes the log `<output>.log`; a stop signal, however early, is its last line.

    Raises:
        UserError: The log cannot be written, and so neither can the result.
    """
    log = output.with_name(output.name + ".log")

    def say_so(word: str) -> None:
        with log.open("a", encoding="utf-8") as file:  # whatever state `progress` is in
            file.write(f"stopped: {word}\n")

    with before_stopping(say_so):
        try:
            output.parent.mkdir(parents=True, exist_ok=True)
            progress = Progress(log, quiet=quiet)
        except OSError as error:
            found = f"found a log that cannot be written ({error.strerror})"
            raise UserError(f"{log}: {found}; expected a folder to write to") from None
        with progress:
            yield progress


def run_to_file(
    raw: RawSamples,
    ready: Prepared,
    options: RunOptions,
    progress: Progress,
    set_up_seconds: float,
    kept: Kept | None = None,
) -> RunResult:
    """Run every stage, write the result under `output.path`, and its report where that is asked for.

    Args:
        raw: All rows of a file.
        ready: What `pipeline.prepare` made of it.
        options: Resolved options.
        progress: Told of each stage.
        set_up_seconds: Seconds up to here, for the result's `timing`.
        kept: As for `pipeline.process`.

    Returns:
        The result, as written.

    Raises:
        UserError: The result cannot be written.
    """
    output = Path(options.output.path)
    result = process(raw, ready, options, progress, kept)
    set_up = {"set_up": {"total": set_up_seconds, "compile": 0.0, "run": set_up_seconds}}
    result = dataclasses.replace(
        result,
        config=resolved_yaml(options),
        created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        versions=versions(),
        timing=set_up | dict(result.timing),
    )
    with progress.stage("save"):
        save(output, result)
        progress.update(str(output))
    if options.output.report:
        from sbrdf_jax.report import write_page

        with progress.stage("report"):
            page = write_page([(output.stem, result)], output.with_name(f"{output.stem}_report"), ready.cleaned.samples)
            progress.update(str(page))
    return result
