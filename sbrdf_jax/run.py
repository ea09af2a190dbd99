"""`python -m sbrdf_jax.run`: see `sbrdf_jax/commands/run.py`."""

from sbrdf_jax.cli import main_exit

if __name__ == "__main__":
    main_exit("run")
