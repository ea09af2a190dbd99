"""`python -m sbrdf_jax.report`: see `sbrdf_jax/commands/report.py`."""

from sbrdf_jax.cli import main_exit

if __name__ == "__main__":
    main_exit("report")
