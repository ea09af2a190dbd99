"""Scattered samples to a uniform, non-negative grid."""

from collections.abc import Callable

from sbrdf_jax.grid import Grid
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.records import GriddedBRDF, RawSamples
from sbrdf_jax.resampling.paper import resample_paper


def resample(
    samples: RawSamples,
    grid: Grid,
    options: ResampleOptions,
    report: Callable[[int, int], None] | None = None,
) -> GriddedBRDF:
    """Resample a measurement by the method that the options name.

    Args:
        samples: Cleaned measurement.
        grid: Nodes and ties, from `make_grid`.
        options: Resolved options.
        report: Called with (wavelengths converged, wavelengths) as the solver goes.

    Returns:
        The field on the grid.

    Raises:
        ValueError: The method is not built.
    """
    if options.method == "paper":
        return resample_paper(samples, grid, options, report)
    raise ValueError(f"resample method {options.method!r} is not available; it is paper")
