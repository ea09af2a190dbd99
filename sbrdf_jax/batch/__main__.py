"""`python -m sbrdf_jax.batch`: see `sbrdf_jax/commands/batch.py`."""

from sbrdf_jax.cli import main_exit

if __name__ == "__main__":
    main_exit("batch")
