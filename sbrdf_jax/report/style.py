"""How figures look: one palette, one size, drawn by the Agg backend through the object interface.

No pyplot, so drawing leaves no global state and needs no screen. The colours are those of Okabe and Ito, told apart
by every common kind of colour vision; where several curves share a panel, the line style differs too.
"""

from pathlib import Path
from typing import Any

import numpy as np

from sbrdf_jax.files import whole_file

BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY = "#0072B2", "#D55E00", "#009E73", "#AA4499", "#E69F00", "#56B4E9"
INK, MUTED, FAINT, PAPER = "#1f2328", "#6b7280", "#d7dbe0", "#ffffff"
SERIES = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
LINES = ("-", (0, (5, 1.6)), (0, (1.4, 1.2)), (0, (6, 1.5, 1.2, 1.5)), "-", (0, (5, 1.6)))
DPI = 144
MANY_DECADES = 1e3

_RC: Any = {
    "font.size": 10.5,
    "text.hinting": "none",  # at this resolution it looks the same, and fitting glyphs to pixels takes twice as long
    "axes.titlesize": 11.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # fixed: nothing has ticks on top, and to look for them every axis is laid out once more
    "axes.labelsize": 10.5,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "text.color": INK,
    "lines.linewidth": 1.9,
    "legend.frameon": False,
    "legend.fontsize": 9.5,
    "figure.facecolor": PAPER,
}


def style_context():
    """Return the context in which figures are made and saved; settings of the caller come back after it."""
    import matplotlib

    return matplotlib.rc_context(_RC)


def new_figure(width: float = 7.6, height: float = 4.2) -> Any:
    """Return an empty figure [inches] with the Agg canvas and a layout that keeps labels apart."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(w_pad=0.09, h_pad=0.09, wspace=0.04)
    return figure


def save_figure(figure: Any, path: Path) -> Path:
    """Write a figure as PNG and return its path; the same figure gives the same bytes."""
    for axes in figure.axes:
        _thin_out(axes)
        factor = axes.yaxis.get_offset_text()  # of all ticks, where they have one: left of the title, not under it
        if factor.get_horizontalalignment() == "left":
            factor.set(horizontalalignment="right", x=-0.02)
    figure.get_layout_engine().execute(figure)
    figure.set_layout_engine("none")
    with whole_file(path) as temporary:  # savefig would lay out and draw everything twice
        figure.canvas.print_png(temporary, metadata={"Software": None}, pil_kwargs={"compress_level": 3})
    return path


def _thin_out(axes: Any) -> None:
    """Leave out the minor ticks of logarithmic axes of many decades: they say nothing, and take half of the time.

    Their decades are written without mathtext, which takes ten times as long as text.
    """
    from matplotlib.ticker import LogFormatterMathtext, NullLocator

    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        if axis.get_scale() == "log" and high > MANY_DECADES * low:
            axis.set_minor_locator(NullLocator())
            if isinstance(axis.get_major_formatter(), LogFormatterMathtext):
                axis.set_major_formatter(_decade)


def _decade(value: float, _position: int) -> str:
    return "10" + f"{np.log10(value):.0f}".translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def plane_axis(axes: Any) -> None:
    """Label an axis of signed angles in the plane of incidence as the paper's figures do."""
    axes.set_xlim(-90, 90)
    axes.set_xticks(np.arange(-90, 91, 30))
    axes.set_xlabel("θ in the plane of incidence [deg]:  θ < 0 is (|θ|, 0°),  θ > 0 is (θ, 180°)")


def hemisphere_axes(axes: Any, theta_i: float) -> None:
    """Draw the frame of a hemisphere seen from above: rim at 90 degrees, mirror direction to the right."""
    from matplotlib.patches import Circle

    axes.set_aspect("equal")
    axes.set_xlim(-97, 97)
    axes.set_ylim(-97, 97)
    axes.set_axis_off()
    for radius in (30, 60):
        axes.add_artist(Circle((0, 0), radius, fill=False, edgecolor=MUTED, linewidth=0.5, linestyle=(0, (2, 3))))
    axes.add_artist(Circle((0, 0), 90, fill=False, edgecolor=MUTED, linewidth=0.8))
    angle = np.degrees(theta_i)
    axes.plot([-angle], [0], marker="o", markersize=4.5, markerfacecolor=PAPER, markeredgecolor=INK, linewidth=0)
    if angle > 0:
        axes.plot([angle], [0], marker="+", markersize=7, markeredgecolor=INK, markeredgewidth=1.0, linewidth=0)
