"""A footprint: the scene as its counters saw it, and the cells that light reached at each incident angle."""

from typing import Any

import numpy as np

from sbrdf_jax.footprints import Footprint
from sbrdf_jax.masks import widen
from sbrdf_jax.report.hemisphere import encode_srgb, node_image
from sbrdf_jax.report.style import BLUE, FAINT, SKY, hemisphere_axes, new_figure

CELLS = (("not needed", FAINT), ("needed, beside a cell that light reached", SKY), ("light reached it", BLUE))


def footprint_figure(footprint: Footprint) -> Any:
    """Draw a row for each material: hemispheres of the incident angles that are needed; the scene on the left."""
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    theta_i = footprint.axes[0]
    needed = {name: widen(count > 0) for name, count in footprint.counts.items()}
    rows = {name: np.flatnonzero(mask.any(axis=(1, 2))) for name, mask in needed.items()}
    columns = 1 + max(1, *(len(angles) for angles in rows.values()))
    figure = new_figure(width=1.9 * columns + 1.2, height=2.1 * len(rows) + 1.0)
    panels = figure.subplots(len(rows), columns, squeeze=False)
    for axes in panels.ravel():
        axes.set_axis_off()
    picture = footprint.picture[..., :3]
    panels[0, 0].imshow(encode_srgb(picture / max(float(np.quantile(picture, 0.99)), 1e-12)))
    panels[0, 0].set_title("the scene, all materials grey", loc="center", fontsize=9.5, fontweight="normal")
    palette = np.array([to_rgb(colour) for _, colour in CELLS])
    for row, (name, angles) in zip(panels, rows.items(), strict=True):
        for axes, index in zip(row[1:], angles, strict=False):
            half = needed[name][index].astype(int) + (footprint.counts[name][index] > 0)
            round_circle = np.concatenate([half, half[:, -2::-1]], axis=1)
            axes.imshow(node_image(palette[round_circle]), extent=(-90, 90, -90, 90), origin="lower")
            hemisphere_axes(axes, float(theta_i[index]))
            axes.set_title(f"{name}: {np.degrees(theta_i[index]):.4g}°", loc="center", fontsize=9.5)
    shares = ", ".join(f"{name} {100 * mask.mean():.1f} %" for name, mask in needed.items())
    figure.suptitle(f"Directions that the scene needs, by incident angle: {shares}", fontweight="bold")
    handles = [Patch(facecolor=colour, label=text) for text, colour in CELLS]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=9)
    return figure
