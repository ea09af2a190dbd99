"""`python -m sbrdf_jax.inspect`: see `sbrdf_jax/commands/inspect.py`."""

from sbrdf_jax.cli import main_exit

if __name__ == "__main__":
    main_exit("inspect")
