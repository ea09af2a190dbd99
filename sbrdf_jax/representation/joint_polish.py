"""Widths and peaks of the lobes of an incident angle, refined with harmonics and heights projected out.

Levenberg-Marquardt on the projected problem with Kaufman's Jacobian: of each lobe only its
shape and two derivatives matter, and only through inner products with each other, with the
harmonics and with the values, so a step costs the same however many coefficients there are.
All lanes go on together; each has its own damping.
"""

import numpy as np
from jaxtyping import Float, Int

from sbrdf_jax.angles import SAME_ANGLE
from sbrdf_jax.representation.joint_fit import (
    DEPENDENT,
    NUM_LOBES,
    AngleProblem,
    Inner,
    Lobes,
    shapes_and_slopes,
)

NUM_STEPS = 16
FIRST_DAMPING, LESS, MORE = 1e-2, 0.2, 6.0
FURTHEST = 0.5  # rad, of a peak from where it starts
LONGEST = 1.0  # of a step in the logarithm of a width
PEAK_STEP = 0.1  # rad, likewise


def polish_lobes(
    problem: AngleProblem,
    i: Int[np.ndarray, " lane"],
    lobes: Lobes,
    degree: Int[np.ndarray, "lane channel"],
    limits: Float[np.ndarray, "shape 2"],
    *,
    num_steps: int = NUM_STEPS,
) -> Lobes:
    """Refine lobes; a lane never ends worse than it starts.

    Args:
        problem: What is fitted.
        i: Incident angle of each lane.
        lobes: Where to start, [lane, lobe].
        degree: Of each channel's background; a channel of degree -1 takes no part.
        limits: Least and greatest width of each shape.
        num_steps: For all lanes; there is no other end.

    Numerics:
        At normal incidence the peak is the normal. A lane that is not finite stays where it is.
    """
    edge = np.log(limits[lobes.kind])
    first_peak = lobes.peak_theta_o
    reach = np.where(problem.theta_i[i] < SAME_ANGLE, 0.0, FURTHEST)[:, None]
    best = np.concatenate([np.clip(np.log(lobes.width), edge[..., 0], edge[..., 1]), first_peak], axis=1)
    lower = np.concatenate([edge[..., 0], first_peak - reach], axis=1)
    upper = np.concatenate([edge[..., 1], first_peak + reach], axis=1)
    longest = np.repeat([LONGEST, PEAK_STEP], NUM_LOBES)

    def evaluate(unknown):
        at = Lobes(lobes.kind, np.exp(unknown[:, :NUM_LOBES]), unknown[:, NUM_LOBES:])
        return projected_step(problem, i, shapes_and_slopes(problem, i, at), degree)

    error, slope, curvature = evaluate(best)
    damping = np.full(len(i), FIRST_DAMPING)
    for _ in range(num_steps):
        free = ((best > lower) | (slope > 0)) & ((best < upper) | (slope < 0)) & (upper > lower)
        diagonal = np.einsum("luu->lu", curvature)
        usable = free & (diagonal > 0)
        scale = np.where(usable, 1 / np.sqrt(np.where(usable, diagonal, 1.0)), 0.0)
        matrix = curvature * scale[:, :, None] * scale[:, None, :] + damping[:, None, None] * np.eye(2 * NUM_LOBES)
        matrix += np.einsum("lu,uv->luv", 1.0 - usable, np.eye(2 * NUM_LOBES))
        step = scale * np.linalg.solve(matrix, (scale * slope)[..., None])[..., 0]
        trial = np.clip(best + np.clip(step, -longest, longest), lower, upper)
        new_error, new_slope, new_curvature = evaluate(trial)
        better = new_error < error  # false for NaN
        best, slope = (np.where(better[:, None], a, b) for a, b in ((trial, best), (new_slope, slope)))
        curvature = np.where(better[:, None, None], new_curvature, curvature)
        error = np.where(better, new_error, error)
        damping = np.clip(damping * np.where(better, LESS, MORE), 1e-9, 1e9)
    return Lobes(np.array(lobes.kind), np.exp(best[:, :NUM_LOBES]), best[:, NUM_LOBES:])


def projected_step(
    problem: AngleProblem,
    i: Int[np.ndarray, " lane"],
    columns: Float[np.ndarray, "lane direction column"],
    degree: Int[np.ndarray, "lane channel"],
) -> tuple[Float[np.ndarray, " lane"], Float[np.ndarray, "lane unknown"], Float[np.ndarray, "lane unknown unknown"]]:
    """Return the squared error with everything linear solved, minus half its gradient, and half its curvature.

    Args:
        problem: What is fitted.
        i: Incident angle of each lane.
        columns: Shapes, their derivatives by the unknowns of every lobe, the same by the next ones.
        degree: Of each channel's background, -1: no part.
    """
    inner = _inner(problem, i, columns, degree)
    lobes = slice(0, NUM_LOBES)
    of_lobe = np.arange(columns.shape[2]) % NUM_LOBES
    gram, moment = inner.gram, inner.moment  # [lane, channel, column, column], [lane, channel, column]
    own = gram[..., lobes, lobes]
    whole = np.einsum("ldk,ldk->lk", columns[..., lobes], columns[..., lobes])
    hold = np.where(whole > 0, DEPENDENT**2 * whole, 1.0)  # a lobe that is absent gets height 0
    ridge = own + np.einsum("lk,km->lkm", hold, np.eye(NUM_LOBES))[:, None]
    solved = np.linalg.solve(ridge, np.concatenate([moment[..., lobes, None], gram[..., lobes, NUM_LOBES:]], axis=-1))
    height, along = solved[..., 0], solved[..., 1:]
    used = (degree >= 0)[..., None]
    height = np.where(used, height, 0.0)
    left = moment - np.einsum("lcuk,lck->lcu", gram[..., lobes], height)
    error = inner.energy - np.einsum("lck,lck->lc", height, moment[..., lobes] + left[..., lobes])
    of_unknown = height[..., of_lobe[NUM_LOBES:]]
    slope = (of_unknown * left[..., NUM_LOBES:]).sum(axis=1)
    rest = gram[..., NUM_LOBES:, NUM_LOBES:] - np.swapaxes(gram[..., lobes, NUM_LOBES:], -1, -2) @ along
    curvature = np.einsum("lcu,lcuv,lcv->luv", of_unknown, rest, of_unknown)
    return np.where(used[..., 0], error, 0.0).sum(axis=1), slope, curvature


def _inner(problem, i, columns, degree) -> Inner:
    """Return inner products of columns and values, each channel's harmonics taken out."""
    functions = problem.functions[:, : columns.shape[1]]
    turned = np.swapaxes(columns, 1, 2)
    on_column = np.stack([functions[k].T @ c for k, c in zip(i, columns, strict=True)])  # [lane, harmonic, column]
    value = np.stack([c @ problem.value[k] for k, c in zip(i, turned, strict=True)])  # [lane, column, channel]
    on_value = np.swapaxes(functions, 1, 2) @ problem.value  # [i, harmonic, channel]
    starts = np.searchsorted(problem.degree_of, np.arange(problem.degree_of.max() + 1))
    pairs = np.add.reduceat(on_column[..., :, None] * on_column[..., None, :], starts, axis=1).cumsum(axis=1)
    crossed = np.add.reduceat(on_column[..., :, None] * on_value[i][:, :, None, :], starts, axis=1).cumsum(axis=1)
    squares = np.add.reduceat(on_value**2, starts, axis=1).cumsum(axis=1)[i]
    place = np.maximum(degree, 0)
    lane, channel = np.arange(len(i))[:, None], np.arange(degree.shape[1])
    gram = (turned @ columns)[:, None] - pairs[lane, place]
    moment = np.swapaxes(value, 1, 2) - crossed[lane, place, :, channel]
    energy = (problem.value**2).sum(axis=1)[i] - squares[lane, place, channel]
    return Inner(gram, moment, energy)
