"""The uniform grid: node angles, tied nodes as index maps, second-difference rows.

Eqs. (7) to (10). Ties merge columns (eq. 9) and change nothing else: at theta_o = 0 all
azimuths are one node, at theta_i = 0 too, phi_o = 0 and 2 pi are one, and folding ties
phi_o to 2 pi - phi_o.
"""

import dataclasses
import functools

import numpy as np
import scipy.sparse

from sbrdf_jax.coverage import SAME_INCIDENCE, cluster_incidences
from sbrdf_jax.options import GridOptions
from sbrdf_jax.records import GriddedBRDF, RawSamples
from sbrdf_jax.schema import angles_with_data


@dataclasses.dataclass(frozen=True)
class Grid:
    """Nodes of the resampled field, and which of them are one unknown.

    A direction node is a distinct (theta_o, phi_o): the pole first, then theta_o by
    theta_o. An unknown is a node of the whole grid after all ties, theta_i slowest.
    """

    theta_i: np.ndarray  # [theta_i] rad
    theta_o: np.ndarray  # [theta_o] rad, uniform from 0
    num_phi_o: int  # azimuths round the circle, 2 pi not counted again
    bilateral: bool  # phi_o and 2 pi - phi_o are one
    interpolate_theta_i: bool  # False: theta_i are the measured incident angles, nothing between them
    reciprocal: bool = False  # the field is tied by Helmholtz reciprocity

    @property
    def phi_o(self) -> np.ndarray:
        """Azimuths of the stored grid [rad]: 0 to 2 pi inclusive."""
        return np.linspace(0.0, 2 * np.pi, self.num_phi_o + 1)

    @property
    def steps(self) -> tuple[float, float, float]:
        """Node spacings [rad] in theta_i (1 where nothing is interpolated over it), theta_o and phi_o."""
        theta_i = float(self.theta_i[1] - self.theta_i[0]) if self.interpolate_theta_i else 1.0
        return theta_i, float(self.theta_o[1] - self.theta_o[0]), 2 * np.pi / self.num_phi_o

    @property
    def num_azimuths(self) -> int:
        """Distinct azimuths after folding."""
        return self.num_phi_o // 2 + 1 if self.bilateral else self.num_phi_o

    @property
    def key(self) -> bytes:
        """What tells it from every other grid."""
        ties = f"{self.bilateral}{self.interpolate_theta_i}{self.reciprocal}".encode()
        return b"".join(np.asarray(axis).tobytes() for axis in (self.theta_i, self.theta_o, self.phi_o)) + ties

    @functools.cached_property
    def azimuth_index(self) -> np.ndarray:
        """[num_phi_o] the distinct azimuth of each azimuth round the circle."""
        circle = np.arange(self.num_phi_o)
        return np.minimum(circle, self.num_phi_o - circle) if self.bilateral else circle

    @property
    def azimuth_multiplicity(self) -> np.ndarray:
        """[num_azimuths] how many azimuths of the circle each distinct one stands for."""
        return np.bincount(self.azimuth_index)

    @functools.cached_property
    def direction_index(self) -> np.ndarray:
        """[theta_o, num_phi_o] the direction node of each (theta_o, phi_o); one at the pole, eq. (7)."""
        ring = 1 + np.arange(len(self.theta_o) - 1)[:, None] * self.num_azimuths + self.azimuth_index
        return np.concatenate([np.zeros((1, self.num_phi_o), int), ring])

    @property
    def num_directions(self) -> int:
        """Number of direction nodes."""
        return 1 + (len(self.theta_o) - 1) * self.num_azimuths

    @property
    def normal_incidence_tied(self) -> bool:
        """Whether the first incident angle is 0, where the field cannot depend on azimuth, eq. (8)."""
        return bool(self.theta_i[0] == 0.0)

    @property
    def num_unknowns(self) -> int:
        """Number of unknowns after all ties."""
        tied = self.normal_incidence_tied
        return len(self.theta_i) * self.num_directions + tied * (len(self.theta_o) - self.num_directions)

    @functools.cached_property
    def unknown_index(self) -> np.ndarray:
        """[theta_i, theta_o, num_phi_o] the unknown of each node of the circle."""
        plane = np.arange(len(self.theta_i))[:, None, None] * self.num_directions + self.direction_index
        if self.normal_incidence_tied:
            plane += len(self.theta_o) - self.num_directions
            plane[0] = np.arange(len(self.theta_o))[:, None]
        return plane

    def scatter(self, unknowns: np.ndarray) -> np.ndarray:
        """Spread [unknown, ...] over the stored grid [theta_i, theta_o, phi_o inclusive, ...]."""
        index = np.concatenate([self.unknown_index, self.unknown_index[:, :, :1]], axis=2)
        return unknowns[index]


def make_grid(samples: RawSamples, options: GridOptions, *, bilateral: bool) -> Grid:
    """Build the grid for a measurement.

    Args:
        samples: The measurement; fewer than 3 distinct incident angles make them the axis.
        options: Steps [degrees]; theirs divide 90 and 180 (`config` sees to it).
        bilateral: Whether phi_o is folded.

    Returns:
        The grid; theta_i and theta_o from 0 to 90 degrees, phi_o all round.
    """
    incidences, _ = cluster_incidences(samples.theta_i)
    interpolate = len(incidences) >= 3
    if not interpolate:
        incidences[incidences < SAME_INCIDENCE] = 0.0
    return Grid(
        theta_i=_quarter_circle(options.theta_i_step_deg) if interpolate else incidences,
        theta_o=_quarter_circle(options.theta_o_step_deg),
        num_phi_o=2 * round(180 / options.phi_o_step_deg),
        bilateral=bilateral,
        interpolate_theta_i=interpolate,
        reciprocal=options.reciprocal,
    )


def second_difference_rows(grid: Grid) -> scipy.sparse.csr_array:
    """Return the relations of eq. (10) as sparse rows [relation, unknown], right-hand sides 0.

    One row of each kind for every node of the whole circle: in theta_i and theta_o at
    interior nodes, in phi_o wrapped round, none across the pole. Rows that coincide or
    vanish after the merging keep their multiplicity.
    """
    index = grid.unknown_index
    triples = [
        (index[:-2], index[1:-1], index[2:]) if grid.interpolate_theta_i and len(index) > 2 else None,
        (index[:, :-2], index[:, 1:-1], index[:, 2:]),
        (np.roll(index, 1, axis=2), index, np.roll(index, -1, axis=2)),
    ]
    columns = np.concatenate([np.stack([t.ravel() for t in triple], 1) for triple in triples if triple is not None])
    rows = np.broadcast_to(np.arange(len(columns))[:, None], columns.shape)
    stencil = np.broadcast_to([1.0, -2.0, 1.0], columns.shape)
    shape = (len(columns), grid.num_unknowns)
    return scipy.sparse.coo_array((stencil.ravel(), (rows.ravel(), columns.ravel())), shape=shape).tocsr()


def midpoints(axis) -> np.ndarray:
    """Midpoints of the cells of an axis."""
    axis = np.asarray(axis)
    return (axis[:-1] + axis[1:]) / 2


def has_data(gridded: GriddedBRDF) -> np.ndarray:
    """Mask [theta_i] of the incident angles with a node that is not beyond the measured range."""
    return angles_with_data(np.asarray(gridded.extrapolated))


def _quarter_circle(step_deg: float) -> np.ndarray:
    return np.deg2rad(np.linspace(0.0, 90.0, round(90 / step_deg) + 1))
