"""Scattered samples to a uniform, non-negative grid."""

from collections.abc import Callable

import numpy as np

from sbrdf_jax.grid import Grid
from sbrdf_jax.needs import Needs
from sbrdf_jax.nnls import Precision
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.records import GriddedBRDF, RawSamples
from sbrdf_jax.resampling.guided import resample_guided
from sbrdf_jax.resampling.kept import Kept
from sbrdf_jax.resampling.paper import resample_paper
from sbrdf_jax.runtime import require_float64


def resample(
    samples: RawSamples,
    grid: Grid,
    options: ResampleOptions,
    report: Callable[[str], None] | None = None,
    kept: Kept | None = None,
    needs: Needs | None = None,
    known: GriddedBRDF | None = None,
    precision: Precision = "float64",
) -> GriddedBRDF:
    """Resample a measurement by the method that the options name.

    Args:
        samples: Cleaned measurement, all wavelengths of it.
        grid: Nodes and ties, from `make_grid`.
        options: Resolved options.
        report: Told how far it is.
        kept: What the run before it may have worked out, and the next one may use.
        needs: What is needed of it; None: everything. Method "paper" couples all nodes and skips wavelengths alone.
        known: An earlier answer for the same samples, grid and options, of which what is needed is taken over.
        precision: In which the bounded solvers begin; the certificate, and what is solved directly, is float64.

    Returns:
        The field on the grid, at the wavelengths and incident angles that are needed.

    Raises:
        UserError: float64 is off in JAX.
        ValueError: The method is not built.
    """
    require_float64()
    kept = kept or Kept()
    if options.method == "paper":
        say = None if report is None else (lambda done, total: report(f"{done} of {total} wavelengths converged"))
        wanted = np.ones(len(samples.wavelength_nm), bool) if needs is None else needs.wavelength
        parts = {"wanted": wanted, "known": known, "precision": precision}
        return resample_paper(samples, grid, options, say, kept.inverse, **parts)
    if options.method == "guided":
        centres = kept.centres(samples, grid.reciprocal)
        estimates = kept.estimates(samples, options, centres, report, None if known is None else known.field)
        parts = {"estimates": estimates, "needs": needs, "known": known, "precision": precision}
        return resample_guided(samples, grid, options, report, centres, **parts)
    raise ValueError(f"resample method {options.method!r} is not available; it is paper or guided")
