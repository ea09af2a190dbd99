"""The lobe model that guides the fit: a diffuse term, the instrument's mirror image, and two GGX-like lobes.

It need not be right, only robust: what it misses is left to the residual. Fresnel and
shadowing enter with exponents that the data choose (flakes under a clear coat do not grow
towards grazing, a coated surface does), held near their priors where the data say nothing.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sbrdf_jax.records import pytree
from sbrdf_jax.resampling.guided.coordinates import Coordinates, floored_cos, log_scale, to_log

MIRROR_POWER = 2  # of tan^2 theta_h: an aperture's image is flatter than a Gaussian, and steeper at its edge
NUM_TERMS = 4  # diffuse, mirror, narrow lobe, broad lobe
NUM_FIT_WAVELENGTHS = 8  # the shared shape is fitted to about so many
SHAPE_NAMES = (
    "log(n-1)", "log(mirror_width)", "log(narrow_width)", "log(broad_width)", "narrow_fresnel", "narrow_shadowing",
    "broad_fresnel", "broad_shadowing", "mirror_grazing",
)  # fmt: skip
PRIOR = np.array([np.log(0.5), np.log(0.0122), np.log(0.06), np.log(0.25), 1.0, 1.0, 1.0, 1.0, 0.5])
PRIOR_SPREAD = np.array([0.5, 0.1, 0.7, 0.5, 0.5, 0.5, 0.5, 0.5, 0.25])
LOWER = np.array([np.log(0.2), np.log(0.0087), np.log(0.03), np.log(0.1), 0.0, 0.0, 0.0, 0.0, 0.0])
UPPER = np.array([np.log(2.0), np.log(0.02), np.log(0.25), np.log(1.0), 1.5, 1.5, 1.5, 1.5, 1.0])
PRIOR_WEIGHT = 2e-4  # of the whole data weight, per squared spread
LOSS_SCALE = 0.3  # residual in z where the soft-L1 loss turns from square to linear
LOG_AMPLITUDE_RANGE = np.log([1e-6, 1e10])  # over the floor, so that units do not matter
DENSITY_WIDTH = 0.2  # Gaussian width in log(theta_h[deg] + 1) of the sample density
SHAPE_STEPS, AMPLITUDE_STEPS = 30, 15
STOP = 1e-5  # relative decrease of the loss


@pytree()
class LobeModel:
    """A fitted model: the shape is shared, the amplitudes are per wavelength."""

    shape: Any  # [9], SHAPE_NAMES
    log_amplitude: Any  # [4, wavelength]; in units of the floor's scale: exp gives 1/sr


def fresnel(cos: Float[Array, "*shape"], index: Float[Array, ""]) -> Float[Array, "*shape"]:
    """Unpolarised Fresnel reflectance of a dielectric of refractive index `index`."""
    cos_in = jnp.sqrt(1 - (1 - cos**2) / index**2)
    senkrecht = (cos - index * cos_in) / (cos + index * cos_in)
    parallel = (cos_in - index * cos) / (cos_in + index * cos)
    return (senkrecht**2 + parallel**2) / 2


@jax.jit
def lobe_terms(shape: Float[Array, " 9"], at: Coordinates) -> Float[Array, "*shape 4"]:
    """Return the four terms at amplitude 1, finite everywhere; Fresnel factors are 1 at normal incidence.

    Diffuse: (1 - F(theta_i)) (1 - F(theta_o)). Mirror: F(theta_d) exp(-(tan theta_h / width)^4)
    (cos_i cos_o)^-mirror_grazing. Lobes: F(theta_d)^fresnel (G1(i) G1(o) / (cos_i cos_o))^shadowing
    (1 + tan^2 theta_h / width^2)^-2 / cos^4 theta_h.
    """
    index = 1 + jnp.exp(shape[0])
    width = jnp.exp(shape[1:4])
    cos_i, cos_o = floored_cos(at.theta_i), floored_cos(at.theta_o)
    log_fresnel = jnp.log(fresnel(at.cos_difference, index) / fresnel(jnp.ones(()), index))
    diffuse = (1 - fresnel(cos_i, index)) * (1 - fresnel(cos_o, index))
    mirror = (
        jnp.exp(log_fresnel - jnp.minimum((at.tan2_half / width[0] ** 2) ** MIRROR_POWER, 700.0))
        * (cos_i * cos_o) ** -shape[8]
    )
    terms = [diffuse, mirror]
    for k, fresnel_power, shadowing_power in ((1, shape[4], shape[5]), (2, shape[6], shape[7])):
        shadowing = jnp.zeros_like(cos_i)
        for cos in (cos_i, cos_o):
            root = jnp.sqrt(1 + width[k] ** 2 * (1 - cos**2) / cos**2)
            shadowing = shadowing + jnp.log(2 / ((1 + root) * cos))
        falloff = 2 * jnp.log1p(at.tan2_half) - 2 * jnp.log1p(at.tan2_half / width[k] ** 2)
        terms.append(jnp.exp(fresnel_power * log_fresnel + shadowing_power * shadowing + falloff))
    return jnp.stack(terms, axis=-1)


@jax.jit
def lobe_log_value(model: LobeModel, at: Coordinates, floor: Float[Array, ""]) -> Float[Array, "*shape wavelength"]:
    """Generalised logarithm z of the model."""
    value = lobe_terms(model.shape, at) @ jnp.exp(model.log_amplitude)
    return to_log(value, log_scale(at, floor))


class _State(NamedTuple):
    model: LobeModel
    loss: Any
    damping: Any
    step: Any
    done: Any


def _residual(model: LobeModel, terms, z, scale):
    parts = terms[:, :, None] * jnp.exp(model.log_amplitude)[None]
    value = parts.sum(1)
    return jnp.log1p(value * scale) - z, parts * (scale / (1 + value * scale))[:, None, :]


def _loss(residual, weight, shape, prior_weight):
    data = jnp.sum(weight[:, None] * 2 * LOSS_SCALE**2 * (jnp.sqrt(1 + (residual / LOSS_SCALE) ** 2) - 1))
    return data + jnp.sum(prior_weight * (shape - PRIOR) ** 2)


@functools.partial(jax.jit, static_argnames=("fit_shape", "max_steps"))
def _minimise(model, at, z, weight, floor, *, fit_shape: bool, max_steps: int) -> tuple[LobeModel, Any]:
    """Levenberg-Marquardt with an arrow-shaped Jacobian.

    The 4 x 4 block of each wavelength is eliminated; the shared shape solves a 9 x 9 Schur complement.
    """
    num = z.shape[1]
    scale = log_scale(at, floor)[:, None]
    lowest, highest = jnp.log(floor) + LOG_AMPLITUDE_RANGE
    prior_weight = jnp.asarray(PRIOR_WEIGHT * num / PRIOR_SPREAD**2) * weight.sum() * float(fit_shape)

    def step(state: _State) -> _State:
        model = state.model
        terms = lobe_terms(model.shape, at)
        residual, jac = _residual(model, terms, z, scale)
        robust = weight[:, None] / jnp.sqrt(1 + (residual / LOSS_SCALE) ** 2)
        block = jnp.einsum("nam,nm,nbm->mab", jac, robust, jac)
        gradient = jnp.einsum("nam,nm->ma", jac, robust * residual)
        diagonal = jnp.einsum("maa->ma", block)
        damped = block + jnp.eye(NUM_TERMS)[None] * (state.damping * diagonal + 1e-6)[:, :, None]
        if fit_shape:
            slope = jax.jacfwd(lobe_terms)(model.shape, at)  # [sample, term, shape]
            amplitude = jnp.exp(model.log_amplitude)
            value = terms @ amplitude
            shared = jnp.einsum("nts,tm->nsm", slope, amplitude) * (scale / (1 + value * scale))[:, None, :]
            cross = jnp.einsum("nam,nm,nsm->mas", jac, robust, shared)
            corner = jnp.einsum("nsm,nm,ntm->st", shared, robust, shared) + jnp.diag(prior_weight)
            pull = jnp.einsum("nsm,nm->s", shared, robust * residual) + prior_weight * (model.shape - PRIOR)
            solved = jnp.linalg.solve(damped, jnp.concatenate([cross, gradient[:, :, None]], axis=2))
            schur = corner + jnp.diag(state.damping * jnp.diagonal(corner) + 1e-9)
            schur = schur - jnp.einsum("mas,mat->st", cross, solved[:, :, :-1])
            move = -jnp.linalg.solve(schur, pull - jnp.einsum("mas,ma->s", cross, solved[:, :, -1]))
            shape = jnp.clip(model.shape + move, jnp.asarray(LOWER), jnp.asarray(UPPER))
            change = -(solved[:, :, -1] + jnp.einsum("mas,s->ma", solved[:, :, :-1], shape - model.shape))
        else:
            shape = model.shape
            change = -jnp.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
        log_amplitude = jnp.clip(model.log_amplitude + jnp.clip(change.T, -3.0, 3.0), lowest, highest)
        trial = LobeModel(shape=shape, log_amplitude=log_amplitude)
        loss = _loss(_residual(trial, lobe_terms(shape, at), z, scale)[0], weight, shape, prior_weight)
        better = loss < state.loss
        pick = lambda new, old: jnp.where(better, new, old)  # noqa: E731
        converged = better & (state.loss - loss < STOP * state.loss)
        damping = jnp.where(better, jnp.maximum(state.damping / 5, 1e-6), state.damping * 5)
        return _State(
            jax.tree.map(pick, trial, model),
            pick(loss, state.loss),
            damping,
            state.step + 1,
            converged | (damping > 1e6),
        )

    start = _loss(_residual(model, lobe_terms(model.shape, at), z, scale)[0], weight, model.shape, prior_weight)
    state = _State(model, start, jnp.asarray(1e-2), jnp.asarray(0), jnp.asarray(False))
    model = jax.lax.while_loop(lambda s: (s.step < max_steps) & ~s.done, step, state).model
    residual, parts = _residual(model, lobe_terms(model.shape, at), z, scale)
    pull = weight[:, None] * residual / jnp.sqrt(1 + (residual / LOSS_SCALE) ** 2)
    gradient = jnp.linalg.norm(jnp.einsum("nam,nm->am", parts, pull), axis=0)
    size = jnp.linalg.norm(jnp.einsum("nam,nm->am", parts, jnp.abs(pull)), axis=0)
    return model, gradient / jnp.maximum(size, 1e-300)


def density_weights(half: np.ndarray) -> np.ndarray:
    """Weights [sample] inverse to the density of samples in log(theta_h[deg] + 1), of mean 1."""
    nodes = np.linspace(0.0, np.log(91.0), 200)
    density = np.exp(-0.5 * ((nodes[:, None] - half[None]) / DENSITY_WIDTH) ** 2).sum(1)
    weight = 1 / np.interp(half, nodes, density)
    return weight / weight.mean()


def _start(value: np.ndarray, at: Coordinates, used: np.ndarray, floor: float) -> np.ndarray:
    """Starting log amplitudes [4, wavelength] from medians of ratios in rings of theta_h."""
    terms = np.asarray(lobe_terms(jnp.asarray(PRIOR), at))[used]
    theta_h = np.expm1(np.asarray(at.half))[used]  # deg
    value = value[used]
    tiny = 1e-6 * float(np.median(value[value > 0]))
    diffuse = np.maximum(np.median(value / terms[:, :1], axis=0), tiny)
    rows = [diffuse]
    for term, low, high, share in ((1, 0.0, 1.0, 1.0), (2, 2.0, 8.0, 0.5), (3, 8.0, 20.0, 0.5)):
        ring = (theta_h >= low) & (theta_h < high)
        excess = np.maximum(value[ring] - diffuse * terms[ring, :1], 0.0) / terms[ring, term : term + 1]
        rows.append(np.maximum(share * np.median(excess, axis=0), tiny) if ring.any() else np.full_like(diffuse, tiny))
    return np.clip(np.log(np.stack(rows)), *(np.log(floor) + LOG_AMPLITUDE_RANGE))


def fit_lobe_model(
    value: np.ndarray, z: np.ndarray, at: Coordinates, weight: np.ndarray, floor: float
) -> tuple[LobeModel, jax.Array]:
    """Fit the model to z with a soft-L1 loss.

    The shape is fitted to some wavelengths spread over the range, the amplitudes to all.

    Args:
        value: BRDF [sample, wavelength] [1/sr].
        z: Its generalised logarithm.
        at: Coordinates of the samples.
        weight: Weight per sample; 0 for padding.
        floor: The generalised logarithm's floor [1/sr].

    Returns:
        The model, and per wavelength the relative norm of the loss's gradient by its log amplitudes.
    """
    amplitude = _start(value, at, weight > 0, floor)
    every = max(1, z.shape[1] // NUM_FIT_WAVELENGTHS)
    model = LobeModel(shape=jnp.asarray(PRIOR), log_amplitude=jnp.asarray(amplitude[:, ::every]))
    given = (jnp.asarray(weight), jnp.asarray(floor))
    model, _ = _minimise(model, at, jnp.asarray(z[:, ::every]), *given, fit_shape=True, max_steps=SHAPE_STEPS)
    model = LobeModel(shape=model.shape, log_amplitude=jnp.asarray(amplitude))
    return _minimise(model, at, jnp.asarray(z), *given, fit_shape=False, max_steps=AMPLITUDE_STEPS)
