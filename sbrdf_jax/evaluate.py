"""`python -m sbrdf_jax.evaluate`: see `sbrdf_jax/commands/evaluate.py`."""

import sys

from sbrdf_jax.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["evaluate", *sys.argv[1:]]))
