"""Fit any model to scattered samples, many lanes at once: Levenberg-Marquardt with the amplitudes projected out.

A lane is one wavelength with parameters of its own, or several that share them. Amplitudes are
never negative and follow from least squares for given parameters, which are the only unknowns,
each as the logit of its place within its range, in the logarithm.
"""

import functools
import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from sbrdf_jax.devices import over_lanes
from sbrdf_jax.models.model import Model, cosines
from sbrdf_jax.records import Status

MAX_STEPS = 40
TOLERANCE = 1e-6
STATIONARY = 1e-4  # share of the squared error that one more step may promise
LANES_AT_A_TIME = 8
JOINT_WAVELENGTHS = 9  # evenly chosen ones decide the parameters that all share
TINY = 1e-300
DEPENDENT = 1e-12  # terms whose angle squared is below it are one
AT_EDGE = 1e-3  # of a parameter's range
EDGE = 1e-6  # of a parameter's range, where starts and answers end


class Samples(NamedTuple):
    """Scattered samples, and how much the square of each error counts."""

    theta_i: Any  # [sample] rad
    theta_o: Any  # [sample] rad
    phi_o: Any  # [sample] rad
    value: Any  # [sample, wavelength] 1/sr
    weight: Any  # [sample]


class ModelFit(NamedTuple):
    """Parameters and amplitudes of every wavelength."""

    parameters: Float[np.ndarray, "wavelength parameter"]
    amplitude: Float[np.ndarray, "wavelength term"]
    relative_error: Float[np.ndarray, " wavelength"]  # root of the weighted squared error over that of the values
    status: np.ndarray  # [wavelength] Status


def equal_weights(theta_i: Float[np.ndarray, " sample"], value: Float[np.ndarray, "sample wavelength"]) -> np.ndarray:
    """Return weights under which every incident angle (to half a degree) has the same energy, as eq. (18) sees it."""
    _, place = np.unique(np.round(np.rad2deg(theta_i) * 2), return_inverse=True)
    energy = np.bincount(place, (value**2).sum(axis=1))
    return 1 / np.where(energy > 0, energy, 1.0)[place]


class Lane(NamedTuple):
    """One fit, or many in arrays."""

    parameters: Any  # [parameter]
    amplitude: Any  # [term, channel]
    error: Any  # weighted sum of squares
    status: Any


def fit_each_wavelength(model: Model, samples: Samples) -> ModelFit:
    """Fit parameters and amplitudes of each wavelength alone, from every start and from what all share."""
    shared = _best(_fit_shared(model, samples), 1)
    starts = np.concatenate([shared.parameters, _starts(model)])
    value = np.asarray(samples.value).T[:, :, None]  # [wavelength, sample, 1]
    lanes = _fit_lanes(model, samples, np.repeat(value, len(starts), axis=0), np.tile(starts, (len(value), 1)))
    found = _best(lanes, len(value))
    return ModelFit(found.parameters, found.amplitude[..., 0], _relative(samples, found.error), found.status)


def fit_jointly(model: Model, samples: Samples) -> ModelFit:
    """Fit parameters that all wavelengths share, with amplitudes of each; one status for all."""
    shared = _best(_fit_shared(model, samples), 1)
    count = np.shape(samples.value)[1]
    amplitude, error = _amplitudes(model, samples, jnp.asarray(shared.parameters[0]))
    status = np.where(np.isfinite(error), shared.status[0], int(Status.NONFINITE))
    return ModelFit(
        np.tile(shared.parameters, (count, 1)), np.asarray(amplitude).T, _relative(samples, np.asarray(error)), status
    )


def predict(
    model: Model, fit: ModelFit, theta_i: np.ndarray, theta_o: np.ndarray, phi_o: np.ndarray
) -> Float[np.ndarray, "direction wavelength"]:
    """Return what a fitted model says in directions [rad], at all wavelengths [1/sr]."""
    directions = tuple(jnp.asarray(a) for a in (theta_i, theta_o, phi_o))
    parameters, amplitude = jnp.asarray(fit.parameters), jnp.asarray(fit.amplitude)
    return np.asarray(_predict(model, directions, parameters, amplitude)).T


@functools.partial(jax.jit, static_argnames="model")
def _predict(model, directions, parameters, amplitude):
    c = cosines(*directions)

    def one(lane):
        return sum(a * term for a, term in zip(lane[1], model.terms(c, lane[0]), strict=True))

    return jax.lax.map(one, (parameters, amplitude))


def _relative(samples, error):
    value = np.asarray(samples.value)
    energy = np.asarray(samples.weight) @ value**2
    return np.sqrt(error / np.where(energy > 0, energy, 1.0))


def _starts(model: Model) -> Float[np.ndarray, "start parameter"]:
    return np.array(list(itertools.product(*(parameter.starts for parameter in model.parameters))), float)


def _fit_shared(model, samples) -> Lane:
    value, starts = np.asarray(samples.value), _starts(model)
    finite = np.flatnonzero(np.isfinite(value).all(axis=0))
    if not finite.size:
        finite = np.arange(value.shape[1])
    chosen = finite[np.unique(np.linspace(0, len(finite) - 1, JOINT_WAVELENGTHS).round().astype(int))]
    return _fit_lanes(model, samples, np.repeat(value[None][..., chosen], len(starts), axis=0), starts)


def _best(lanes: Lane, count: int) -> Lane:
    """Return the best of the starts of each of `count` problems; one that is not finite loses to all others."""
    error = np.where(np.isfinite(lanes.error), lanes.error, np.inf).reshape(count, -1)
    return Lane(*(part[error.argmin(axis=1) + np.arange(count) * error.shape[1]] for part in lanes))


def _fit_lanes(model, samples, value, start) -> Lane:
    """Fit lanes [lane, sample, channel] from their starts, in batches of one shape, the last one filled with copies."""
    directions = tuple(jnp.asarray(a) for a in (samples.theta_i, samples.theta_o, samples.phi_o))
    weight, count = jnp.asarray(samples.weight), len(value)
    parts = []
    for first in range(0, count, LANES_AT_A_TIME):
        lane = np.minimum(np.arange(first, first + LANES_AT_A_TIME), count - 1)
        parts.append([np.asarray(a) for a in _fit_batch(model, directions, weight, value[lane], start[lane])])
    return Lane(*(np.concatenate(part)[:count] for part in zip(*parts, strict=True)))


@functools.partial(over_lanes, axis=0, shared=(1, 2), static=(0,))
def _fit_batch(model, directions, weight, value, start):
    c = cosines(*directions)
    return jax.vmap(functools.partial(_fit_lane, model, c, jnp.sqrt(weight)))(value, start)


def _fit_lane(model: Model, c, root_weight, value, start) -> Lane:
    """Fit one lane; no worse than its start. The status follows from the gradient, not from what the solver says."""
    low, high = (jnp.log(jnp.array([getattr(p, name) for p in model.parameters])) for name in ("low", "high"))
    scale = jnp.sqrt(jnp.sum((root_weight[:, None] * value) ** 2))
    scale = jnp.where(scale > 0, scale, 1.0)

    def parameters(unknown):
        return jnp.exp(low + (high - low) * jax.nn.sigmoid(unknown))

    def residual(unknown, _):
        amplitude, left = project(model, c, root_weight, value, parameters(unknown))
        del amplitude
        return left / scale

    if model.parameters:
        share = jnp.clip((jnp.log(start) - low) / (high - low), EDGE, 1 - EDGE)
        first = jnp.log(share) - jnp.log1p(-share)
        solver = optx.LevenbergMarquardt(TOLERANCE, TOLERANCE, linear_solver=lx.Normal(lx.Cholesky()))
        solution = optx.least_squares(residual, solver, first, max_steps=MAX_STEPS, throw=False)
        before, after = (jnp.sum(residual(x, None) ** 2) for x in (first, solution.value))
        unknown = jnp.where(after <= before, solution.value, first)
        at, left = parameters(unknown), residual(unknown, None)
        jacobian = jax.jacfwd(residual)(unknown, None).reshape(-1, len(unknown))
        place = jax.nn.sigmoid(unknown)
        is_inside = (place > AT_EDGE) & (place < 1 - AT_EDGE)  # at an edge a parameter has no say
        jacobian = jnp.where(is_inside[None], jacobian, 0.0)
        gram = jacobian.T @ jacobian
        ridge = jnp.finfo(gram.dtype).eps * (jnp.trace(gram) + 1) * jnp.eye(len(unknown))
        slope = jacobian.T @ left.ravel()
        promised = slope @ jnp.linalg.solve(gram + ridge, slope)
        is_done = promised <= STATIONARY * jnp.sum(left**2) + jnp.finfo(gram.dtype).eps
    else:
        at, is_done = jnp.zeros(0, value.dtype), jnp.array(True)
    amplitude, left = project(model, c, root_weight, value, at)
    error = jnp.sum(left**2)
    status = jnp.where(is_done, int(Status.OK), int(Status.MAX_STEPS))
    return Lane(at, amplitude, error, jnp.where(jnp.isfinite(error), status, int(Status.NONFINITE)))


@functools.partial(jax.jit, static_argnames="model")
def _amplitudes(model, samples, parameters):
    c = cosines(*(jnp.asarray(a) for a in samples[:3]))
    root = jnp.sqrt(jnp.asarray(samples.weight))
    amplitude, left = project(model, c, root, jnp.asarray(samples.value), parameters)
    return amplitude, jnp.sum(left**2, axis=0)


def project(
    model: Model,
    c: Any,
    root_weight: Float[Array, " sample"],
    value: Float[Array, "sample channel"],
    parameters: Float[Array, " parameter"],
) -> tuple[Float[Array, "term channel"], Float[Array, "sample channel"]]:
    """Return the best amplitudes that are not negative, of one or two terms, and the weighted residual that they leave.

    Two terms: where one amplitude would be negative it is 0, and the other is the best without it.
    """
    terms = jnp.stack(model.terms(c, parameters), axis=1) * root_weight[:, None]
    weighted = value * root_weight[:, None]
    gram, moment = terms.T @ terms, terms.T @ weighted
    alone = jnp.maximum(moment / jnp.maximum(jnp.diagonal(gram), TINY)[:, None], 0.0)
    if terms.shape[1] == 1:
        amplitude = alone
    else:
        (a, b), (_, d) = gram
        determinant = a * d - b * b
        independent = determinant > DEPENDENT * a * d
        safe = jnp.where(independent, determinant, 1.0)
        both = jnp.stack([d * moment[0] - b * moment[1], a * moment[1] - b * moment[0]]) / safe
        gain = alone * moment
        single = jnp.where((gain[0] >= gain[1])[None], jnp.eye(2)[0][:, None], jnp.eye(2)[1][:, None]) * alone
        inside = independent & jnp.all(both >= 0, axis=0)
        amplitude = jnp.where(inside[None], both, single)
    return amplitude, terms @ amplitude - weighted
