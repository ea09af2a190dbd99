"""`python -m sbrdf_jax.sample`: see `sbrdf_jax/commands/sample.py`."""

from sbrdf_jax.cli import main_exit

if __name__ == "__main__":
    main_exit("sample")
