"""`python -m sbrdf_jax.footprint`: see `sbrdf_jax/commands/footprint.py`."""

from sbrdf_jax.cli import main_exit

if __name__ == "__main__":
    main_exit("footprint")
