"""`sbrdf run CONFIG.yaml`: from a measurement to a result, and figures beside it."""

import argparse
import sys
import time
import traceback
from pathlib import Path

from sbrdf_jax.cli import SOME_LANES_FAILED, UNEXPECTED

SUMMARY = "From a measurement to a result, as a config says."
EXAMPLE = """example:
  sbrdf run configs/quickstart.yaml output.path=results/mine.h5 represent.target.error=0.01

key.path=value is read as YAML; a mapping replaces the whole block. --plan only counts the work.
validate.folds=5 also predicts every sample by a fit that did not see it, and prints the scores.
Exit codes: 0 done, 2 config or input wrong, 3 some lanes did not reach their tolerance (listed)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("config", metavar="CONFIG.yaml", help="the config")
    parser.add_argument("overrides", metavar="key.path=value", nargs="*", help="overrides of the config")
    parser.add_argument("--plan", action="store_true", help="print what would be computed, and compute nothing")


def run(args: argparse.Namespace) -> int:
    """Run one config and return the exit code."""
    from sbrdf_jax.config import check_output, load_config, resolve
    from sbrdf_jax.errors import UserError
    from sbrdf_jax.formats import read
    from sbrdf_jax.runtime import import_ahead, set_up_jax

    start = time.perf_counter()
    options = resolve(load_config(args.config, args.overrides))
    if not args.plan:
        check_output(options)
    set_up_jax()
    raw = read(options.input.path, options.input)

    from sbrdf_jax.pipeline import failed_lanes, prepare
    from sbrdf_jax.plan import plan_text
    from sbrdf_jax.single_run import open_progress, run_to_file
    from sbrdf_jax.summary import summary_text

    ready = prepare(raw, options)
    if args.plan:
        print(plan_text(ready.rows, ready.cost))
        return 0
    import_ahead("colour", *(["sbrdf_jax.report"] if options.output.report else []))
    output = Path(options.output.path)
    with open_progress(output) as progress:
        progress.say(f"{raw.source}: {ready.cleaned.report.num_kept} of {raw.num_samples} samples kept")
        try:
            result = run_to_file(raw, ready, options, progress, time.perf_counter() - start)
            progress.say("\n" + summary_text(result))
        except UserError as error:
            progress.log(f"stopped: {error}")
            raise
        except Exception as error:
            for line in traceback.format_exc().splitlines():
                progress.log(line)
            reason = (str(error).splitlines() or [""])[0]
            print(f"sbrdf run: unexpected {type(error).__name__}: {reason}; see {output}.log", file=sys.stderr)
            return UNEXPECTED
        failures = failed_lanes(result)
        for line in failures:
            progress.say(line)
    return SOME_LANES_FAILED if failures else 0
