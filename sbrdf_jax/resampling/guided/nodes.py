"""The two uniform grids that carry the residual, and the smoothness that ties their nodes.

Xu, eq. (5), has a separable kernel at every node of a uniform grid, and eqs. (9) and (10)
tie neighbours by second differences. Here the kernel is Keys' cubic (four nodes an axis,
mirrored at the ends), and the energy of a grid's nodes is diagonal in cosines: every mode
cos(k_1 x) cos(k_2 y) cos(k_3 z) has the variance that a Matern spectrum gives its frequency.
Of order 1/2 this is the energy of second differences, of order 3/2 one order smoother, so
that x' E x, E^-1 and E^-1/2 all cost a few small matrix products.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sbrdf_jax.array_module import AnyArray, array_module
from sbrdf_jax.records import pytree
from sbrdf_jax.resampling.guided.coordinates import Coordinates


class Axis(NamedTuple):
    """Uniform nodes from `start` to `stop`, both included."""

    start: float
    stop: float
    count: int

    @property
    def nodes(self) -> np.ndarray:
        """Places of the nodes."""
        return np.linspace(self.start, self.stop, self.count)

    @property
    def frequency(self) -> np.ndarray:
        """Angular frequency of each cosine mode."""
        return np.pi * np.arange(self.count) / (self.stop - self.start)

    @property
    def modes(self) -> np.ndarray:
        """Cosine modes [node, mode], of unit norm as functions on the axis."""
        length = self.stop - self.start
        norm = np.where(np.arange(self.count) == 0, np.sqrt(1 / length), np.sqrt(2 / length))
        return np.cos(np.outer(self.nodes - self.start, self.frequency)) * norm


HALF = Axis(0.0, math.log(91.0), 33)  # log(theta_h [deg] + 1)
AZIMUTH = Axis(0.0, math.pi, 25)  # rad, folded
THETA = Axis(0.0, math.pi / 2, 19)  # rad, theta_i and theta_o
GRIDS = {"half": (HALF, THETA, THETA), "azimuth": (AZIMUTH, THETA, THETA)}


class Term(NamedTuple):
    """One Matern term of the residual's prior."""

    grid: str  # a name of GRIDS
    order: float  # 1/2: second differences; 3/2: one order smoother
    variance: float
    lengths: tuple[float, float, float]  # in the grid's coordinates


@pytree(static=("reciprocal",))
class ModeVariance:
    """Prior variance of each cosine mode; E^-1 of either grid is modes x variance x modes'."""

    half: Any  # [half, theta_i, theta_o]
    azimuth: Any  # [azimuth, theta_i, theta_o]
    reciprocal: bool = False  # nodes of exchanged theta_i and theta_o are tied


@functools.cache
def mode_variance(terms: tuple[Term, ...], constant: float, reciprocal: bool = False) -> ModeVariance:
    """Return the variances of a prior's modes.

    The spectrum of a Matern term of order v in three dimensions is proportional to
    (2 v + |length x frequency|^2)^-(v + 3/2).

    Args:
        terms: The prior's terms, which add up.
        constant: Variance of a constant added to all.
        reciprocal: Tie nodes by Helmholtz reciprocity.
    """
    total = {name: np.zeros([axis.count for axis in axes]) for name, axes in GRIDS.items()}
    for term in terms:
        axes, order = GRIDS[term.grid], term.order
        steps = [(length * axis.frequency) ** 2 for length, axis in zip(term.lengths, axes, strict=True)]
        square = steps[0][:, None, None] + steps[1][None, :, None] + steps[2][None, None, :]
        level = 8 * np.pi**1.5 * math.gamma(order + 1.5) / math.gamma(order) * (2 * order) ** order
        total[term.grid] += term.variance * level * np.prod(term.lengths) * (2 * order + square) ** -(order + 1.5)
    total["half"][0, 0, 0] += constant * np.prod([axis.stop - axis.start for axis in GRIDS["half"]])
    if reciprocal:
        total = {name: (modes + np.swapaxes(modes, 1, 2)) / 2 for name, modes in total.items()}
    return ModeVariance(half=total["half"], azimuth=total["azimuth"], reciprocal=reciprocal)


def cubic_weights(
    x: Float[AnyArray, "*shape"], axis: Axis
) -> tuple[Int[AnyArray, "*shape"], Float[AnyArray, "*shape 4"]]:
    """Return Keys' cubic convolution weights (a = -1/2) of the four nodes around a place.

    Args:
        x: Places; beyond the ends they are clamped.
        axis: The nodes.

    Returns:
        Index of the first of the four, in the axis with one mirrored node added at each end, and their weights.
    """
    xp = array_module(x)
    step = (axis.stop - axis.start) / (axis.count - 1)
    place = xp.clip((x - axis.start) / step, 0.0, axis.count - 1.0)
    first = xp.clip(xp.floor(place), 0.0, axis.count - 2.0)
    t = (place - first)[..., None]
    weight = xp.concatenate(
        [
            ((2 - t) * t - 1) * t / 2,
            ((3 * t - 5) * t * t + 2) / 2,
            ((4 - 3 * t) * t + 1) * t / 2,
            (t - 1) * t * t / 2,
        ],
        axis=-1,
    )
    return first.astype(np.int32), weight


def cubic_matrix(x: Float[AnyArray, "*shape"], axis: Axis) -> Float[AnyArray, "*shape node"]:
    """`cubic_weights` as rows over all nodes, the mirrored ones included; for products with a few rows of nodes."""
    first, weight = cubic_weights(x, axis)
    if array_module(x) is np:
        rows = np.zeros((*x.shape, axis.count + 2))
        np.put_along_axis(rows, _four(first), weight, axis=-1)
        return rows
    nodes = np.arange(axis.count + 2, dtype=np.int32).reshape((1,) * (x.ndim + 1) + (-1,))
    return jnp.where(_four(first)[..., None] == nodes, weight[..., None], 0.0).sum(axis=-2)


def _four(first: Int[AnyArray, "*shape"]) -> Int[AnyArray, "*shape 4"]:
    return array_module(first).stack([first + np.int32(k) for k in range(4)], axis=-1)


def axis_features(x: Float[AnyArray, "*shape"], axis: Axis) -> Float[AnyArray, "*shape mode"]:
    """Values of the interpolated cosine modes at places along an axis."""
    first, weight = cubic_weights(x, axis)
    mirrored = np.pad(axis.modes, ((1, 1), (0, 0)), mode="reflect")
    around = array_module(x).asarray(mirrored, x.dtype)[_four(first)]
    return (weight[..., None] * around).sum(axis=-2)


@pytree()
class Features:
    """Interpolated cosine modes of directions; the covariance of two directions is bilinear in them."""

    theta_i: Any  # [*, mode]
    half: Any  # [*, mode of half x mode of theta_o]
    azimuth: Any  # [*, mode of azimuth x mode of theta_o]


def features_of(at: Coordinates) -> Features:
    """Return the features of directions, given by their coordinates."""
    theta_o = axis_features(at.theta_o, THETA)

    def product(first):
        return (first[..., :, None] * theta_o[..., None, :]).reshape(*theta_o.shape[:-1], -1)

    return Features(
        theta_i=axis_features(at.theta_i, THETA),
        half=product(axis_features(at.half, HALF)),
        azimuth=product(axis_features(at.azimuth, AZIMUTH)),
    )


def mirror(
    nodes: Float[AnyArray, "first theta_i theta_o wavelength"],
) -> Float[AnyArray, "more more2 more3 wavelength"]:
    """Add one mirrored node at each end of the three axes."""
    return array_module(nodes).pad(nodes, ((1, 1), (1, 1), (1, 1), (0, 0)), mode="reflect")


def interpolate(
    mirrored: Float[Array, "first theta_i theta_o wavelength"],
    places: tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]],
    axes: tuple[Axis, Axis, Axis],
) -> Float[Array, " wavelength"]:
    """Evaluate one grid at one place: eq. (5) with Keys' cubic kernel.

    Args:
        mirrored: Nodes, from `mirror`.
        places: Where.
        axes: The grid's axes.
    """
    first, weight = zip(*(cubic_weights(x, axis) for x, axis in zip(places, axes, strict=True)), strict=True)
    around = jax.lax.dynamic_slice(mirrored, (*first, np.int32(0)), (4, 4, 4, mirrored.shape[-1]))
    product = jnp.einsum("i,j,k->ijk", *weight)
    return product.reshape(-1) @ around.reshape(64, -1)


def synthesise(
    amplitude: Float[AnyArray, "first theta_i theta_o wavelength"], axes: tuple[Axis, Axis, Axis]
) -> Float[AnyArray, "first theta_i theta_o wavelength"]:
    """Return node values of a sum of modes."""
    for place, axis in enumerate(axes):
        amplitude = array_module(amplitude).tensordot(axis.modes, amplitude, (1, place))
        amplitude = array_module(amplitude).moveaxis(amplitude, 0, place)
    return amplitude
