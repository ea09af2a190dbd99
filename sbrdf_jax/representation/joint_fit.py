"""Background and lobes of one incident angle, solved jointly by variable projection.

All heights and harmonics are linear, so for given lobes they follow from least squares at once,
and no critical angle is needed. Harmonics are made orthonormal over the weighted directions,
degree by degree (a QR decomposition), so that one decomposition serves every degree; what is
left of the lobes and of the values after the harmonics up to a degree are taken out needs only
inner products. NumPy in float64 on the host, but for the shapes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from sbrdf_jax.angles import SAME_ANGLE
from sbrdf_jax.representation.lobe_family import SHAPES, lobe_shape_of_kind
from sbrdf_jax.representation.lobe_harmonics_value import even_harmonics, even_orders

BANK_SIZE = 40
LANE_BATCH = 16
RIDGE = 1e-6  # of the highest degree, relative to the directions; lower degrees less, by (l (l + 1))^2
DEPENDENT = 1e-6  # share of a lobe that harmonics or another lobe must leave of it
NUM_LOBES = 2


class AngleProblem(NamedTuple):
    """Least squares at each incident angle; rows of ridge, where lobes and values are 0, follow the directions."""

    theta_i: Float[np.ndarray, " i"]  # rad
    theta_o: Float[np.ndarray, " direction"]  # rad
    phi_o: Float[np.ndarray, " direction"]  # rad
    root_weight: Float[np.ndarray, "i direction"]
    value: Float[np.ndarray, "i direction channel"]  # times the root of the weight
    functions: Float[np.ndarray, "i row harmonic"]  # orthonormal; 0 at normal incidence where m > 0
    triangle: Float[np.ndarray, "i harmonic harmonic"]  # harmonics = functions @ triangle
    degree_of: Int[np.ndarray, " harmonic"]

    @property
    def count(self) -> Int[np.ndarray, "i degree"]:
        """Harmonics up to each degree: at normal incidence only those that do not depend on phi_o."""
        degrees = np.arange(self.degree_of.max() + 1)
        all_orders = (degrees + 1) * (degrees + 2) // 2
        return np.where(self.theta_i[:, None] < SAME_ANGLE, degrees + 1, all_orders)


class Lobes(NamedTuple):
    """Lobes of each incident angle."""

    kind: Int[np.ndarray, "*shape lobe"]  # place in `SHAPES`, 0 = none
    width: Float[np.ndarray, "*shape lobe"]
    peak_theta_o: Float[np.ndarray, "*shape lobe"]  # rad


def make_problem(
    theta_i: Float[np.ndarray, " i"],
    theta_o: Float[np.ndarray, " direction"],
    phi_o: Float[np.ndarray, " direction"],
    weight: Float[np.ndarray, "i direction"],
    value: Float[np.ndarray, "i direction channel"],
    max_degree: int,
) -> AngleProblem:
    """Return the problem of every incident angle.

    Args:
        theta_i: Incident angles [rad].
        theta_o: Polar angles [rad] of all directions.
        phi_o: Their azimuths [rad].
        weight: Of squared errors.
        value: Coefficients [1/sr] of orthonormal spectra.
        max_degree: Highest degree of the harmonics.
    """
    orders = np.array(even_orders(max_degree))
    harmonic = np.asarray(even_harmonics(theta_o, phi_o, max_degree), np.float64)
    root = np.sqrt(weight)
    rows = root[:, :, None] * harmonic
    rows[np.ix_(theta_i < SAME_ANGLE, np.arange(len(theta_o)), orders[:, 1] > 0)] = 0.0
    size = orders[:, 0] * (orders[:, 0] + 1)
    ridge = np.sqrt(RIDGE * weight.sum(axis=1) / (4 * np.pi))[:, None] * size / max(size.max(), 1)
    rows = np.concatenate([rows, ridge[:, :, None] * np.eye(len(orders))], axis=1)
    functions, triangle = np.linalg.qr(rows)
    return AngleProblem(theta_i, theta_o, phi_o, root, root[..., None] * value, functions, triangle, orders[:, 0])


class Inner(NamedTuple):
    """Inner products of lobes and values after the harmonics up to each degree are taken out, from degree -1 on."""

    gram: Float[np.ndarray, "*shape degree lobe lobe"]
    moment: Float[np.ndarray, "*shape degree lobe channel"]
    energy: Float[np.ndarray, "*shape degree channel"]


def inner_products(problem: AngleProblem, i: int, shape: Float[np.ndarray, "direction lobe"]) -> Inner:
    """Return the inner products of weighted lobe shapes and the values of one incident angle."""
    functions, value = problem.functions[i, : len(problem.theta_o)], problem.value[i]
    on_lobe, on_value = functions.T @ shape, functions.T @ value
    degrees = range(-1, problem.degree_of.max() + 1)
    gram, moment, energy = [shape.T @ shape], [shape.T @ value], [(value**2).sum(axis=0)]
    for degree in degrees[1:]:
        block = problem.degree_of == degree
        gram.append(gram[-1] - on_lobe[block].T @ on_lobe[block])
        moment.append(moment[-1] - on_lobe[block].T @ on_value[block])
        energy.append(energy[-1] - (on_value[block] ** 2).sum(axis=0))
    return Inner(np.stack(gram), np.stack(moment), np.maximum(np.stack(energy), 0.0))


def heights_and_errors(inner: Inner) -> tuple[np.ndarray, np.ndarray]:
    """Return the best heights [..., degree, lobe, channel] and the squared errors left [..., degree, channel].

    A lobe that nothing is left of (absent, or one that harmonics or the other lobe explain) has height 0.
    """
    whole = np.sqrt(np.maximum(np.diagonal(inner.gram[..., :1, :, :], axis1=-2, axis2=-1), 1e-300))
    scaled = inner.gram / (whole[..., :, None] * whole[..., None, :])
    eigenvalue, vector = np.linalg.eigh(scaled)
    inverse = np.where(eigenvalue > DEPENDENT, 1 / np.where(eigenvalue > DEPENDENT, eigenvalue, 1.0), 0.0)
    right = inner.moment / whole[..., None]
    height = vector @ (inverse[..., None] * (np.swapaxes(vector, -1, -2) @ right))
    error = inner.energy - (height * right).sum(axis=-2)
    return height / whole[..., None], np.clip(error, 0.0, inner.energy)


def shapes_of(problem: AngleProblem, i: Int[np.ndarray, " lane"], lobes: Lobes) -> Float[np.ndarray, "lane d lobe"]:
    """Return the weighted shapes of lobes, those that are absent 0; a place has one kind in all lanes that have it."""
    return np.stack([columns[0] for columns in _columns(problem, i, lobes, shape_alone)], axis=-1)


def shapes_and_slopes(problem: AngleProblem, i: Int[np.ndarray, " lane"], lobes: Lobes):
    """Return weighted shapes and their derivatives by log width and by peak [lane, direction, 3 lobe]."""
    columns = _columns(problem, i, lobes, shape_and_slopes)
    return np.concatenate([np.stack(part, axis=-1) for part in zip(*columns, strict=True)], axis=-1)


def _columns(problem, i, lobes, function):
    found = []
    for kind, width, peak in zip(*(part.T for part in lobes), strict=True):
        weight = problem.root_weight[i] * (kind > 0)[:, None]
        batches = []
        for start in range(0, len(i), LANE_BATCH):  # batches of one shape, the last one filled with copies
            lane = np.minimum(np.arange(start, start + LANE_BATCH), len(i) - 1)
            parts = function(
                kind.max(), problem.theta_i[i[lane]], problem.theta_o, problem.phi_o, width[lane], peak[lane]
            )
            batches.append([np.asarray(part, np.float64) for part in parts])
        found.append([weight * np.concatenate(parts)[: len(i)] for parts in zip(*batches, strict=True)])
    return found


def _on_directions(kind, theta_i, theta_o, phi_o, log_width, peak):
    rows = theta_i[:, None], theta_o[None], phi_o[None], peak[:, None], jnp.exp(log_width)[:, None]
    return lobe_shape_of_kind(kind, *jnp.broadcast_arrays(*rows))


@jax.jit
def shape_alone(kind, theta_i, theta_o, phi_o, width, peak):
    return (_on_directions(kind, theta_i, theta_o, phi_o, jnp.log(width), peak),)


@jax.jit
def shape_and_slopes(kind, theta_i, theta_o, phi_o, width, peak):
    def shape(log_width, peak):
        return _on_directions(kind, theta_i, theta_o, phi_o, log_width, peak)

    log_width, one, zero = jnp.log(width), jnp.ones_like(width), jnp.zeros_like(width)
    value, by_width = jax.jvp(shape, (log_width, peak), (one, zero))
    return value, by_width, jax.jvp(shape, (log_width, peak), (zero, one))[1]


@jax.jit
def _bank_shapes(theta_i, theta_o, phi_o, peak, widths):
    """Return shapes [i, kind, width, direction]; `peak` [i, kind], `widths` [kind, width]; "none" is left out."""
    found = []
    for kind in range(1, len(SHAPES)):
        rows = theta_i[:, None, None], theta_o, phi_o, peak[:, kind - 1, None, None], widths[kind - 1][None, :, None]
        rows = (rows[0], theta_o[None, None], phi_o[None, None], *rows[3:])
        found.append(lobe_shape_of_kind(jnp.asarray(kind), *jnp.broadcast_arrays(*rows)))
    return jnp.stack(found, axis=1)


class BankFit(NamedTuple):
    """The best lobes of a bank: one kind for each place, the same at all incident angles, widths each its own."""

    lobes: Lobes  # [choice, degree, i, lobe]; choices: both lobes, the first alone, the second alone
    log_error: float  # sum over degrees and incident angles, of both lobes


def search_bank(
    problem: AngleProblem,
    peak: Float[np.ndarray, "i kind"],
    limits: Float[np.ndarray, "shape 2"],
    degrees: tuple[int, ...],
) -> BankFit:
    """Try all pairs of kinds and widths, at every incident angle and several degrees of the background.

    Args:
        problem: What is fitted.
        peak: Where lobes of each kind but "none" point [rad].
        limits: Least and greatest width of each shape.
        degrees: Of the background.

    Numerics:
        With everything but the lobes projected out, a pair is a system of two unknowns, so all
        pairs are a few matrix products: A = M M' of the moments M, and the Gram matrix G, give what
        a pair takes off the error, (A_aa G_bb - 2 A_ab G_ab + A_bb G_aa) / (G_aa G_bb - G_ab^2).
    """
    widths = np.geomspace(limits[1:, 0], limits[1:, 1], BANK_SIZE, axis=1)
    bank = np.asarray(_bank_shapes(problem.theta_i, problem.theta_o, problem.phi_o, peak, widths), np.float64)
    num_kinds = len(SHAPES) - 1
    found = [_best_pairs(problem, i, bank[i].reshape(-1, bank.shape[-1]), degrees) for i in range(len(problem.theta_i))]
    error = np.stack([pair for pair, _, _ in found])  # [i, degree, kind, kind]
    total = np.log(error).sum(axis=(0, 1))
    first, second = np.unravel_index(np.argmin(np.where(np.tri(num_kinds, k=-1) > 0, np.inf, total)), total.shape)
    pairs = np.stack([place[:, first, second] for _, place, _ in found])  # [i, degree] place in widths x widths
    width = np.stack([widths[first][pairs // BANK_SIZE], widths[second][pairs % BANK_SIZE]], axis=-1)
    if first == second:
        width = -np.sort(-width, axis=-1)  # the wider one first, so that tracks do not cross
    alone = np.stack([place for _, _, place in found])  # [i, degree, kind] place in widths
    chosen = np.array([first, second])
    single = np.stack([widths[kind][alone[..., kind]] for kind in chosen], axis=-1)
    width = np.stack([width, single, single])
    kind = np.broadcast_to(chosen + 1, width.shape) * np.array([[1, 1], [1, 0], [0, 1]])[:, None, None, :]
    at = np.broadcast_to(peak[:, None, :][..., chosen], width.shape)
    lobes = Lobes(*(np.swapaxes(a, 1, 2) for a in (kind, np.where(kind > 0, width, 1.0), at)))
    return BankFit(lobes, float(total[first, second]))


def _best_pairs(problem, i, shapes, degrees):
    """Return the least relative error of each pair of kinds, which widths have it, and the best widths alone."""
    weighted = shapes * problem.root_weight[i]
    whole = (weighted**2).sum(axis=1)
    scaled = weighted / np.sqrt(np.maximum(whole, 1e-300))[:, None]
    inner = inner_products(problem, i, scaled.T)
    num_kinds = len(shapes) // BANK_SIZE
    blocks = (num_kinds, BANK_SIZE, num_kinds, BANK_SIZE)
    errors, places, alone = [], [], []
    for degree in degrees:
        gram, moment, energy = (part[degree + 1] for part in inner)
        left, energy = np.diagonal(gram), energy.sum()
        product = moment @ moment.T
        square = np.diagonal(product)
        determinant = left[:, None] * left - gram**2
        gain = square[:, None] * left + left[:, None] * square - 2 * product * gram
        apart = determinant > DEPENDENT * np.maximum(left[:, None] * left, DEPENDENT)
        gain = np.where(apart, gain / np.where(apart, determinant, 1.0), 0.0).reshape(blocks).transpose(0, 2, 1, 3)
        gain = gain.reshape(num_kinds, num_kinds, -1)
        floor = np.finfo(float).eps * max(float(inner.energy[0].sum()), 1e-300)
        errors.append(np.maximum(energy - gain.max(axis=2), floor) / max(float(inner.energy[0].sum()), 1e-300))
        places.append(gain.argmax(axis=2))
        own = np.where(left > DEPENDENT, square / np.where(left > DEPENDENT, left, 1.0), 0.0)
        alone.append(own.reshape(num_kinds, -1).argmax(axis=1))
    return np.stack(errors), np.stack(places), np.stack(alone)
