"""`python -m sbrdf_jax.report`: see `sbrdf_jax/commands/report.py`."""

import sys

from sbrdf_jax.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["report", *sys.argv[1:]]))
