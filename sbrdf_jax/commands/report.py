"""`sbrdf report`: figures and one page of one or more results."""

import argparse
from pathlib import Path

SUMMARY = "Figures (PNG) and one self-contained page of one or more results."
EXAMPLE = """\
example:
  sbrdf report results/quickstart.h5 --output results/quickstart

Writes FOLDER/index.html and FOLDER/*.png. Where a result's measurement is still there, unchanged,
its samples are shown beside the grid."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("results", metavar="RESULT.h5", nargs="+", help="results of sbrdf run")
    parser.add_argument("--output", required=True, metavar="FOLDER", help="where the page and the figures go")


def run(args: argparse.Namespace) -> int:
    """Write the report; exit code 0."""
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    from sbrdf_jax.report import write_page
    from sbrdf_jax.store import load

    results = [(Path(path).stem, load(path)) for path in args.results]
    print(write_page(results, args.output))
    return 0
