"""The three uniform grids that carry the residual, and the smoothness that ties their nodes.

Xu, eq. (5), has a separable kernel at every node of a uniform grid, and eqs. (9) and (10)
tie neighbours by second differences. Here the kernel is Keys' cubic (four nodes an axis,
mirrored at the ends), and the energy of a grid's nodes is diagonal in cosines: every mode
cos(k_1 x) cos(k_2 y) cos(k_3 z) has the variance that a Matern spectrum gives its frequency.
Of order 1/2 this is the energy of second differences, of order 3/2 one order smoother, so
that x' E x, E^-1 and E^-1/2 all cost a few small matrix products.

Two grids are over both polar angles. The third is over half and difference angle, of which
most materials are a function: directions share what they have in common across incident
angles, over short lengths. Its terms are Gaussian, order infinity, and so a product of
functions of one coordinate each: fine nodes cost little.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
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
DIFFERENCE = Axis(0.0, math.pi / 2, 46)  # rad
LEAN = Axis(-math.pi / 2, math.pi / 2, 9)  # rad


class Grid(NamedTuple):
    """Nodes over three coordinates of `Coordinates`."""

    coordinates: tuple[str, str, str]
    axes: tuple[Axis, Axis, Axis]

    def places(self, at: Coordinates) -> tuple[Any, Any, Any]:
        """Return where directions are along each axis."""
        one, two, three = (getattr(at, name) for name in self.coordinates)
        return one, two, three


POLAR_GRIDS = {
    "half": Grid(("half", "theta_i", "theta_o"), (HALF, THETA, THETA)),
    "azimuth": Grid(("azimuth", "theta_i", "theta_o"), (AZIMUTH, THETA, THETA)),
}
GRIDS = POLAR_GRIDS | {"difference": Grid(("lean", "half", "difference"), (LEAN, HALF, DIFFERENCE))}


class Term(NamedTuple):
    """One Matern term of the residual's prior."""

    grid: str  # a name of GRIDS
    order: float  # 1/2: second differences; 3/2: one order smoother; infinity, of "difference" alone: Gaussian
    variance: float
    lengths: tuple[float, float, float]  # in the grid's coordinates


@pytree(static=("reciprocal",))
class ModeVariance:
    """Prior variance of each cosine mode; E^-1 of a grid is modes x variance x modes'."""

    half: Any  # [half, theta_i, theta_o]
    azimuth: Any  # [azimuth, theta_i, theta_o]
    # of "difference": a sum over terms of products; no term in results of earlier versions
    along_lean: Any = dataclasses.field(default_factory=lambda: np.zeros((0, LEAN.count)))  # [term, mode]
    along_half: Any = dataclasses.field(default_factory=lambda: np.zeros((0, HALF.count)))  # [term, mode]
    along_difference: Any = dataclasses.field(default_factory=lambda: np.zeros((0, DIFFERENCE.count)))  # [term, mode]
    reciprocal: bool = False  # nodes of exchanged theta_i and theta_o are tied

    @property
    def along(self) -> tuple[Any, Any, Any]:
        """The factors of the difference grid's terms along each of its axes."""
        return self.along_lean, self.along_half, self.along_difference

    @property
    def difference(self) -> Any:
        """Variances [lean, half, difference], summed over the terms."""
        xp = array_module(*self.along)
        return xp.einsum("tl,th,td->lhd", *self.along)


@functools.cache
def mode_variance(terms: tuple[Term, ...], constant: float, reciprocal: bool = False) -> ModeVariance:
    """Return the variances of a prior's modes.

    The spectrum of a Matern term of order v in three dimensions is proportional to
    (2 v + |length x frequency|^2)^-(v + 3/2), of a Gaussian one to exp(-|length x frequency|^2 / 2).

    Args:
        terms: The prior's terms, which add up.
        constant: Variance of a constant added to all.
        reciprocal: Tie nodes by Helmholtz reciprocity.
    """
    total = {name: np.zeros([axis.count for axis in grid.axes]) for name, grid in POLAR_GRIDS.items()}
    along: list[list[np.ndarray]] = []
    for term in terms:
        axes, order = GRIDS[term.grid].axes, term.order
        if order == math.inf:
            along.append([
                math.sqrt(2 * np.pi) * length * np.exp(-((length * axis.frequency) ** 2) / 2)
                for length, axis in zip(term.lengths, axes, strict=True)
            ])  # fmt: skip
            along[-1][0] *= term.variance
            continue
        steps = [(length * axis.frequency) ** 2 for length, axis in zip(term.lengths, axes, strict=True)]
        square = steps[0][:, None, None] + steps[1][None, :, None] + steps[2][None, None, :]
        level = 8 * np.pi**1.5 * math.gamma(order + 1.5) / math.gamma(order) * (2 * order) ** order
        total[term.grid] += term.variance * level * np.prod(term.lengths) * (2 * order + square) ** -(order + 1.5)
    total["half"][0, 0, 0] += constant * np.prod([axis.stop - axis.start for axis in GRIDS["half"].axes])
    if reciprocal:
        total = {name: (modes + np.swapaxes(modes, 1, 2)) / 2 for name, modes in total.items()}
    of_terms = [np.stack(factors) for factors in zip(*along, strict=True)]
    return ModeVariance(total["half"], total["azimuth"], *of_terms, reciprocal=reciprocal)


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


def cubic_rows(places: Sequence[Float[np.ndarray, " direction"]], axes: Sequence[Axis]) -> scipy.sparse.csr_array:
    """`cubic_weights` of several axes as sparse rows [direction, nodes], the mirrored ones included; on the host."""
    first, weight = zip(*map(cubic_weights, places, axes), strict=True)
    shape = tuple(axis.count + 2 for axis in axes)
    around = np.ravel_multi_index(tuple(np.indices((4,) * len(axes)).reshape(len(axes), -1)), shape)
    index = np.ravel_multi_index(first, shape).astype(np.int32)[:, None] + around.astype(np.int32)
    product = weight[0]
    for other in weight[1:]:
        product = (product[:, :, None] * other[:, None, :]).reshape(len(product), -1)
    start = np.arange(0, product.size + 1, 4 ** len(axes), dtype=np.int32)
    return scipy.sparse.csr_array((product.ravel(), index.ravel(), start), (len(product), math.prod(shape)))


def _four(first: Int[AnyArray, "*shape"]) -> Int[AnyArray, "*shape 4"]:
    return array_module(first).stack([first + np.int32(k) for k in range(4)], axis=-1)


def axis_features(x: Float[AnyArray, "*shape"], axis: Axis) -> Float[AnyArray, "*shape mode"]:
    """Values of the interpolated cosine modes at places along an axis."""
    return cubic_matrix(x, axis) @ array_module(x).asarray(_mirrored_modes(axis), x.dtype)


@functools.cache
def _mirrored_modes(axis: Axis) -> np.ndarray:
    return np.pad(axis.modes, ((1, 1), (0, 0)), mode="reflect")


@pytree()
class Features:
    """Interpolated cosine modes of directions; the covariance of two directions is bilinear in them."""

    theta_i: Any  # [*, mode]
    half: Any  # [*, mode of half x mode of theta_o]
    azimuth: Any  # [*, mode of azimuth x mode of theta_o]
    along: tuple[Any, Any, Any]  # [*, mode] of each axis of the difference grid


def features_of(at: Coordinates) -> Features:
    """Return the features of directions, given by their coordinates."""
    theta_o = axis_features(at.theta_o, THETA)
    along = difference_features(at)

    def product(first):
        return (first[..., :, None] * theta_o[..., None, :]).reshape(*theta_o.shape[:-1], -1)

    return Features(
        theta_i=axis_features(at.theta_i, THETA),
        half=product(along[1]),
        azimuth=product(axis_features(at.azimuth, AZIMUTH)),
        along=along,
    )


def difference_features(at: Coordinates) -> tuple[Any, Any, Any]:
    """Return the modes of directions [*, mode] along each axis of the difference grid."""
    grid = GRIDS["difference"]
    one, two, three = (axis_features(x, axis) for x, axis in zip(grid.places(at), grid.axes, strict=True))
    return one, two, three


def mirror(
    nodes: Float[AnyArray, "first second third wavelength"],
) -> Float[AnyArray, "more more2 more3 wavelength"]:
    """Add one mirrored node at each end of the three axes."""
    return array_module(nodes).pad(nodes, ((1, 1), (1, 1), (1, 1), (0, 0)), mode="reflect")


def interpolate(
    mirrored: Float[Array, "first second third wavelength"],
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
    amplitude: Float[np.ndarray, "first second third wavelength"], axes: tuple[Axis, Axis, Axis]
) -> Float[np.ndarray, "first second third wavelength"]:
    """Return node values of a sum of modes."""
    return _along_axes([axis.modes for axis in axes], amplitude)


def analyse(
    mirrored: Float[np.ndarray, "more more2 more3 wavelength"], axes: tuple[Axis, Axis, Axis]
) -> Float[np.ndarray, "first second third wavelength"]:
    """Return the sum of each mode's values at mirrored nodes, weighed by what is at them: `synthesise` transposed."""
    return _along_axes([_mirrored_modes(axis).T for axis in axes], mirrored)


def _along_axes(matrices: Sequence[np.ndarray], values: np.ndarray) -> np.ndarray:
    """Multiply each of the first three axes of four by a matrix, without moving it."""
    one, two, three = matrices
    _, second, third, last = values.shape
    values = (one @ values.reshape(len(values), -1)).reshape(len(one), second, -1)
    return three @ (two @ values).reshape(len(one), len(two), third, last)
