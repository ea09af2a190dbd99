"""The lobe model that guides the fit: a diffuse term, the instrument's mirror image, and two GGX-like lobes.

It need not be right, only robust: what it misses is left to the residual. Fresnel and
shadowing enter with exponents that the data choose (flakes under a clear coat do not grow
towards grazing, a coated surface does), held near their priors where the data say nothing.
"""

from typing import Any

from jaxtyping import Float

from sbrdf_jax.array_module import AnyArray, array_module
from sbrdf_jax.records import pytree
from sbrdf_jax.resampling.guided.coordinates import Coordinates, floored_cos, log_scale, to_log

SHAPE_NAMES = (
    "log(n-1)", "log(mirror_width)", "log(narrow_width)", "log(broad_width)", "narrow_fresnel", "narrow_shadowing",
    "broad_fresnel", "broad_shadowing", "mirror_grazing",
)  # fmt: skip
HIGHEST_EXPONENT = 700.0  # exp of more overflows


@pytree(static=("mirror_power",))
class LobeModel:
    """A fitted model: the shape is shared, the amplitudes are per wavelength."""

    shape: Any  # [9], SHAPE_NAMES
    log_amplitude: Any  # [4, wavelength]; in units of the floor's scale: exp gives 1/sr
    mirror_power: float = 1.0  # of (tan theta_h / width)^2 in the mirror term: 2 in results of earlier versions


def fresnel(cos, index):
    """Unpolarised Fresnel reflectance of a dielectric of refractive index `index`."""
    xp = array_module(cos, index)
    cos_in = xp.sqrt(1 - (1 - cos**2) / index**2)
    senkrecht = (cos - index * cos_in) / (cos + index * cos_in)
    parallel = (cos_in - index * cos) / (cos_in + index * cos)
    return (senkrecht**2 + parallel**2) / 2


def log_shadowing(width, cos):
    """Logarithm of Smith's G1 of a GGX lobe over the cosine: 2 / ((1 + sqrt(1 + width^2 tan^2)) cos)."""
    xp = array_module(width, cos)
    return xp.log(2 / ((1 + xp.sqrt(1 + width**2 * (1 - cos**2) / cos**2)) * cos))


def lobe_terms(shape: Float[AnyArray, " 9"], at: Coordinates, mirror_power: float = 1.0) -> Float[AnyArray, "*shape 4"]:
    """Return the four terms at amplitude 1, finite everywhere; Fresnel factors are 1 at normal incidence.

    Diffuse: (1 - F(theta_i)) (1 - F(theta_o)). Mirror: F(theta_d) exp(-(tan theta_h / width)^(2 mirror_power))
    (cos_i cos_o)^-mirror_grazing. Lobes: F(theta_d)^fresnel (G1(i) G1(o) / (cos_i cos_o))^shadowing
    (1 + tan^2 theta_h / width^2)^-2 / cos^4 theta_h.
    """
    xp = array_module(shape, at.theta_i)
    index = 1 + xp.exp(shape[0])
    width = xp.exp(shape[1:4])
    cos_i, cos_o = floored_cos(at.theta_i), floored_cos(at.theta_o)
    log_fresnel = xp.log(fresnel(at.cos_difference, index) / fresnel(1.0, index))
    diffuse = (1 - fresnel(cos_i, index)) * (1 - fresnel(cos_o, index))
    steep = xp.minimum((at.tan2_half / width[0] ** 2) ** mirror_power, HIGHEST_EXPONENT)
    mirror = xp.exp(log_fresnel - steep) * (cos_i * cos_o) ** -shape[8]
    terms, spread = [xp.broadcast_to(diffuse, mirror.shape), mirror], 2 * xp.log1p(at.tan2_half)
    for k, fresnel_power, shadowing_power in ((1, shape[4], shape[5]), (2, shape[6], shape[7])):
        shadowing = log_shadowing(width[k], cos_i) + log_shadowing(width[k], cos_o)
        falloff = spread - 2 * xp.log1p(at.tan2_half / width[k] ** 2)
        terms.append(xp.exp(fresnel_power * log_fresnel + shadowing_power * shadowing + falloff))
    return xp.stack(terms, axis=-1)


def mirror_share(
    model: LobeModel, at: Coordinates, floor: Float[AnyArray, ""] | float
) -> Float[AnyArray, "*shape wavelength"]:
    """Return by how much the model's z grows with the logarithm of its mirror term: 1 where that is all of it."""
    xp = array_module(model.shape, at.theta_i)
    terms, amplitude = lobe_terms(model.shape, at, model.mirror_power), xp.exp(model.log_amplitude)
    return terms[..., 1:2] @ amplitude[1:2] / (terms @ amplitude + 1 / log_scale(at, floor)[..., None])


def lobe_log_value(
    model: LobeModel, at: Coordinates, floor: Float[AnyArray, ""] | float
) -> Float[AnyArray, "*shape wavelength"]:
    """Generalised logarithm z of the model."""
    xp = array_module(model.shape, at.theta_i)
    value = lobe_terms(model.shape, at, model.mirror_power) @ xp.exp(model.log_amplitude)
    return to_log(value, log_scale(at, floor))
