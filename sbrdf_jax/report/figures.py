"""All figures of one result: which are drawn, from what, and what stands below each on the page."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sbrdf_jax.config import parse_config
from sbrdf_jax.cutoff import CutoffSpectrum, cutoff_warnings, measure_cutoff
from sbrdf_jax.evaluation import evaluate_in_chunks
from sbrdf_jax.host_blas import one_blas_thread
from sbrdf_jax.records import CompactBRDF, GriddedBRDF, RawSamples, SpectralField
from sbrdf_jax.report import curves, hemisphere, quality
from sbrdf_jax.report.fine_grid import finite_wavelengths, interpolate_finely, pick_incidences, ring_effect
from sbrdf_jax.report.lobe_fits import fit_lobe_kinds
from sbrdf_jax.report.predictions import held_out, schemes_of
from sbrdf_jax.report.style import save_figure, style_context
from sbrdf_jax.store import RunResult
from sbrdf_jax.summary import cleaning_counts


class Drawing(NamedTuple):
    """A figure on disk and the words that belong to it."""

    path: Path
    title: str
    caption: str
    warnings: tuple[str, ...] = ()


class _Sketch(NamedTuple):
    """A figure before it is written."""

    name: str
    figure: Any
    title: str
    caption: str
    warnings: tuple[str, ...] = ()


def draw_figures(result: RunResult, folder: Path, samples: RawSamples | None = None, *, prefix: str = "") -> list[Path]:
    """Draw every figure that a result has the data for, as PNG.

    Args:
        result: The result.
        folder: Existing folder for the files.
        samples: The cleaned samples, for the figures that compare with them; None leaves these out.
        prefix: Before each file name, where several results share the folder.

    Returns:
        The files, in the order of the page.
    """
    return [drawing.path for drawing in draw(result, folder, samples, prefix=prefix)]


def draw(result: RunResult, folder: Path, samples: RawSamples | None = None, *, prefix: str = "") -> list[Drawing]:
    """Draw as `draw_figures` does, and return each figure with its title and caption."""
    drawings = []
    with style_context(), one_blas_thread():
        for sketch in _sketches(result, samples):
            path = save_figure(sketch.figure, Path(folder) / f"{prefix}{sketch.name}.png")
            drawings.append(Drawing(path, sketch.title, sketch.caption, sketch.warnings))
    return drawings


def _sketches(result: RunResult, samples: RawSamples | None) -> Iterator[_Sketch]:
    if finite_wavelengths(result.gridded).size:
        yield from _of_interpolation(result, samples)
    if result.field is not None:
        yield _spectra(result, result.field)
    if "relative_error" in result.metrics:
        yield _errors(result)
    if schemes_of(result.validation):
        yield _held_out(result, samples)
    yield from _of_samples(result, samples)
    yield from _of_physics_and_solver(result)


def _of_interpolation(result: RunResult, samples: RawSamples | None) -> Iterator[_Sketch]:
    grid = result.gridded
    fine = interpolate_finely(grid)
    effect = ring_effect(grid, fine) if grid.field is None else None
    yield _Sketch(
        "plane_of_incidence",
        curves.plane_of_incidence(fine, grid, samples),
        "In the plane of incidence",
        f"The resampled BRDF at {fine.wavelength.text} (the paper's figure 7): interpolation, nodes of the grid and, "
        "where there are any at these incident angles, the samples beside the plane.",
    )
    what, numbers = "The resampled field, read off itself.", ""
    if effect is not None:
        what = "The interpolated field without and with the window of eq. 17 (the paper's figures 8 and 9)."
        numbers = (
            f"Total variation over the hemisphere at {fine.incidences[0].text} incidence: {effect.plain:.4g} rad/sr "
            f"without the window and {effect.windowed:.4g} rad/sr with it; straight lines between the nodes have "
            f"{effect.nodes:.4g}."
        )
    if np.isfinite(fine.windowed).all():  # else no wavelength is visible
        yield _Sketch(
            "color_maps",
            hemisphere.color_maps(fine, grid, effect),
            "In colour",
            f"{what} Each incident angle has one exposure; at 1 × a perfect diffuser is white. {numbers}".rstrip(),
        )
    if effect is not None:
        yield _Sketch(
            "ring_effect",
            curves.ring_curves(fine, grid, effect),
            "The ring effect",
            f"Eq. 5 with and without the window, through the same nodes. {numbers}",
        )
    if result.field is not None and isinstance(result.compact, CompactBRDF):
        degrees = tuple(dict.fromkeys((1, result.compact.max_degree)))
        fits = fit_lobe_kinds(result.field, grid, fine.incidences[0].index, degrees)
        yield _Sketch(
            "lobe_kinds",
            curves.lobe_kinds(fine, grid, fits),
            "Three lobe kinds",
            f"The original against the paper's representation with each lobe kind at {fine.wavelength.text} (its "
            "figure 10). The paper reports 14.3, 14.3 and 11.5 % at L = 1 and below 4.5 % at L = 4, of its own sample.",
        )


def _spectra(result: RunResult, field: SpectralField) -> _Sketch:
    grid = result.gridded
    picked = [incidence.index for incidence in pick_incidences(grid)]
    first, last = picked[0], picked[-1]
    mirror = int(np.argmin(np.abs(np.asarray(grid.theta_o) - np.asarray(grid.theta_i)[last])))
    half = (len(grid.phi_o) - 1) // 2
    places = list(dict.fromkeys([(first, 0, 0), (last, mirror, half), (last, 0, 0)]))
    return _Sketch(
        "spectra",
        curves.spectra(grid, field, result.compact, places),
        "Spectra",
        "Spectra of the grid, of their truncated series, and of the compact form (the paper's figure 11). A Fourier "
        "series starts and ends at the same value, so a spectrum whose ends differ is missed there.",
    )


def _errors(result: RunResult) -> _Sketch:
    return _Sketch(
        "errors",
        quality.errors(result.gridded, result.metrics),
        "Errors of the compact form",
        "Eq. 18 at every incident angle, at the nodes and at the midpoints between them, and what it is made of. "
        "Squares of the parts add up to that of the whole, but for cross terms.",
    )


def _held_out(result: RunResult, samples: RawSamples | None) -> _Sketch:
    return _Sketch(
        "held_out",
        held_out(result.validation, samples),
        "Held-out predictions",
        "Each value was predicted by a fit that did not see its fold. Relative errors are of values above 1e-3 1/sr "
        "(dotted), the median with a bar up to the 90th percentile; what lies below an axis is drawn at its edge.",
    )


def _of_samples(result: RunResult, samples: RawSamples | None) -> Iterator[_Sketch]:
    yield _Sketch(
        "coverage",
        hemisphere.coverage_maps(result.gridded),
        "Coverage",
        "Nodes with a sample within one step, nodes between samples, and nodes beyond the measured range, where the "
        "values are extrapolated.",
    )
    spectra = [] if samples is None else measure_samples(samples, result.gridded)
    if spectra:
        yield _Sketch(
            "cutoff",
            quality.cutoff(spectra),
            "Samples against the cut-off",
            "The power of samples and residual over angular frequency (the paper's figures 2 to 5), found degree by "
            "degree in harmonics that are made orthogonal on the samples, so that scattered sampling leaks nothing. "
            "What lies beyond the cut-off is filtered if it is noise and aliased if it is signal.",
            tuple(cutoff_warnings(spectra)),
        )
    counts = cleaning_counts(result)
    if counts and result.clean is not None:
        yield _Sketch(
            "cleaning",
            quality.cleaning(counts, result.clean.num_rows),
            "Cleaning",
            "What was dropped, clipped, folded or flagged; flagged samples are kept.",
        )


def _of_physics_and_solver(result: RunResult) -> Iterator[_Sketch]:
    if np.isfinite(result.metrics.get("albedo", np.nan)).any():
        absolute = result.input.get("quantity", "brdf") == "brdf"
        yield _Sketch(
            "albedo",
            quality.albedo(result.gridded, np.asarray(result.metrics["albedo"]), absolute=absolute),
            "Albedo",
            "The share of light that the grid reflects, for each incident angle. Above 1 it would create energy.",
        )
    yield _Sketch(
        "solver",
        quality.solver(result.gridded, tolerance_of(result)),
        "The solver's certificate",
        "Relative KKT residual of every wavelength's non-negative least squares, of the stored solution.",
    )


def measure_samples(samples: RawSamples, grid: GriddedBRDF) -> list[CutoffSpectrum]:
    """Measure samples and the residual of their fit against the cut-off of the grid, at the wavelengths of both."""
    live = finite_wavelengths(grid)
    value = samples.value[:, np.searchsorted(samples.wavelength_nm, np.asarray(grid.wavelength_nm)[live])]
    finite = np.isfinite(value).all(axis=0)
    live, value, residual = live[finite], value[:, finite], None
    if not live.size:
        return []
    if grid.method == "paper":  # eq. (6) is fitted without the window
        fitted = dataclasses.replace(
            grid,
            brdf=np.asarray(grid.brdf)[..., live],
            wavelength_nm=np.asarray(grid.wavelength_nm)[live],
            window="none",
        )
        residual = value - evaluate_in_chunks(fitted, samples.theta_i, samples.theta_o, samples.phi_o)
    steps = [float(np.diff(axis[:2])[0]) for axis in map(np.asarray, (grid.theta_o, grid.phi_o))]
    return measure_cutoff(
        samples.theta_i,
        samples.theta_o,
        samples.phi_o,
        value,
        residual=residual,
        theta_i_step=float(np.diff(np.asarray(grid.theta_i)[:2]).sum()) if grid.interpolate_theta_i else 0.0,
        theta_o_step=steps[0],
        phi_o_step=steps[1],
    )


def tolerance_of(result: RunResult) -> float | None:
    """The tolerance that the result's config asked for, or None where there is no config."""
    if not result.config:
        return None
    tolerance = parse_config(result.config, name="config of the result").resample.tolerance
    return tolerance if isinstance(tolerance, float) else None
