"""The lobe model's fit: robust Levenberg-Marquardt with an arrow-shaped Jacobian, on the host.

NumPy in float64: the problem is small (directions x wavelengths x 13 parameters), so that
compiling it would take a hundred times longer than solving it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sbrdf_jax.host_blas import one_blas_thread
from sbrdf_jax.resampling.guided.coordinates import Coordinates, log_scale
from sbrdf_jax.resampling.guided.lobe_model import LobeModel, lobe_terms
from sbrdf_jax.resampling.guided.lobe_slopes import lobe_slopes

NUM_TERMS = 4  # diffuse, mirror, narrow lobe, broad lobe
NUM_FIT_WAVELENGTHS = 8  # the shared shape is fitted to about so many
PRIOR = np.array([np.log(0.5), np.log(0.0122), np.log(0.06), np.log(0.25), 1.0, 1.0, 1.0, 1.0, 0.5])
PRIOR_SPREAD = np.array([0.5, 0.3, 0.7, 0.5, 0.5, 0.5, 0.5, 0.5, 0.25])
LOWER = np.array([np.log(0.2), np.log(0.004), np.log(0.03), np.log(0.1), 0.0, 0.0, 0.0, 0.0, 0.0])
UPPER = np.array([np.log(2.0), np.log(0.02), np.log(0.25), np.log(1.0), 1.5, 1.5, 1.5, 1.5, 1.0])
PRIOR_WEIGHT = 2e-4  # of the whole data weight, per squared spread
LOSS_SCALE = 0.3  # residual in z where the soft-L1 loss turns from square to linear
LOG_AMPLITUDE_RANGE = np.log([1e-6, 1e10])  # over the floor, so that units do not matter
LARGEST_CHANGE = 3.0  # of a log amplitude in one step
DENSITY_WIDTH = 0.2  # Gaussian width in log(theta_h[deg] + 1) of the sample density
SHAPE_STEPS, AMPLITUDE_STEPS = 30, 25
STOP, AMPLITUDE_STOP = 1e-5, 1e-8  # relative decrease of the loss
MOST_DAMPING, LEAST_DAMPING = 1e6, 1e-6


class _Problem(NamedTuple):
    """What z is fitted to."""

    at: Coordinates  # NumPy, [sample]
    z: Float[np.ndarray, "wavelength sample"]
    weight: Float[np.ndarray, " sample"]
    scale: Float[np.ndarray, " sample"]  # of the generalised logarithm
    lowest: float  # log amplitude
    highest: float

    def clip(self, log_amplitude: np.ndarray) -> np.ndarray:
        """Hold log amplitudes in their range."""
        return np.clip(log_amplitude, self.lowest, self.highest)


def fit_lobe_model(
    value: np.ndarray, z: np.ndarray, at: Coordinates, weight: np.ndarray, floor: float
) -> tuple[LobeModel, np.ndarray]:
    """Fit the model to z with a soft-L1 loss.

    The shape is fitted to some wavelengths spread over the range, the amplitudes to all, each
    wavelength by itself.

    Args:
        value: BRDF [sample, wavelength] [1/sr].
        z: Its generalised logarithm.
        at: Coordinates of the samples.
        weight: Weight per sample; 0 for padding.
        floor: The generalised logarithm's floor [1/sr].

    Returns:
        The model, and per wavelength the relative norm of the loss's gradient by its log amplitudes.
    """
    problem, amplitude = _problem(value, z, at, weight, floor)
    every = max(1, z.shape[1] // NUM_FIT_WAVELENGTHS)
    with one_blas_thread():
        shape = _fit_shape(problem._replace(z=problem.z[::every]), amplitude[::every])
    return _of_shape(shape, problem, amplitude)


def fit_amplitudes(
    shape: np.ndarray, value: np.ndarray, z: np.ndarray, at: Coordinates, weight: np.ndarray, floor: float
) -> tuple[LobeModel, np.ndarray]:
    """Do what `fit_lobe_model` does for a shape that is known."""
    return _of_shape(shape, *_problem(value, z, at, weight, floor))


def _of_shape(shape: np.ndarray, problem: _Problem, start: np.ndarray) -> tuple[LobeModel, np.ndarray]:
    with one_blas_thread():
        amplitude, gradient = _fit_amplitudes(problem, lobe_terms(shape, problem.at), start)
    return LobeModel(shape, amplitude.T), gradient


def _problem(value: np.ndarray, z: np.ndarray, at: Coordinates, weight: np.ndarray, floor: float):
    """Return the problem of all wavelengths, and where their log amplitudes start."""
    lowest, highest = np.log(floor) + LOG_AMPLITUDE_RANGE
    scale = log_scale(at, floor)
    problem = _Problem(at, np.ascontiguousarray(z.T), weight, scale, float(lowest), float(highest))
    return problem, problem.clip(_start(value, at, weight > 0))


def density_weights(half: np.ndarray) -> np.ndarray:
    """Weights [sample] inverse to the density of samples in log(theta_h[deg] + 1), of mean 1."""
    nodes = np.linspace(0.0, np.log(91.0), 200)
    density = np.exp(-0.5 * ((nodes[:, None] - half[None]) / DENSITY_WIDTH) ** 2).sum(1)
    weight = 1 / np.interp(half, nodes, density)
    return weight / weight.mean()


def _start(value: np.ndarray, at: Coordinates, used: np.ndarray) -> Float[np.ndarray, "wavelength 4"]:
    """Starting log amplitudes from medians of ratios in rings of theta_h."""
    terms = lobe_terms(PRIOR, at)[used]
    theta_h = np.expm1(at.half)[used]  # deg
    value = value[used]
    tiny = 1e-6 * float(np.median(value[value > 0]))
    diffuse = np.maximum(np.median(value / terms[:, :1], axis=0), tiny)
    rows = [diffuse]
    for term, low, high, share in ((1, 0.0, 1.0, 1.0), (2, 2.0, 8.0, 0.5), (3, 8.0, 20.0, 0.5)):
        ring = (theta_h >= low) & (theta_h < high)
        excess = np.maximum(value[ring] - diffuse * terms[ring, :1], 0.0) / terms[ring, term : term + 1]
        rows.append(np.maximum(share * np.median(excess, axis=0), tiny) if ring.any() else np.full_like(diffuse, tiny))
    return np.log(np.stack(rows, axis=1))


def _residual(problem: _Problem, terms: np.ndarray, log_amplitude: np.ndarray):
    """Return z of the model minus z, and d z / d value, both [wavelength, sample]."""
    scaled = (np.exp(log_amplitude) @ terms.T) * problem.scale
    return np.log1p(scaled) - problem.z, problem.scale / (1 + scaled)


def _robust(problem: _Problem, residual: np.ndarray) -> np.ndarray:
    """Weights [wavelength, sample] with which least squares has the gradient of the soft-L1 loss."""
    return problem.weight / np.sqrt(1 + (residual / LOSS_SCALE) ** 2)


def _loss(residual: np.ndarray, weight: np.ndarray) -> Float[np.ndarray, " wavelength"]:
    return 2 * LOSS_SCALE**2 * (np.sqrt(1 + (residual / LOSS_SCALE) ** 2) - 1) @ weight


def _normal(jacobian: np.ndarray, weight: np.ndarray, residual: np.ndarray):
    """Return J'WJ and J'Wr [wavelength, ...] for the Jacobian [wavelength, parameter, sample]."""
    weighted = jacobian * weight[:, None, :]
    return weighted @ np.swapaxes(jacobian, 1, 2), (weighted @ residual[:, :, None])[:, :, 0]


def _damped(block: np.ndarray, damping: np.ndarray) -> np.ndarray:
    diagonal = np.einsum("maa->ma", block)
    return block + (damping[:, None] * diagonal + 1e-6)[:, :, None] * np.eye(block.shape[1])


def _fit_shape(problem: _Problem, log_amplitude: np.ndarray) -> Float[np.ndarray, " 9"]:
    """Fit the shape and some wavelengths' amplitudes together.

    The 4 x 4 block of each wavelength is eliminated; the shared shape solves a 9 x 9 Schur complement.
    """
    shape, damping, weight = PRIOR.copy(), 1e-2, problem.weight
    pull_of_prior = PRIOR_WEIGHT * len(log_amplitude) / PRIOR_SPREAD**2 * weight.sum()

    def loss_of(residual, shape):
        return _loss(residual, weight).sum() + float(pull_of_prior @ (shape - PRIOR) ** 2)

    residual, slope = _residual(problem, lobe_terms(shape, problem.at), log_amplitude)
    loss, fresh = loss_of(residual, shape), True
    for _ in range(SHAPE_STEPS):
        if fresh:
            parts = np.exp(log_amplitude)[:, :, None] * lobe_terms(shape, problem.at).T
            shared = np.exp(log_amplitude) @ lobe_slopes(shape, problem.at)  # [shape, wavelength, sample]
            shared = np.swapaxes(shared, 0, 1) * slope[:, None, :]
            jacobian = np.concatenate([parts * slope[:, None, :], shared], axis=1)
            whole, pull = _normal(jacobian, _robust(problem, residual), residual)
            corner = whole[:, NUM_TERMS:, NUM_TERMS:].sum(axis=0) + np.diag(pull_of_prior)
            shape_pull = pull[:, NUM_TERMS:].sum(axis=0) + pull_of_prior * (shape - PRIOR)
        block = _damped(whole[:, :NUM_TERMS, :NUM_TERMS], np.full(len(log_amplitude), damping))
        cross = whole[:, :NUM_TERMS, NUM_TERMS:]
        solved = np.linalg.solve(block, np.concatenate([cross, pull[:, :NUM_TERMS, None]], axis=2))
        schur = corner + np.diag(damping * np.diag(corner) + 1e-9) - np.einsum("mas,mat->st", cross, solved[:, :, :-1])
        move = -np.linalg.solve(schur, shape_pull - np.einsum("mas,ma->s", cross, solved[:, :, -1]))
        new_shape = np.clip(shape + move, LOWER, UPPER)
        step = -(solved[:, :, -1] + solved[:, :, :-1] @ (new_shape - shape))
        new_amplitude = problem.clip(log_amplitude + np.clip(step, -LARGEST_CHANGE, LARGEST_CHANGE))
        found = _residual(problem, lobe_terms(new_shape, problem.at), new_amplitude)
        new_loss = loss_of(found[0], new_shape)
        fresh = bool(new_loss < loss)
        if not fresh:
            damping *= 5
            if damping > MOST_DAMPING:
                break
            continue
        converged = loss - new_loss < STOP * loss
        shape, log_amplitude, loss = new_shape, new_amplitude, new_loss
        residual, slope = found
        damping = max(damping / 5, LEAST_DAMPING)
        if converged:
            break
    return shape


def _fit_amplitudes(problem: _Problem, terms: np.ndarray, log_amplitude: np.ndarray):
    """Fit every wavelength's amplitudes to a shape; return them, and the relative norm of each gradient.

    The Jacobian is amplitude x term x slope: its products are those of the terms, whatever the wavelength.
    """
    answer, products = log_amplitude.copy(), (terms[:, :, None] * terms[:, None, :]).reshape(len(terms), -1)
    lanes, damping = np.arange(len(answer)), np.full(len(answer), 1e-2)
    residual, slope = _residual(problem, terms, answer)
    loss = _loss(residual, problem.weight)
    for _ in range(AMPLITUDE_STEPS):
        amplitude, weighted = np.exp(answer[lanes]), _robust(problem, residual) * slope
        block = ((weighted * slope) @ products).reshape(-1, NUM_TERMS, NUM_TERMS)
        block *= amplitude[:, :, None] * amplitude[:, None, :]
        pull = amplitude * ((weighted * residual) @ terms)
        step = -np.linalg.solve(_damped(block, damping), pull[:, :, None])[:, :, 0]
        trial = problem.clip(answer[lanes] + np.clip(step, -LARGEST_CHANGE, LARGEST_CHANGE))
        found = _residual(problem._replace(z=problem.z[lanes]), terms, trial)
        new_loss = _loss(found[0], problem.weight)
        better = new_loss < loss
        answer[lanes[better]] = trial[better]
        converged = better & (loss - new_loss < AMPLITUDE_STOP * loss)
        damping = np.where(better, np.maximum(damping / 5, LEAST_DAMPING), damping * 5)
        go_on = ~converged & (damping <= MOST_DAMPING)
        chosen = (np.where(better[:, None], a, b) for a, b in zip(found, (residual, slope), strict=True))
        residual, slope = (a[go_on] for a in chosen)
        loss, lanes, damping = np.where(better, new_loss, loss)[go_on], lanes[go_on], damping[go_on]
        if not len(lanes):
            break
    residual, slope = _residual(problem, terms, answer)
    pull = _robust(problem, residual) * residual * slope
    gradient, size = (np.linalg.norm(np.exp(answer) * (p @ terms), axis=1) for p in (pull, np.abs(pull)))
    return answer, gradient / np.maximum(size, 1e-300)
