"""How good a result is: errors, albedo, cleaning, the solver's certificate, and the samples against the cut-off."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sbrdf_jax.cutoff import ALIAS_SHARE, CutoffSpectrum
from sbrdf_jax.records import GriddedBRDF
from sbrdf_jax.report.fine_grid import has_no_data, pick_wavelength
from sbrdf_jax.report.style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    LINES,
    MUTED,
    ORANGE,
    PURPLE,
    SERIES,
    SKY,
    VERMILLION,
    new_figure,
)

PAPER_ERROR = 0.045  # what the paper promises at L = 4, at normal incidence
ERROR_CURVES = (
    ("relative_error", "total, at nodes (eq. 18)", INK, "-", "o"),
    ("relative_error_between", "total, between nodes", MUTED, LINES[1], "o"),
    ("relative_error_near_mirror", "total, near mirror direction", PURPLE, LINES[2], "v"),
    ("error_spectral", "spectral truncation", BLUE, "-", "s"),
    ("error_background", "background", GREEN, LINES[3], "^"),
    ("error_lobe", "lobe", VERMILLION, LINES[2], "D"),
)


def incidence_axis(axes: Any, theta_i_deg: np.ndarray) -> None:
    """Label an axis of incident angles; every node has a tick."""
    axes.set_xlabel("incident angle $\\theta_i$ [deg]")
    axes.set_xticks(theta_i_deg if len(theta_i_deg) <= 13 else np.arange(0, 91, 15))
    axes.tick_params(axis="x", labelsize=9)


def shade_without_data(axes: Any, gridded: GriddedBRDF) -> None:
    """Shade the incident angles that no sample supports, and say so once."""
    theta_i = np.degrees(gridded.theta_i)
    half = np.median(np.diff(theta_i)) / 2 if len(theta_i) > 1 else 1.0
    label: str | None = "no data (extrapolated)"
    for index, angle in enumerate(theta_i):
        if has_no_data(gridded, index):
            axes.axvspan(angle - half, angle + half, color=FAINT, alpha=0.55, linewidth=0, zorder=0, label=label)
            label = None


def errors(gridded: GriddedBRDF, metrics: Mapping[str, np.ndarray]) -> Any:
    """Error of the compact form for each incident angle, and what it is made of, on a logarithmic axis."""
    figure = new_figure(width=8.4, height=4.3)
    axes = figure.subplots()
    theta_i = np.degrees(gridded.theta_i)
    for name, label, color, line, marker in ERROR_CURVES:
        if name in metrics:
            value = 100 * np.asarray(metrics[name], float)
            value = np.where(value > 0, value, np.nan)
            axes.plot(theta_i, value, color=color, linestyle=line, marker=marker, markersize=4.5, label=label)
    axes.axhline(100 * PAPER_ERROR, color=ORANGE, linewidth=1.3, label="4.5 %: the paper, L = 4, 0°")
    shade_without_data(axes, gridded)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(_percent)
    incidence_axis(axes, theta_i)
    axes.set_ylabel("relative error η [%]")
    axes.set_title("Error of the compact form against the grid")
    figure.legend(loc="outside right upper", fontsize=9)
    return figure


def albedo(gridded: GriddedBRDF, value: np.ndarray, *, absolute: bool) -> Any:
    """Directional-hemispherical reflectance [theta_i, wavelength] over the incident angle, at three wavelengths."""
    figure = new_figure(width=8.4, height=3.9)
    axes = figure.subplots()
    theta_i, wavelength = np.degrees(gridded.theta_i), np.asarray(gridded.wavelength_nm)
    picked = dict.fromkeys(pick_wavelength(wavelength, wanted).index for wanted in (450.0, 550.0, 650.0))
    low, high = np.nanmin(value, axis=1), np.nanmax(value, axis=1)
    axes.fill_between(theta_i, low, high, color=SKY, alpha=0.25, linewidth=0, label="all wavelengths")
    for index, color, line in zip(picked, (BLUE, GREEN, VERMILLION), LINES, strict=False):
        label = f"{wavelength[index]:g} nm"
        axes.plot(theta_i, value[:, index], color=color, linestyle=line, marker="o", markersize=3.5, label=label)
    if absolute and np.nanmax(value) > 0.8:
        axes.axhline(1.0, color=PURPLE, linewidth=1.3, label="1: all is reflected")
    axes.set_ylim(bottom=0)
    shade_without_data(axes, gridded)
    incidence_axis(axes, theta_i)
    axes.set_ylabel("albedo" if absolute else "albedo [relative]")
    axes.set_title("Directional-hemispherical reflectance of the grid")
    figure.legend(loc="outside right upper", fontsize=9)
    return figure


def solver(gridded: GriddedBRDF, tolerance: float | None) -> Any:
    """The certificate of every wavelength: relative KKT residual and number of steps."""
    figure = new_figure(width=8.4, height=3.6)
    axes = figure.subplots()
    wavelength = np.asarray(gridded.wavelength_nm)
    residual = np.asarray(gridded.kkt_residual, float)
    good = np.asarray(gridded.status) == 0
    shown = np.where(residual > 0, residual, np.nan)
    good, bad = good & np.isfinite(residual), ~good & np.isfinite(residual)
    for chosen, color, marker, label in ((good, BLUE, "o", "reached it"), (bad, VERMILLION, "X", "did not")):
        if chosen.any():
            axes.plot(
                wavelength[chosen], shown[chosen], color=color, marker=marker, markersize=4, linewidth=0, label=label
            )
    for number, lost in enumerate(wavelength[~np.isfinite(residual)]):
        axes.axvline(lost, color=VERMILLION, alpha=0.5, linewidth=1.5, label="not finite" if number == 0 else None)
    if tolerance is not None:
        axes.axhline(tolerance, color=ORANGE, linewidth=1.3, label=f"tolerance {tolerance:.0e}")
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(low / 10, high * 10)  # the ticks are decades
    axes.set_ylabel("relative KKT residual")
    axes.set_xlabel("wavelength [nm]")
    steps = axes.twinx()
    num_steps = np.asarray(gridded.num_steps)
    steps.plot(wavelength, num_steps, color=SKY, linewidth=1.2, linestyle=LINES[2], label="steps (right)")
    steps.set_ylabel("steps of the solver")
    steps.set_ylim(bottom=0)
    steps.grid(visible=False)
    axes.set_title("Optimality of the non-negative least squares, each wavelength")
    figure.legend(loc="outside right upper", fontsize=9)
    return figure


def cleaning(counts: Sequence[tuple[str, str, int]], num_read: int) -> Any:
    """What cleaning did: a bar for each reason, coloured by what was done.

    Args:
        counts: (what was done, flag, number of samples), zeros left out.
        num_read: Samples in the file.

    Returns:
        The figure.
    """
    figure = new_figure(width=8.4, height=1.3 + 0.34 * max(len(counts), 2))
    axes = figure.subplots()
    colors = {"dropped": VERMILLION, "clipped": ORANGE, "flagged": BLUE, "folded": SKY}
    for row, (done, _, number) in enumerate(reversed(counts)):
        axes.barh(row, number, color=colors.get(done, MUTED), height=0.65)
        axes.text(number, row, f"  {number:,} ({100 * number / max(num_read, 1):.2g} %)", va="center", fontsize=9)
    axes.set_yticks(
        range(len(counts)), [done if name == done else f"{done}: {name}" for done, name, _ in reversed(counts)]
    )
    axes.set_xlabel(f"samples, of {num_read:,} read")
    axes.margins(x=0.18)
    axes.set_ylim(-0.7, max(len(counts), 2) - 0.3)
    axes.grid(axis="y", visible=False)
    axes.set_title("Cleaning")
    return figure


def cutoff(spectra: Sequence[CutoffSpectrum]) -> Any:
    """Figures 2 to 5: power of samples and residual against the cut-off, and what the step loses at every incidence."""
    figure = new_figure(width=9.6, height=4.2)
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
    angles = np.degrees([s.theta_i for s in spectra])
    shown = dict.fromkeys(int(np.argmin(np.abs(angles - wanted))) for wanted in (0.0, 15.0, 45.0))
    for index, color in zip(shown, SERIES, strict=False):
        spectrum = spectra[index]
        label = f"$\\theta_i$ = {angles[index]:.4g}°"
        left.plot(*_pairs(spectrum, spectrum.sample_power), color=color, label=label)
        if spectrum.residual_power is not None:
            left.plot(*_pairs(spectrum, spectrum.residual_power), color=color, linestyle=LINES[2], linewidth=1.3)
    left.axvline(spectra[0].cutoff, color=INK, linewidth=1.2, label=f"cut-off π / T = {spectra[0].cutoff:.3g}")
    left.axvspan(spectra[0].cutoff, 1.35 * spectra[0].cutoff, color=FAINT, alpha=0.45, linewidth=0, zorder=0)
    if any(s.residual_power is not None for s in spectra):
        left.plot([], [], color=MUTED, linestyle=LINES[2], linewidth=1.3, label="residual of the fit")
    left.set_yscale("log")
    left.set_xlabel("oscillations per full turn (harmonic degree)")
    left.set_ylabel("power per mode / mean square of samples")
    left.set_title("Spectrum of samples (solid)")
    left.legend(loc="upper right", fontsize=9, frameon=True, framealpha=1.0, edgecolor=FAINT)
    left.set_xlim(0, 1.3 * spectra[0].cutoff)
    above = 100 * np.array([max(s.share_above, 1e-6) for s in spectra])
    right.plot(angles, above, color=BLUE, marker="o", markersize=4.5, label="RMS above the cut-off [%]")
    right.axhline(100 * ALIAS_SHARE, color=ORANGE, linewidth=1.3, label=f"{100 * ALIAS_SHARE:g} %: signal is aliased")
    aliased = [k for k, s in enumerate(spectra) if s.is_narrow or s.is_aliased]
    if aliased:
        right.plot(angles[aliased], above[aliased], color=VERMILLION, marker="X", markersize=8, linewidth=0,
                   label="warned of: narrow lobe or aliased")  # fmt: skip
    right.set_yscale("log")
    right.yaxis.set_major_formatter(_percent)
    right.set_xlabel("incident angle $\\theta_i$ [deg]")
    right.set_ylabel("share of the samples' RMS [%]")
    right.set_title("What the step cannot carry")
    right.legend(loc="upper left", fontsize=9)
    low, high = right.get_ylim()
    right.set_ylim(low, high * 4)  # room for the legend
    return figure


def _pairs(spectrum: CutoffSpectrum, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean power per mode of neighbouring degrees: a lobe at the pole has no odd ones, and its curve would jump."""
    count = len(power) // 2 * 2
    modes = spectrum.num_modes[:count].reshape(-1, 2)
    summed = (power[:count].reshape(-1, 2) * modes).sum(axis=1)
    known = modes.sum(axis=1) > 0
    return spectrum.degree[:count].reshape(-1, 2).mean(axis=1)[known], summed[known] / modes.sum(axis=1)[known]


def _percent(value: float, _position: int) -> str:
    return f"{value:g}"
