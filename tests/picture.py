"""Render a scene with grids in place of its materials: python -m tests.picture SCENE.xml GRIDS.npz PICTURES.npy.

Each array of GRIDS.npz is BRDF [theta_i, theta_o, phi_o, channel] at uniform nodes from 0 to 90, 90 and 180 degrees;
a picture of each is written, [array, row, column, channel]. Between the nodes it is linear: a direction asks for the
eight nodes around it, and for those alone. A process of its own, because Mitsuba and JAX bring two LLVMs.
"""

import sys
from pathlib import Path
from typing import Any

import drjit
import mitsuba
import numpy as np

WIDTH, SAMPLES = 48, 32


def material(grid: np.ndarray) -> type:
    """Return a BSDF that reads a grid."""
    *shape, channels = grid.shape
    nodes = [mitsuba.Float(grid[..., channel].ravel().astype(np.float32)) for channel in range(channels)]

    class GridMaterial(mitsuba.BSDF):
        """A BSDF of values at nodes, proposed from as if it were diffuse."""

        def __init__(self, properties):
            super().__init__(properties)
            self.name = properties["material"]
            self.m_flags = mitsuba.BSDFFlags.DiffuseReflection | mitsuba.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]

        def sample(self, context, interaction, sample1, sample2, active=True):
            found = mitsuba.BSDFSample3f()
            found.wo = mitsuba.warp.square_to_cosine_hemisphere(sample2)
            found.pdf = mitsuba.warp.square_to_cosine_hemisphere_pdf(found.wo)
            found.eta, found.sampled_type, found.sampled_component = 1.0, +self.m_flags, 0
            return found, self.eval(context, interaction, found.wo, active & (found.pdf > 0)) / found.pdf

        def eval(self, context, interaction, wo, active=True):
            above = active & (interaction.wi.z > 0) & (wo.z > 0)
            azimuth = drjit.abs(drjit.atan2(interaction.wi.y, interaction.wi.x) - drjit.atan2(wo.y, wo.x))
            azimuth = drjit.minimum(azimuth, 2 * drjit.pi - azimuth)
            angles = drjit.safe_acos(wo.z), drjit.safe_acos(interaction.wi.z), azimuth
            corners: list[tuple[Any, Any]] = [(mitsuba.UInt32(0), mitsuba.Float(1))]
            for angle, count, span in zip(angles, shape, (drjit.pi / 2, drjit.pi / 2, drjit.pi), strict=True):
                place = angle * ((count - 1) / span)
                low = drjit.minimum(mitsuba.UInt32(place), count - 2)
                share = place - low
                corners = [
                    (index * count + low + step, weight * (share if step else 1 - share))
                    for index, weight in corners
                    for step in (0, 1)
                ]
            value = [
                sum(weight * drjit.gather(mitsuba.Float, of_channel, index, above) for index, weight in corners)
                for of_channel in nodes
            ]
            return mitsuba.Spectrum(value) * wo.z & above

        def pdf(self, context, interaction, wo, active=True):
            return mitsuba.warp.square_to_cosine_hemisphere_pdf(wo) & (active & (interaction.wi.z > 0) & (wo.z > 0))

        def eval_pdf(self, context, interaction, wo, active=True):
            return self.eval(context, interaction, wo, active), self.pdf(context, interaction, wo, active)

    return GridMaterial


def main(scene: Path, grids: Path, pictures: Path) -> None:
    """Write a picture of the scene for each grid."""
    from sbrdf_jax.footprints import PLUGIN, VARIANT, counters_in_place

    text, names = counters_in_place(scene)
    assert len(names) == 1, names
    mitsuba.set_variant(VARIANT)
    found = []
    with np.load(grids) as arrays:
        for name in arrays.files:
            mitsuba.register_bsdf(f"of_{name}", material(arrays[name]))
            loaded = mitsuba.load_string(text.replace(PLUGIN, f"of_{name}"))
            parameters = mitsuba.traverse(loaded)
            key = next(key for key in parameters.keys() if key.endswith("film.size"))
            parameters[key] = [WIDTH, WIDTH]
            parameters.update()
            found.append(np.array(mitsuba.render(loaded, spp=SAMPLES, seed=1)))
    np.save(pictures, np.stack(found))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
