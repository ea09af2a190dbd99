"""`python -m sbrdf_jax.run`: see `sbrdf_jax/commands/run.py`."""

import sys

from sbrdf_jax.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["run", *sys.argv[1:]]))
