"""Held-out predictions against what was measured, and their error over the half angle."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sbrdf_jax.folds import LEAVE_ONE_OUT
from sbrdf_jax.records import RawSamples
from sbrdf_jax.report.style import BLUE, INK, LINES, MUTED, VERMILLION, new_figure
from sbrdf_jax.scores import SMALLEST_RELATIVE

SCHEMES = (("", "folds", BLUE, "-", "o"), (f"{LEAVE_ONE_OUT}/", "one $\\theta_i$ out", VERMILLION, LINES[1], "s"))
NUM_BINS = 120  # of the density, along each axis
LOWEST_SHARE = 0.01  # of the measured values lie below the axis
MOST_DECADES = 7
MARGIN = 1.3  # of the axes, a factor


def schemes_of(validation: Mapping[str, np.ndarray]) -> list[tuple[str, str, str, Any, str]]:
    """The rows of SCHEMES that a result holds."""
    return [scheme for scheme in SCHEMES if f"{scheme[0]}predicted" in validation]


def held_out(validation: Mapping[str, np.ndarray], samples: RawSamples | None) -> Any:
    """Density of predicted over measured values for each way of holding out, then median errors by half angle.

    Args:
        validation: As a result holds it.
        samples: The cleaned samples; None leaves the densities out.

    Returns:
        The figure.
    """
    schemes = schemes_of(validation)
    panels = schemes if samples is not None else []
    figure = new_figure(width=4.4 * (len(panels) + 1) + 0.4, height=4.4)
    axes = figure.subplots(1, len(panels) + 1, squeeze=False)[0]
    for place, (group, label, *_) in zip(axes, panels, strict=False):
        assert samples is not None
        _density(figure, place, samples.value, validation[f"{group}predicted"][samples.row], f"Held out: {label}")
    _by_half_angle(axes[-1], validation, schemes)
    return figure


def _density(figure: Any, axes: Any, measured: np.ndarray, predicted: np.ndarray, title: str) -> None:
    """Draw how many values lie where, both axes logarithmic; what is below an axis lies on its edge."""
    from matplotlib.colors import LogNorm

    both = np.isfinite(measured) & np.isfinite(predicted)
    measured, predicted = measured[both], predicted[both]
    positive = measured[measured > 0]
    if not positive.size:
        axes.set_axis_off()
        return
    high = MARGIN * positive.max()
    low = max(np.quantile(positive, LOWEST_SHARE) / MARGIN, high / 10**MOST_DECADES)
    edges = np.geomspace(low, high, NUM_BINS + 1)
    inside = np.sqrt(edges[:-1] * edges[1:])  # middles of the bins: values beyond an edge go to the outermost
    count, _, _ = np.histogram2d(
        *(np.clip(v, inside[0], inside[-1]) for v in (measured, predicted)), bins=(edges, edges)
    )
    mesh = axes.pcolormesh(
        edges, edges, np.where(count > 0, count, np.nan).T, norm=LogNorm(1, max(count.max(), 2)), cmap="viridis_r",
        rasterized=True,
    )  # fmt: skip
    axes.plot([low, high], [low, high], color=INK, linewidth=0.9)
    axes.axvline(SMALLEST_RELATIVE, color=MUTED, linewidth=0.9, linestyle=LINES[2])
    axes.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high), aspect="equal")
    axes.set_xlabel("measured [1/sr]")
    axes.set_ylabel("predicted [1/sr]")
    axes.set_title(title)
    figure.colorbar(mesh, ax=axes, label="values per bin", shrink=0.8)


def _by_half_angle(axes: Any, validation: Mapping[str, np.ndarray], schemes: list) -> None:
    """Draw median and 90th percentile of the relative error in each bin, with the count of samples."""
    names: list[str] = []
    for number, (group, label, color, line, marker) in enumerate(schemes):
        prefix = f"{group}half_angle/"
        lower, upper = (validation[f"{prefix}{edge}_deg"] for edge in ("lower", "upper"))
        counts = validation[f"{prefix}count"]
        names = names or [f"{a:g}-{b:g}\n{n:,}" for a, b, n in zip(lower, upper, counts, strict=True)]
        place = np.arange(len(lower)) + 0.12 * (number - (len(schemes) - 1) / 2)
        median, high = (100 * validation[f"{prefix}{name}"] for name in ("median_rel", "p90_rel"))
        axes.vlines(place, median, high, color=color, linewidth=1.2, alpha=0.6)
        axes.plot(place, median, color=color, linestyle=line, marker=marker, markersize=5, label=label)
        axes.plot(place, high, color=color, marker="_", markersize=9, linewidth=0)
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(low / MARGIN, high * MARGIN)
    for formatted in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        formatted(lambda value, _position: f"{value:g}" if f"{value:.0e}"[0] in "125" else "")
    axes.set_box_aspect(1)
    axes.set_xticks(range(len(names)), names, fontsize=9)
    axes.set_xlabel("half angle $\\theta_h$ [deg], number of samples")
    axes.set_ylabel("relative error [%]")
    axes.set_title("Error by half angle")
    axes.legend(loc="best", fontsize=9)
