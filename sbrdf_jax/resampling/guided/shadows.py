"""What would be measured beside drop-outs: something stood in the way there, for that incident angle alone."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from sbrdf_jax.angles import unit_vector
from sbrdf_jax.coverage import cluster_incidences
from sbrdf_jax.records import RawSamples
from sbrdf_jax.resampling.guided.coordinates import from_log, guided_coordinates, log_scale, to_log
from sbrdf_jax.resampling.guided.field import GuidedField, evaluate_directions

Angles = tuple[Float[np.ndarray, " direction"], Float[np.ndarray, " direction"], Float[np.ndarray, " direction"]]
NUM_NEAREST = 6  # measured directions that tell whether one beside them is hidden
POWER = 6  # of the inverse distance: shadows have edges
SAME_PLACE = 1e-9


def measured_value(
    field: GuidedField,
    value: Float[np.ndarray, "direction wavelength"],
    angles: Angles,
    samples: RawSamples,
    dropouts: RawSamples,
) -> Float[np.ndarray, "direction wavelength"]:
    """Darken values of a fitted field [1/sr] where a measurement would see what stood in the way of drop-outs.

    How far drop-outs lie below the field, in z, is interpolated among the measured directions of
    their incident angle (Shepard 1968, doi:10.1145/800186.810616); the others lie below it by 0.

    Args:
        field: Fitted without the drop-outs.
        value: Its values.
        angles: Where: theta_i, theta_o, phi_o [rad].
        samples: What it was fitted to.
        dropouts: What was left out.
    """
    if not dropouts.num_samples:
        return value
    hidden, seen = (np.stack([s.theta_i, s.theta_o, s.phi_o]) for s in (dropouts, samples))
    asked = np.stack(angles)
    known = np.concatenate([hidden, seen], axis=1)
    group = cluster_incidences(np.concatenate([known[0], asked[0]]))[1]
    of_known, of_asked = np.split(group, [known.shape[1]])
    depth = np.zeros((known.shape[1], value.shape[1]))
    at = guided_coordinates(*hidden, field.theta_limit)
    scale = log_scale(at, field.floor)
    below = to_log(dropouts.value, scale) - to_log(evaluate_directions(field, *hidden), scale)
    depth[: hidden.shape[1]] = np.minimum(below, 0.0)

    shaded = value.copy()
    for number in np.intersect1d(of_known[: hidden.shape[1]], of_asked):
        near, row = np.flatnonzero(of_known == number), np.flatnonzero(of_asked == number)
        place = guided_coordinates(*asked[:, row], field.theta_limit)
        scale = log_scale(place, field.floor)
        lowered = to_log(value[row], scale) + _interpolate(known[1:, near], depth[near], asked[1:, row])
        shaded[row] = np.minimum(from_log(np.maximum(lowered, 0.0), scale), value[row])
    return shaded


def _interpolate(known: np.ndarray, depth: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Inverse-distance interpolation of depths [known, wavelength] to other directions [theta_o and phi_o, asked]."""
    distance, nearest = KDTree(unit_vector(*known)).query(unit_vector(*asked), k=min(NUM_NEAREST, known.shape[1]))
    closeness = 1 / np.maximum(distance, SAME_PLACE).reshape(asked.shape[1], -1)
    weight = (closeness / closeness.max(axis=1, keepdims=True)) ** POWER
    weight = weight / weight.sum(axis=1, keepdims=True)
    return np.einsum("an,anw->aw", weight, depth[nearest.reshape(weight.shape)])
