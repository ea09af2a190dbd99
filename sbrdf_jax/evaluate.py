"""`python -m sbrdf_jax.evaluate`: see `sbrdf_jax/commands/evaluate.py`."""

from sbrdf_jax.cli import main_exit

if __name__ == "__main__":
    main_exit("evaluate")
