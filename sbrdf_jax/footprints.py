"""Which cells of a material a rendered scene looks at: Mitsuba 3 with counters in place of its materials.

The only importer of Mitsuba. A counter is a BSDF that adds to a cell whenever light and viewer
ask for its value (`eval`; `sample` proposes directions in which there may be no light). It
takes Mitsuba's LLVM variant: in the scalar ones a BSDF cannot be written in Python.
"""

import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sbrdf_jax.errors import UserError

VARIANT = "llvm_ad_rgb"
PLUGIN = "sbrdf_counter"
ALBEDO = 0.5  # of a counter: light goes on from it to what it lights
PROBE = f"import mitsuba as m; m.set_variant('{VARIANT}'); import drjit as d; assert d.sum(m.Float([1, 2]))[0] == 3"
PROBE_SECONDS = 120


class Footprint(NamedTuple):
    """How often each cell of each material was asked for."""

    axes: tuple[Float[np.ndarray, " theta_i"], Float[np.ndarray, " theta_o"], Float[np.ndarray, " phi_o"]]  # rad
    counts: dict[str, Int[np.ndarray, "theta_i theta_o phi_o"]]
    picture: Float[np.ndarray, "row column channel"]  # the scene as the counters saw it


def find_footprint(
    path: Path, *, step_deg: float = 7.5, width: int = 64, samples: int = 64, seed: int = 0
) -> Footprint:
    """Render a scene small and quick, and count the cells of its materials that light reaches.

    Args:
        path: Scene in Mitsuba's XML; every BSDF with an `id` is a material.
        step_deg: Size of a cell [deg] in each angle; divides 90.
        width: Of the picture [pixels]; its height keeps the scene's shape.
        samples: Of each pixel.
        seed: Of the sampler.

    Returns:
        Counts on the cells centred at multiples of the step; phi_o is folded onto 0 to 180 degrees.

    Raises:
        UserError: No such file, no material, Mitsuba or its LLVM variant is not there, or it refuses the scene.
    """
    text, names = counters_in_place(path)
    mitsuba = _load_mitsuba()
    quarter = np.deg2rad(np.linspace(0, 90, round(90 / step_deg) + 1))
    axes = (quarter, quarter, np.deg2rad(np.linspace(0, 180, round(180 / step_deg) + 1)))
    counters = _register(mitsuba, tuple(map(len, axes)))
    try:
        mitsuba.file_resolver().append(str(path.parent.resolve()))
        scene = mitsuba.load_string(text)
        _shrink(mitsuba, scene, width)
        picture = np.array(mitsuba.render(scene, spp=samples, seed=seed))
    except RuntimeError as error:
        raise UserError(f"{path}: found a scene that Mitsuba refuses: {' '.join(str(error).split())}") from error
    shape = tuple(map(len, axes))
    return Footprint(axes, {name: np.array(counters[name]).astype(np.int64).reshape(shape) for name in names}, picture)


def counters_in_place(path: Path) -> tuple[str, list[str]]:
    """Return a scene's XML with a counter in place of every material that has a name, and the names.

    Raises:
        UserError: No such file, no XML, or no BSDF with an `id`.
    """
    if not path.is_file():
        raise UserError(f"{path}: found no such file; expected a scene in Mitsuba's XML")
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except ElementTree.ParseError as error:
        raise UserError(f"{path}: found no XML ({error}); expected a scene in Mitsuba's XML") from None
    names = []
    for element in root.iter("bsdf"):
        if "id" in element.attrib:
            names.append(element.attrib["id"])
            element.clear()
            element.attrib |= {"type": PLUGIN, "id": names[-1]}
            ElementTree.SubElement(element, "string", {"name": "material", "value": names[-1]})
    if not names:
        raise UserError(f'{path}: found no material; expected a <bsdf id="NAME"> for each, with a <ref> to it')
    return ElementTree.tostring(root, encoding="unicode"), names


def _load_mitsuba() -> Any:
    """Import Mitsuba; in a child process first, because with an old LLVM it aborts the process."""
    try:
        import mitsuba
    except ImportError:
        raise UserError("footprint: found no Mitsuba; expected the extra, pip install 'sbrdf-jax[render]'") from None
    try:
        probe = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, timeout=PROBE_SECONDS)
        failed = probe.returncode != 0
    except subprocess.TimeoutExpired:
        failed = True
    if failed:
        expected = "expected LLVM 17 or newer (Debian: libllvm19), or its path in DRJIT_LIBLLVM_PATH"
        raise UserError(f"footprint: found that Mitsuba's variant {VARIANT} does not start here; {expected}")
    mitsuba.set_variant(VARIANT)
    return mitsuba


def _shrink(mitsuba: Any, scene: Any, width: int) -> None:
    """Give every film of a scene a width, and the height that keeps its shape."""
    parameters = mitsuba.traverse(scene)
    for key in (key for key in parameters.keys() if key.endswith("film.size")):
        wide, high = np.array(parameters[key]).ravel()
        parameters[key] = [width, max(1, round(width * high / wide))]
    parameters.update()


def _register(mitsuba: Any, shape: tuple[int, ...]) -> dict[str, Any]:
    """Register the counter with Mitsuba; return the counts by material, which its instances fill."""
    import drjit

    counts: dict[str, Any] = {}

    class Counter(mitsuba.BSDF):
        """A diffuse BSDF that counts the cells in which it is evaluated."""

        def __init__(self, properties):
            super().__init__(properties)
            self.material = properties["material"]
            self.m_flags = mitsuba.BSDFFlags.DiffuseReflection | mitsuba.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]
            counts[self.material] = drjit.zeros(mitsuba.UInt32, int(np.prod(shape)))

        def sample(self, context, interaction, sample1, sample2, active=True):
            direction = mitsuba.warp.square_to_cosine_hemisphere(sample2)
            found = mitsuba.BSDFSample3f()
            found.wo, found.pdf = direction, mitsuba.warp.square_to_cosine_hemisphere_pdf(direction)
            found.eta, found.sampled_type, found.sampled_component = 1.0, +self.m_flags, 0
            return found, mitsuba.Spectrum(ALBEDO) & (active & (interaction.wi.z > 0))

        def eval(self, context, interaction, wo, active=True):
            above = active & (interaction.wi.z > 0) & (wo.z > 0)
            to_light, to_viewer = wo, interaction.wi
            if context.mode == mitsuba.TransportMode.Importance:
                to_light, to_viewer = to_viewer, to_light
            azimuth = drjit.abs(drjit.atan2(to_viewer.y, to_viewer.x) - drjit.atan2(to_light.y, to_light.x))
            azimuth = drjit.minimum(azimuth, 2 * drjit.pi - azimuth)
            cell = mitsuba.UInt32(0)
            ranges = (drjit.pi / 2, drjit.pi / 2, drjit.pi)
            angles = (drjit.safe_acos(to_light.z), drjit.safe_acos(to_viewer.z), azimuth)
            for angle, size, span in zip(angles, shape, ranges, strict=True):
                cell = cell * size + mitsuba.UInt32(drjit.round(angle * ((size - 1) / span)))
            drjit.scatter_add(counts[self.material], mitsuba.UInt32(1), cell, above)
            return mitsuba.Spectrum(ALBEDO / drjit.pi * wo.z) & above

        def pdf(self, context, interaction, wo, active=True):
            return mitsuba.warp.square_to_cosine_hemisphere_pdf(wo) & (active & (interaction.wi.z > 0) & (wo.z > 0))

        def eval_pdf(self, context, interaction, wo, active=True):
            return self.eval(context, interaction, wo, active), self.pdf(context, interaction, wo, active)

        def to_string(self):
            return f"{PLUGIN}[{self.material}]"

    mitsuba.register_bsdf(PLUGIN, Counter)
    return counts
