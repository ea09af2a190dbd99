"""What a reflectance model is: linear terms whose shapes depend on a few parameters, and the cosines that they need."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sbrdf_jax.angles import unit_vector

LOWEST_COSINE = 1e-3  # where a model divides by a cosine


class Parameter(NamedTuple):
    """A parameter of a model's shape, its range, and where fits of it start."""

    name: str
    low: float
    high: float
    starts: tuple[float, ...]


class Cosines(NamedTuple):
    """What models ask of two directions; n is the normal, i and o incidence and exitance, h half way between them."""

    i: Any  # n . i
    o: Any  # n . o
    h: Any  # n . h
    d: Any  # o . h
    mirror: Any  # of the angle between exitance and mirror direction


class Model(NamedTuple):
    """BRDF = sum over terms of amplitude * term; amplitudes [sr of the term's own unit] differ by wavelength."""

    name: str
    parameters: tuple[Parameter, ...]
    terms: Callable[[Cosines, Float[Array, " parameter"]], tuple[Array, ...]]  # each of the shape of the cosines


def cosines(theta_i: Float[Array, "*shape"], theta_o: Float[Array, "*shape"], phi_o: Float[Array, "*shape"]) -> Cosines:
    """Return the cosines of directions [rad].

    Numerics:
        Where incidence and exitance are opposite, at the horizon, the half vector is taken as the normal.
    """
    incidence, exitance = unit_vector(theta_i, jnp.zeros_like(theta_i)), unit_vector(theta_o, phi_o)
    half = incidence + exitance
    squared = (half**2).sum(axis=-1)
    vanishes = squared < LOWEST_COSINE**4
    length = jnp.sqrt(jnp.where(vanishes, 1.0, squared))
    h = jnp.where(vanishes, 1.0, half[..., 2] / length)
    d = jnp.where(vanishes, 0.0, (half * exitance).sum(axis=-1) / length)
    mirror = incidence[..., 2] * exitance[..., 2] - incidence[..., 0] * exitance[..., 0]
    return Cosines(incidence[..., 2], exitance[..., 2], h, d, mirror)


def model_value(
    model: Model,
    theta_i: Float[Array, "*shape"],
    theta_o: Float[Array, "*shape"],
    phi_o: Float[Array, "*shape"],
    parameters: Float[Array, " parameter"],
    amplitude: Float[Array, " term"],
) -> Float[Array, "*shape"]:
    """Evaluate a model [1/sr] in directions [rad]; pure, for jit, vmap and grad."""
    terms = model.terms(cosines(theta_i, theta_o, phi_o), parameters)
    return sum((a * term for a, term in zip(amplitude, terms, strict=True)), jnp.zeros_like(theta_o))


def floored(cosine):
    """Return a cosine that may be divided by."""
    return jnp.maximum(cosine, LOWEST_COSINE)


def power(base, exponent):
    """Return base ** exponent for a base of 0 or more, 0 below, with finite gradients."""
    positive = base > 0
    safe = jnp.where(positive, base, 1.0)
    return jnp.where(positive, jnp.exp(exponent * jnp.log(safe)), 0.0)


def schlick(f0, d):
    """Schlick's approximation of the Fresnel reflectance: f0 + (1 - f0) (1 - d)^5."""
    return f0 + (1 - f0) * (1 - jnp.clip(d, 0.0, 1.0)) ** 5


def lambert_term(c: Cosines):
    """Return 1 / pi, the diffuse term of every model: its amplitude is an albedo."""
    return jnp.full_like(c.o, 1 / jnp.pi)
