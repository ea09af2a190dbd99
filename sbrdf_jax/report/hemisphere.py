"""The hemisphere seen from above: colour maps (figures 8 and 9), where the data are, where they are not."""

import functools
from typing import Any

import numpy as np
from jaxtyping import Float

from sbrdf_jax.records import GriddedBRDF
from sbrdf_jax.report.fine_grid import FineGrid, RingEffect
from sbrdf_jax.report.style import BLUE, MUTED, ORANGE, SKY, hemisphere_axes, new_figure

PIXELS = 361
COVERAGE = (("measured nearby", BLUE), ("interpolated", SKY), ("beyond the measured range", ORANGE))


@functools.cache
def pixel_directions(pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Radius (1 at the rim, theta_o = 90 degrees) and azimuth phi_o [rad] of the pixels of a square picture.

    phi_o = 180 degrees (the mirror side) lies to the right, as positive theta does in the curves.
    """
    across = (np.arange(pixels) + 0.5) / pixels * 2 - 1
    x, y = np.meshgrid(across, across)
    return np.hypot(x, y), np.arctan2(y, -x) % (2 * np.pi)


def disk_image(
    value: Float[np.ndarray, "theta_o phi_o channel"], pixels: int = PIXELS
) -> Float[np.ndarray, "pixels pixels channel"]:
    """Bring values on fine uniform axes, 0 to 90 and 0 to 360 degrees, to a picture, bilinearly; NaN beyond the rim."""
    radius, azimuth = pixel_directions(pixels)
    row = np.minimum(radius, 1.0) * (value.shape[0] - 1)
    column = azimuth / (2 * np.pi) * (value.shape[1] - 1)
    i, j = np.minimum(row.astype(int), value.shape[0] - 2), np.minimum(column.astype(int), value.shape[1] - 2)
    s, t, width = row - i, column - j, value.shape[1]
    flat = np.moveaxis(value, -1, 0).reshape(value.shape[2], -1)  # channel by channel NumPy runs along the pixels
    before, after = (
        (1 - t) * flat.take(first, axis=1) + t * flat.take(first + 1, axis=1)
        for first in (i * width + j, (i + 1) * width + j)
    )
    image = (1 - s) * before + s * after
    image[:, radius > 1] = np.nan
    return np.moveaxis(image, 0, -1)


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear sRGB to screen values, clipped to 0..1; IEC 61966-2-1."""
    clipped = np.clip(linear, 0.0, 1.0)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)


def color_maps(fine: FineGrid, gridded: GriddedBRDF, effect: RingEffect | None) -> Any:
    """Figures 8 and 9: the resampled BRDF as sRGB under D65 at the paper's incidences.

    Of method paper without and with the window; a field of its own (no `effect`) is one row.

    One exposure for each incident angle, so that its two maps compare; it is written below them.
    """
    columns = len(fine.incidences)
    stages = (fine.windowed,) if effect is None else (fine.plain, fine.windowed)
    figure = new_figure(width=max(2.65 * columns + 0.9, 7.6), height=3.0 * len(stages) + 0.3)
    panels = figure.subplots(len(stages), columns, squeeze=False)
    for k, incidence in enumerate(fine.incidences):
        # white is the brightest hundredth of the map: the diffuser's white would leave most materials black
        white = max(float(np.quantile(fine.windowed[k, :, :, 1:].max(axis=-1), 0.99)), 1e-12)
        for axes, values in zip(panels[:, k], stages, strict=True):
            image = disk_image(values[k, :, :, 1:] / white)
            outside = np.isnan(image[..., :1])
            opaque = np.concatenate([encode_srgb(np.where(outside, 1.0, image)), 1.0 - outside], axis=-1)
            axes.imshow(opaque, extent=(-90, 90, -90, 90), origin="lower", interpolation="bilinear")
            hemisphere_axes(axes, incidence.value)
        panels[0, k].set_title(f"$\\theta_i$ = {incidence.text}", loc="center")
        panels[-1, k].text(0, -104, f"exposure {1 / white:.2g} ×", ha="center", va="top", fontsize=8.5, color=MUTED)
    title = "{} BRDF in colour (sRGB, D65), seen from above; mirror side to the right"
    legend = "○ incidence, + mirror direction; circles at 30°, 60°, 90°"
    if effect is None:
        figure.suptitle(title.format("Resampled"), fontweight="bold")
        figure.supxlabel(legend, fontsize=9)
        return figure
    window = {"none": "window: none (as above)"}.get(gridded.window, f"window: {gridded.window}")
    for axes, text in zip(panels[:, 0], ("no window", window), strict=True):
        axes.text(-104, 0, text, rotation=90, ha="right", va="center", fontsize=10.5, fontweight="bold")
    figure.suptitle(title.format("Interpolated"), fontweight="bold")
    figure.supxlabel(
        f"{legend}.  Total variation at {fine.incidences[0].text}, "
        f"nodes = 1:  {effect.ratio(effect.plain):.2f} without, {effect.ratio(effect.windowed):.2f} with window",
        fontsize=9,
    )
    return figure


def coverage_maps(gridded: GriddedBRDF) -> Any:
    """Where samples stand behind the nodes: one small hemisphere for each incident angle."""
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    theta_i = np.asarray(gridded.theta_i)
    shown = np.unique(np.linspace(0, len(theta_i) - 1, min(len(theta_i), 14)).round().astype(int))
    columns = min(len(shown), 7)
    rows = -(-len(shown) // columns)
    figure = new_figure(width=max(1.35 * columns + 0.6, 6.5), height=1.55 * rows + 1.0)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    palette = np.array([to_rgb(color) for _, color in COVERAGE])
    for axes in panels:
        axes.set_axis_off()
    for axes, index in zip(panels, shown, strict=False):
        flags = np.asarray(gridded.extrapolated)[index]
        axes.imshow(node_image(palette[flags]), extent=(-90, 90, -90, 90), origin="lower", interpolation="nearest")
        hemisphere_axes(axes, float(theta_i[index]))
        share = 100 * (flags[:, :-1] == 0).mean()
        title = f"{np.degrees(theta_i[index]):.4g}°: {share:.0f} %"
        axes.set_title(title, loc="center", fontsize=9.5, fontweight="normal")
    figure.suptitle("Where samples stand behind the nodes", fontweight="bold")
    handles = [Patch(facecolor=color, label=text) for text, color in COVERAGE]
    note = "above each hemisphere: incident angle, share of its nodes that are measured nearby"
    figure.legend(handles=handles, loc="outside lower center", ncols=3, title=note, title_fontsize=9)
    return figure


def node_image(color: Float[np.ndarray, "theta_o phi_o 3"], pixels: int = 181) -> Float[np.ndarray, "pixels pixels 4"]:
    """A picture of one colour for each node's cell, as `disk_image` lays them; transparent outside the disk."""
    radius, azimuth = pixel_directions(pixels)
    row = np.rint(np.minimum(radius, 1.0) * (color.shape[0] - 1)).astype(int)
    column = np.rint(azimuth / (2 * np.pi) * (color.shape[1] - 1)).astype(int)
    return np.concatenate([color[row, column], (radius <= 1.0)[..., None].astype(float)], axis=-1)
