"""The normal equations of eq. (6) on the tied grid, without the matrix.

Samples share few incident angles and the kernels are separable, so with one row vector
a_k over theta_i and one matrix B_k over directions for each incident angle,
A'A = sum_k (a_k a_k') x (B_k' B_k), a sum of Kronecker products: an order of magnitude
fewer operations than the full matrix, and no array of unknowns x unknowns. Where the
incident angles are many (scattered), the sum runs over pairs of theta_i nodes instead,
with the same code. The second differences of eq. (10) are stencils on the grid.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sbrdf_jax.angles import SAME_ANGLE
from sbrdf_jax.grid import Grid, second_difference_rows
from sbrdf_jax.records import RawSamples, pytree
from sbrdf_jax.sinc import azimuth_distance, polar_distance, sinc_weight

CHUNK = 256  # samples whose rows are held at once


@dataclasses.dataclass(frozen=True)
class Layout:
    """The static part of a grid: sizes and ties, hashable, so that it may select compiled code."""

    num_theta_i: int
    num_theta_o: int
    num_azimuths: int
    folded: bool
    tied: bool  # the plane at theta_i = 0 holds one value for each theta_o

    @classmethod
    def of(cls, grid: Grid) -> "Layout":
        """Return the layout of a grid."""
        return cls(
            num_theta_i=len(grid.theta_i),
            num_theta_o=len(grid.theta_o),
            num_azimuths=grid.num_azimuths,
            folded=grid.bilateral,
            tied=grid.normal_incidence_tied,
        )

    @property
    def num_directions(self) -> int:
        """Direction nodes: the pole, then every theta_o ring."""
        return 1 + (self.num_theta_o - 1) * self.num_azimuths

    def spread(self, x: Float[Array, "unknown lane"]) -> Float[Array, "theta_i direction lane"]:
        """Copy unknowns to the planes of direction nodes, eq. (8) read backwards."""
        lanes = x.shape[1]
        if not self.tied:
            return x.reshape(self.num_theta_i, self.num_directions, lanes)
        normal = jnp.concatenate([x[:1], jnp.repeat(x[1 : self.num_theta_o], self.num_azimuths, axis=0)])
        return jnp.concatenate([normal[None], x[self.num_theta_o :].reshape(-1, self.num_directions, lanes)])

    def merge(self, planes: Float[Array, "theta_i direction lane"]) -> Float[Array, "unknown lane"]:
        """Add up the planes' entries over tied nodes: the transpose of `spread`, eq. (9)."""
        lanes = planes.shape[2]
        if not self.tied:
            return planes.reshape(-1, lanes)
        rings = planes[0, 1:].reshape(self.num_theta_o - 1, self.num_azimuths, lanes).sum(axis=1)
        return jnp.concatenate([planes[0, :1], rings, planes[1:].reshape(-1, lanes)])


@pytree(static=("offsets",))
class SecondDifferences:
    """w^2 D'D on the planes of direction nodes, D the relations of eq. (10), without a matrix.

    Over directions it is banded: a few diagonals at fixed offsets among the ring nodes, and
    one row and column for the pole. Over theta_i it is a small matrix times the number of
    azimuths that a direction node stands for.
    """

    bands: Any  # [offset, ring node]
    pole_row: Any  # [direction]; its first entry is the pole's diagonal
    over_theta_i: Any  # [theta_i, theta_i]
    count: Any  # [direction]
    offsets: tuple[int, ...]

    def multiply(self, planes: Float[Array, "theta_i direction lane"]) -> Float[Array, "theta_i direction lane"]:
        """Return w^2 D'D applied to planes."""
        pole, rings = planes[:, :1], planes[:, 1:]
        reach, size = max(map(abs, self.offsets)), rings.shape[1]
        padded = jnp.pad(rings, ((0, 0), (reach, reach), (0, 0)))
        image = rings * 0.0
        for band, offset in zip(self.bands, self.offsets, strict=True):
            shifted = jax.lax.slice_in_dim(padded, reach + offset, reach + offset + size, axis=1)
            image = image + band[None, :, None] * shifted
        image = image + self.pole_row[None, 1:, None] * pole
        at_pole = jnp.einsum("d,mdw->mw", self.pole_row, planes)[:, None]
        across = jnp.einsum("mn,ndw->mdw", self.over_theta_i, planes) * self.count[None, :, None]
        return jnp.concatenate([at_pole, image], axis=1) + across


def second_differences(grid: Grid, smoothness_weight: float) -> SecondDifferences:
    """Take the bands of w^2 D'D out of eq. (10)'s rows for one incident angle, on the host."""
    directions = dataclasses.replace(grid, theta_i=np.array([1.0]), interpolate_theta_i=False)
    rows = second_difference_rows(directions)
    product = (smoothness_weight**2 * (rows.T @ rows)).tocoo()
    pole = (product.row == 0) | (product.col == 0)
    pole_row = np.zeros(grid.num_directions)
    np.add.at(pole_row, product.col[product.row == 0], product.data[product.row == 0])
    row, column, value = product.row[~pole] - 1, product.col[~pole] - 1, product.data[~pole]
    offsets = np.unique(column - row)
    bands = np.zeros((len(offsets), grid.num_directions - 1))
    bands[np.searchsorted(offsets, column - row), row] = value
    size = len(grid.theta_i)
    difference = np.diff(np.eye(size), 2, axis=0) if grid.interpolate_theta_i else np.zeros((1, size))
    return SecondDifferences(
        bands=jnp.asarray(bands),
        pole_row=jnp.asarray(pole_row),
        over_theta_i=jnp.asarray(smoothness_weight**2 * difference.T @ difference),
        count=jnp.asarray(np.bincount(grid.direction_index.ravel()).astype(float)),
        offsets=tuple(int(o) for o in offsets),
    )


@pytree(static=("layout",))
class TiedGridNormal:
    """A'A of eq. (6) with eq. (10)'s rows, columns merged as in eq. (9); a `nnls.NormalOperator`."""

    left: Any  # [term, theta_i]
    right: Any  # [term, theta_i]
    block: Any  # [term, direction, direction]
    smoothness: SecondDifferences
    entries: Any  # [unknown] the diagonal
    layout: Layout

    def multiply(self, x: Float[Array, "unknown lane"]) -> Float[Array, "unknown lane"]:
        """Return A'A x, term by term, and the second differences twice over."""
        planes = self.layout.spread(x)
        mixed = jnp.einsum("km,mdw->kdw", self.right, planes)
        image = jnp.einsum("kde,kew->kdw", self.block, mixed)
        data = jnp.einsum("km,kdw->mdw", self.left, image)
        return self.layout.merge(data + self.smoothness.multiply(planes))

    def diagonal(self) -> Float[Array, " unknown"]:
        """Return the diagonal of A'A."""
        return self.entries


@dataclasses.dataclass(frozen=True)
class SampleTerms:
    """The angles of a measurement, sorted into the terms of the Kronecker sum and padded to equal length."""

    incidence: np.ndarray  # [group, theta_i] kernel weights over theta_i; for scattered incidences one row a sample
    theta_o: np.ndarray  # [group, padded sample] rad
    phi_o: np.ndarray  # [group, padded sample] rad
    sample: np.ndarray  # [group, padded sample] index of the sample, -1 for padding
    scattered: bool


def sample_terms(samples: RawSamples, grid: Grid) -> SampleTerms:
    """Sort samples by incident angle on the host: one group each, or one for all where there are many."""
    exact = np.round(samples.theta_i / SAME_ANGLE).astype(np.int64)
    _, first, group = np.unique(exact, return_index=True, return_inverse=True)
    scattered = len(first) > len(grid.theta_i) ** 2
    incidence = np.asarray(theta_i_weights(samples.theta_i, grid))
    if scattered:
        group = np.zeros_like(group)
    else:
        incidence = incidence[first]
    longest = int(np.bincount(group).max())
    padded = -(-longest // CHUNK) * CHUNK
    sample = np.full((group.max() + 1, padded), -1)
    order = np.argsort(group, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(group))[:-1]])
    sample[group[order], np.arange(len(order)) - starts[group[order]]] = order
    return SampleTerms(incidence, samples.theta_o[sample], samples.phi_o[sample], sample, scattered)


def theta_i_weights(theta_i: np.ndarray, grid: Grid) -> np.ndarray:
    """Kernel weights [sample, theta_i]; 1 at the nearest node where nothing is interpolated over theta_i."""
    distance = theta_i[:, None] - grid.theta_i
    if not grid.interpolate_theta_i:
        return (np.argmin(np.abs(distance), axis=1)[:, None] == np.arange(len(grid.theta_i))).astype(float)
    return np.sinc(distance / grid.steps[0])


def direction_rows(
    theta_o: Float[Array, " sample"], phi_o: Float[Array, " sample"], *, layout: Layout, steps: tuple[float, float]
) -> Float[Array, "sample direction"]:
    """Rows of eq. (6) over the direction nodes: sinc in theta_o times sinc in phi_o, columns merged."""
    nodes = jnp.arange(layout.num_theta_o, dtype=theta_o.dtype) * steps[0]
    polar = sinc_weight(polar_distance(theta_o, nodes), steps[0])
    circle = 2 * (layout.num_azimuths - 1) if layout.folded else layout.num_azimuths
    azimuth = sinc_weight(azimuth_distance(phi_o, circle), steps[1])
    if layout.folded:
        half = circle // 2
        mirrored = jnp.zeros_like(azimuth[:, : half + 1]).at[:, 1:half].set(azimuth[:, :half:-1])
        azimuth = azimuth[:, : half + 1] + mirrored
    pole = polar[:, :1] * jnp.sum(azimuth, axis=1, keepdims=True)
    ring = (polar[:, 1:, None] * azimuth[:, None, :]).reshape(len(theta_o), -1)
    return jnp.concatenate([pole, ring], axis=1)


@functools.partial(jax.jit, static_argnames=("layout", "steps"))
def _grouped_sums(theta_o, phi_o, is_sample, values, *, layout: Layout, steps: tuple[float, float]):
    """Return B_k'B_k [group, direction, direction] and B_k'b_k [group, direction, lane], chunk by chunk."""

    def add_group(group):
        def add_chunk(carry, chunk):
            theta, phi, keep, value = chunk
            rows = direction_rows(theta, phi, layout=layout, steps=steps) * keep[:, None]
            return (carry[0] + rows.T @ rows, carry[1] + rows.T @ value), None

        chunks = jax.tree.map(lambda a: a.reshape((-1, CHUNK) + a.shape[1:]), group)
        size = layout.num_directions
        start = (jnp.zeros((size, size), values.dtype), jnp.zeros((size, values.shape[-1]), values.dtype))
        return jax.lax.scan(add_chunk, start, chunks)[0]

    return jax.lax.map(add_group, (theta_o, phi_o, is_sample, values))


@functools.partial(jax.jit, static_argnames=("layout", "steps"))
def _scattered_sums(incidence, theta_o, phi_o, is_sample, values, *, layout: Layout, steps: tuple[float, float]):
    """The same for one group of scattered incident angles, over pairs of theta_i nodes."""

    def add_chunk(carry, chunk):
        weight, theta, phi, keep, value = chunk
        rows = direction_rows(theta, phi, layout=layout, steps=steps) * keep[:, None]
        full = (weight[:, :, None] * rows[:, None, :]).reshape(CHUNK, -1)
        return (carry[0] + full.T @ full, carry[1] + full.T @ value), None

    chunks = jax.tree.map(
        lambda a: a.reshape((-1, CHUNK) + a.shape[1:]), (incidence, theta_o, phi_o, is_sample, values)
    )
    size = layout.num_theta_i * layout.num_directions
    start = (jnp.zeros((size, size), values.dtype), jnp.zeros((size, values.shape[-1]), values.dtype))
    return jax.lax.scan(add_chunk, start, chunks)[0]


def normal_equations(
    samples: RawSamples, grid: Grid, smoothness_weight: float
) -> tuple[TiedGridNormal, Float[Array, "unknown lane"]]:
    """Build A'A and A'b of eqs. (6), (9) and (10) for all wavelengths.

    Args:
        samples: Measurement; a wavelength that is not finite somewhere stays so in A'b.
        grid: The nodes and their ties.
        smoothness_weight: Factor on each relation of eq. (10); printed as 1.

    Returns:
        The operator A'A and A'b, a column per wavelength.
    """
    layout, steps = Layout.of(grid), grid.steps[1:]
    terms = sample_terms(samples, grid)
    is_sample = (terms.sample >= 0).astype(float)
    values = np.where(terms.sample[..., None] >= 0, samples.value[terms.sample], 0.0)
    num_i, num_d = layout.num_theta_i, layout.num_directions
    if terms.scattered:
        incidence = terms.incidence[terms.sample[0]]
        full, rhs = _scattered_sums(
            incidence, terms.theta_o[0], terms.phi_o[0], is_sample[0], values[0], layout=layout, steps=steps
        )
        block = full.reshape(num_i, num_d, num_i, num_d).transpose(0, 2, 1, 3).reshape(-1, num_d, num_d)
        left, right = np.repeat(np.eye(num_i), num_i, axis=0), np.tile(np.eye(num_i), (num_i, 1))
        planes = rhs.reshape(num_i, num_d, -1)
    else:
        block, group_rhs = _grouped_sums(terms.theta_o, terms.phi_o, is_sample, values, layout=layout, steps=steps)
        left = right = terms.incidence
        planes = jnp.einsum("km,kdw->mdw", jnp.asarray(left), group_rhs)
    rows = second_difference_rows(grid)
    diagonal = _data_diagonal(left, right, np.asarray(block), layout)
    diagonal += smoothness_weight**2 * np.asarray(rows.multiply(rows).sum(axis=0)).ravel()
    operator = TiedGridNormal(
        left=jnp.asarray(left),
        right=jnp.asarray(right),
        block=block,
        smoothness=second_differences(grid, smoothness_weight),
        entries=jnp.asarray(diagonal),
        layout=layout,
    )
    return operator, layout.merge(planes)


def _data_diagonal(left: np.ndarray, right: np.ndarray, block: np.ndarray, layout: Layout) -> np.ndarray:
    planes = (left * right).T @ np.einsum("kdd->kd", block)
    if not layout.tied:
        return planes.ravel()
    size = layout.num_azimuths
    rings = block[:, 1:, 1:].reshape(-1, layout.num_theta_o - 1, size, layout.num_theta_o - 1, size)
    tied = np.concatenate([block[:, :1, 0], np.einsum("knanb->kn", rings)], axis=1)
    return np.concatenate([(left * right)[:, 0] @ tied, planes[1:].ravel()])
