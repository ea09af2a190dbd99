"""`python -m sbrdf_jax.inspect`: see `sbrdf_jax/commands/inspect.py`."""

import sys

from sbrdf_jax.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["inspect", *sys.argv[1:]]))
