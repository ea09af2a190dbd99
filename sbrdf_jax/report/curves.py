"""Curves in the plane of incidence and along the spectrum: counterparts of the paper's figures 7, 10 and 11."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sbrdf_jax.encoding import decode
from sbrdf_jax.evaluation import evaluate_in_chunks, measured_wavelengths
from sbrdf_jax.metrics import CHUNK_SIZE
from sbrdf_jax.records import CompactBRDF, GriddedBRDF, LobeHarmonics, LobeTensor, RawSamples, SpectralField
from sbrdf_jax.report.fine_grid import FineGrid, RingEffect, pick_wavelength
from sbrdf_jax.report.lobe_fits import KindFit
from sbrdf_jax.report.style import BLUE, INK, LINES, MUTED, SERIES, VERMILLION, new_figure, plane_axis

PLANE_WIDTH = np.radians(3.0)  # samples this near to the plane of incidence are drawn beside the curves
KIND_TEXT = {
    "angle_squared": "rep 1: exp(−α² / b), eq. 14",
    "tan_squared": "rep 2: exp(−tan² α / b), eq. 15",
    "tan": "rep 3: exp(−tan α / b), eq. 16",
}


def plane_of_incidence(fine: FineGrid, gridded: GriddedBRDF, samples: RawSamples | None) -> Any:
    """Figure 7: the resampled BRDF in the plane of incidence at one wavelength, samples near the plane beside it."""
    figure = new_figure()
    axes = figure.subplots()
    num_shown = 0
    for k, (incidence, color, line) in enumerate(zip(fine.incidences, SERIES, LINES, strict=False)):
        angle, value = fine.plane(fine.windowed, k)
        label = f"$\\theta_i$ = {incidence.text}"
        axes.plot(np.degrees(angle), value, color=color, linestyle=line, label=label, zorder=3)
        nodes, at_nodes = nodes_in_plane(gridded, incidence.index, fine.wavelength.index)
        axes.plot(nodes, at_nodes, color=color, marker="o", markersize=3.4, linewidth=0, zorder=4)
        if samples is not None:
            x, y = samples_in_plane(samples, incidence.value, fine.wavelength.value)
            axes.plot(x, y, color=color, marker="x", markersize=4, alpha=0.45, linewidth=0, zorder=2)
            num_shown += len(x)
    axes.plot([], [], color=MUTED, marker="o", markersize=3.4, linewidth=0, label="nodes of the grid")
    if num_shown:
        axes.plot([], [], color=MUTED, marker="x", markersize=4, linewidth=0, label="samples within 3° of the plane")
    plane_axis(axes)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    axes.set_ylabel(f"BRDF [1/sr] at {fine.wavelength.text}")
    axes.set_title("Resampled BRDF in the plane of incidence")
    axes.legend(loc="best")
    return figure


def nodes_in_plane(gridded: GriddedBRDF, incidence: int, wavelength: int) -> tuple[np.ndarray, np.ndarray]:
    """Signed angles [deg] and values [1/sr] of the nodes in the plane of incidence."""
    theta_o = np.degrees(gridded.theta_o)
    half = (len(gridded.phi_o) - 1) // 2
    plane = np.asarray(gridded.brdf)[incidence, :, :, wavelength]
    return np.concatenate([-theta_o[:0:-1], theta_o]), np.concatenate([plane[:0:-1, 0], plane[:, half]])


def samples_in_plane(samples: RawSamples, theta_i: float, wavelength_nm: float) -> tuple[np.ndarray, np.ndarray]:
    """Signed angles [deg] and values [1/sr] of the samples near the plane of incidence, at the nearest theta_i.

    Only incident angles within half a degree count: a sample of another incidence belongs to another curve.
    """
    along = -np.sin(samples.theta_o) * np.cos(samples.phi_o)
    across = np.sin(samples.theta_o) * np.sin(samples.phi_o)
    near = (np.abs(samples.theta_i - theta_i) < np.radians(0.5)) & (np.abs(across) < np.sin(PLANE_WIDTH))
    angle = np.degrees(np.arctan2(along, np.cos(samples.theta_o)))
    return angle[near], samples.value[near, pick_wavelength(samples.wavelength_nm, wavelength_nm).index]


def ring_curves(fine: FineGrid, gridded: GriddedBRDF, effect: RingEffect) -> Any:
    """The ring effect at the first incidence: eq. (5) with and without the window, and what lies between the nodes."""
    figure = new_figure(height=4.3)
    axes = figure.subplots()
    angle, plain = fine.plane(fine.plain, 0)
    _, windowed = fine.plane(fine.windowed, 0)
    nodes, at_nodes = nodes_in_plane(gridded, fine.incidences[0].index, fine.wavelength.index)
    label = f"no window: total variation {effect.ratio(effect.plain):.2f} × the nodes'"
    axes.plot(np.degrees(angle), plain, color=VERMILLION, linestyle=LINES[1], label=label)
    label = f"window “{gridded.window}”: {effect.ratio(effect.windowed):.2f} ×"
    axes.plot(np.degrees(angle), windowed, color=BLUE, label=label)
    axes.plot(nodes, at_nodes, color=INK, marker="o", markersize=3.6, linewidth=0, label="nodes of the grid")
    plane_axis(axes)
    positive = at_nodes[at_nodes > 0]
    if len(positive) and positive.max() > 30 * np.median(positive):
        axes.set_yscale("symlog", linthresh=float(np.median(positive)))
    axes.set_ylabel(f"BRDF [1/sr] at {fine.wavelength.text}")
    axes.set_title(f"Ring effect of the interpolation, $\\theta_i$ = {fine.incidences[0].text}")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def lobe_kinds(fine: FineGrid, gridded: GriddedBRDF, fits: Sequence[KindFit]) -> Any:
    """Figure 10: the original against its compact form with each lobe kind, at the first incidence; a panel per L."""
    degrees = list(dict.fromkeys(fit.max_degree for fit in fits))
    figure = new_figure(width=9.6, height=4.9)
    panels = figure.subplots(1, len(degrees), sharey=True, squeeze=False)[0]
    angle, original = fine.plane(fine.windowed, 0)
    nodes, at_nodes = nodes_in_plane(gridded, fine.incidences[0].index, fine.wavelength.index)
    theta_i, phi_o = np.full(angle.shape, fine.incidences[0].value), np.where(angle < 0, 0.0, np.pi)
    for axes, degree in zip(panels, degrees, strict=True):
        axes.plot(np.degrees(angle), original, color=INK, linewidth=2.2, label="orig, interpolated")
        axes.plot(
            nodes, at_nodes, color=INK, marker="o", markersize=4.5, linewidth=0, label="orig, nodes (η is of these)"
        )
        shown = [fit for fit in fits if fit.max_degree == degree]
        for fit, color, line in zip(shown, SERIES, LINES[1:], strict=False):
            value = evaluate_in_chunks(fit.compact, theta_i, np.abs(angle), phi_o, chunk_size=CHUNK_SIZE)
            label = f"{KIND_TEXT.get(fit.kind, fit.kind)}: η = {100 * fit.error:.1f} %"
            axes.plot(np.degrees(angle), value[:, fine.wavelength.index], color=color, linestyle=line, label=label)
        plane_axis(axes)
        axes.set_xlabel("θ in the plane of incidence [deg]")
        axes.set_title(f"L = {degree}", loc="center")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), fontsize=9)
    panels[0].set_ylabel("BRDF [1/sr]")
    title = f"Original and compact form, $\\theta_i$ = {fine.incidences[0].text}, {fine.wavelength.text}"
    figure.suptitle(title, fontweight="bold")
    return figure


def spectra(
    gridded: GriddedBRDF,
    field: SpectralField,
    compact: CompactBRDF | LobeHarmonics | LobeTensor | None,
    places: Sequence,
) -> Any:
    """Figure 11: spectra at nodes and what the encoding and the compact form make of them.

    Args:
        gridded: The grid.
        field: Its spectral coefficients.
        compact: The compact form, or None.
        places: Node indices (theta_i, theta_o, phi_o), a panel each.

    Returns:
        The figure.
    """
    figure = new_figure(width=9.6, height=3.7)
    panels = np.atleast_1d(figure.subplots(1, len(places)))
    wavelength = np.asarray(gridded.wavelength_nm)
    marker = "o" if len(wavelength) < 60 else None
    at = np.array(places)
    angles = [np.asarray(a, float)[at[:, k]] for k, a in enumerate((gridded.theta_i, gridded.theta_o, gridded.phi_o))]
    rebuilt = None if compact is None else evaluate_in_chunks(compact, *angles, chunk_size=CHUNK_SIZE)
    encoded = np.asarray(field.basis.wavelength_nm)  # without those that failed
    series = np.asarray(decode(np.asarray(field.coefficient)[tuple(at.T)], field.basis))
    for number, axes in enumerate(panels):
        original = np.asarray(gridded.brdf)[tuple(at[number])]
        axes.plot(wavelength, original, color=INK, linewidth=2.4, marker=marker, markersize=3.5, label="orig (grid)")
        label = f"{field.basis.kind}, {np.shape(field.basis.synthesis)[0]} coefficients"
        axes.plot(encoded, series[number], color=SERIES[0], linestyle=LINES[1], label=label)
        if compact is not None and rebuilt is not None:
            own = np.asarray(measured_wavelengths(compact))
            axes.plot(own, rebuilt[number], color=SERIES[1], linestyle=LINES[2], label="compact form")
        theta_i, theta_o, phi_o = (np.degrees(angle[number]) for angle in angles)
        azimuth = "" if theta_o == 0 else f", {phi_o:.4g}°"
        axes.set_title(f"$\\theta_i$ = {theta_i:.4g}°,  out ({theta_o:.4g}°{azimuth})", fontsize=10.5)
        axes.set_xlabel("wavelength [nm]")
        low, high = axes.get_ylim()
        axes.set_ylim(min(0.0, low), high)
    panels[0].set_ylabel("BRDF [1/sr]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure
