"""Scattered samples to a uniform, non-negative grid."""

from collections.abc import Callable

from sbrdf_jax.grid import Grid
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.records import GriddedBRDF, RawSamples
from sbrdf_jax.resampling.geometry import Geometry
from sbrdf_jax.resampling.guided import resample_guided
from sbrdf_jax.resampling.paper import resample_paper


def resample(
    samples: RawSamples,
    grid: Grid,
    options: ResampleOptions,
    report: Callable[[str], None] | None = None,
    geometry: Geometry | None = None,
) -> GriddedBRDF:
    """Resample a measurement by the method that the options name.

    Args:
        samples: Cleaned measurement.
        grid: Nodes and ties, from `make_grid`.
        options: Resolved options.
        report: Told how far it is.
        geometry: What the measurement before it may have worked out, and the next one may use.

    Returns:
        The field on the grid.

    Raises:
        ValueError: The method is not built.
    """
    geometry = geometry or Geometry()
    if options.method == "paper":
        say = None if report is None else (lambda done, total: report(f"{done} of {total} wavelengths converged"))
        return resample_paper(samples, grid, options, say, geometry.inverse)
    if options.method == "guided":
        return resample_guided(samples, grid, options, report, geometry.centres(samples, grid.reciprocal))
    raise ValueError(f"resample method {options.method!r} is not available; it is paper or guided")
