"""`python -m sbrdf_jax.sample`: see `sbrdf_jax/commands/sample.py`."""

import sys

from sbrdf_jax.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["sample", *sys.argv[1:]]))
