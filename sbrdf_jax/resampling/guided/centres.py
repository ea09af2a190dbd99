"""Where the samples are: merged, grouped by incident angle, padded: by angles alone, so that folds share it."""

import dataclasses
import functools

import numpy as np
import scipy.sparse

from sbrdf_jax.angles import GRAZING, fold_azimuth
from sbrdf_jax.coverage import cluster_incidences
from sbrdf_jax.host_blas import one_blas_thread
from sbrdf_jax.records import RawSamples
from sbrdf_jax.resampling.guided.coordinates import EXTRAPOLATION, Coordinates, guided_coordinates
from sbrdf_jax.resampling.guided.covariance import (
    GroupedFeatures,
    HeldCovariances,
    covariance,
    flatten,
    group_coordinates,
    group_features,
)
from sbrdf_jax.resampling.guided.inverse import Blocks, group_blocks, lower_product, whitener
from sbrdf_jax.resampling.guided.merging import merge_samples
from sbrdf_jax.resampling.guided.nodes import GRIDS, ModeVariance, cubic_rows

MOST_GROUPS = 45  # more incident angles are sorted into so many bins
MEMBER_BUCKET = 8  # members of a group are padded to a multiple
PADDING_NOISE = 1e12  # variance that leaves a centre without effect


@dataclasses.dataclass(eq=False)
class Centres:
    """Merged directions [group x member], flattened; padding has no sample."""

    row: np.ndarray  # [sample] rows of the file, increasing
    index: np.ndarray  # [sample] centre of each sample
    at: Coordinates  # [centre]
    snapped: Coordinates  # [centre] each group at one incident angle
    angles: np.ndarray  # [3, centre] theta_i, theta_o, folded azimuth [rad]
    theta_limit: np.ndarray  # [2] rad
    features: GroupedFeatures
    reciprocal: bool  # nodes are tied by Helmholtz reciprocity
    node_covariance: dict[bytes, HeldCovariances] = dataclasses.field(default_factory=dict)  # by grid
    node_flags: dict[bytes, np.ndarray] = dataclasses.field(default_factory=dict)  # `extrapolated_nodes`, by grid
    _prior: dict[int, tuple[ModeVariance, np.ndarray]] = dataclasses.field(default_factory=dict)
    _inverse: dict[tuple[int, float], tuple[np.ndarray, np.ndarray, Blocks]] = dataclasses.field(default_factory=dict)

    @property
    def count(self) -> int:
        """Centres, padding included."""
        return self.angles.shape[1]

    @property
    def num_groups(self) -> int:
        """Incident angles, or bins of them."""
        return self.features.theta_i.shape[0]

    @property
    def num_members(self) -> int:
        """Centres of each group, padding included."""
        return self.count // self.num_groups

    @functools.cached_property
    def node_rows(self) -> dict[str, scipy.sparse.csr_array]:
        """Interpolation from each grid's mirrored nodes, A [centre, node]."""
        return {name: cubic_rows(grid.places(self.snapped), grid.axes) for name, grid in GRIDS.items()}

    @property
    def group(self) -> np.ndarray:
        """Group of each centre [centre], by number; -1 without a sample."""
        return np.where(self.number > 0, np.arange(self.count) // self.num_members, -1)

    def prior(self, variance: ModeVariance) -> np.ndarray:
        """Prior covariance [centre, centre], computed once for each smoothness."""
        if id(variance) not in self._prior:
            with one_blas_thread():
                self._prior[id(variance)] = variance, covariance(variance, self.snapped, self.features)
        return self._prior[id(variance)][1]

    def inverse(self, variance: ModeVariance, level: float) -> tuple[np.ndarray, np.ndarray, Blocks]:
        """Inverse of prior plus noise, no direction doubted, computed once for each pair.

        Returns:
            W, of which it is W'W; its lower half; and its blocks of incident angles, inverted.
        """
        key = id(variance), level
        if key not in self._inverse:
            whiten = whitener(self.prior(variance), self.noise(level))
            lower = lower_product(whiten)
            self._inverse[key] = whiten, lower, group_blocks(lower, self.group)
        return self._inverse[key]

    def noise(self, level: float) -> np.ndarray:
        """Noise variance [centre] where one sample has `level`: less for repeats; padding has no effect."""
        return np.where(self.number > 0, level / np.maximum(self.number, 1), PADDING_NOISE)

    def take(self, row: np.ndarray) -> "Centres":
        """Return the centres for some of the rows: those left without a sample stay, and have no effect."""
        place = np.searchsorted(self.row, row)
        return dataclasses.replace(self, row=row, index=self.index[place], node_flags={}, _inverse={})

    @property
    def number(self) -> np.ndarray:
        """How many samples each centre stands for [centre]."""
        return np.bincount(self.index, minlength=self.count).astype(float)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Average of values [sample, wavelength] over each centre's samples; 0 where there is none."""
        count = len(self.index)
        sums = scipy.sparse.csr_array((np.ones(count), (self.index, np.arange(count))), shape=(self.count, count))
        return (sums @ values) / np.maximum(self.number, 1)[:, None]


def place_centres(samples: RawSamples, reciprocal: bool = False) -> Centres:
    """Merge, group and pad the directions of a measurement; its values have no influence."""
    theta_i, theta_o, phi_o = samples.theta_i, samples.theta_o, samples.phi_o
    measured = np.array([theta_i.max(), theta_o.max()])
    if reciprocal:
        measured[:] = measured.max()
    limit = np.minimum(measured + EXTRAPOLATION, GRAZING)
    azimuth = fold_azimuth(phi_o)
    half = guided_coordinates(theta_i, theta_o, azimuth, limit).half
    group_of_sample = group_incidences(theta_i)
    cell = merge_samples(group_of_sample, theta_o, azimuth, half)
    mean = [np.bincount(cell, x) / np.bincount(cell) for x in (theta_i, theta_o, azimuth)]
    group = np.zeros(len(mean[0]), int)
    group[cell] = group_of_sample
    position, members = grouped_positions(group)
    groups = int(group.max()) + 1
    incidence = np.bincount(group, mean[0]) / np.bincount(group)
    angles = np.full((3, groups * members), 0.5)
    angles[0] = np.repeat(incidence, members)
    angles[:, position] = mean
    grouped = group_coordinates(angles.reshape(3, groups, members), limit)
    return Centres(
        row=samples.row,
        index=position[cell],
        at=guided_coordinates(*angles, limit),
        snapped=flatten(grouped),
        angles=angles,
        theta_limit=limit,
        features=group_features(grouped),
        reciprocal=reciprocal,
    )


def group_incidences(theta_i: np.ndarray) -> np.ndarray:
    """Return the number [direction] of each direction's group of nearly equal incident angles [rad]."""
    known, group = cluster_incidences(theta_i)
    if len(known) > MOST_GROUPS:  # a continuum
        _, group = np.unique(np.floor(theta_i / (np.pi / 2 / MOST_GROUPS)), return_inverse=True)
    return group.reshape(-1)


def grouped_positions(group: np.ndarray) -> tuple[np.ndarray, int]:
    """Return each direction's position in a [group x member] layout, and the number of members of a group."""
    sizes = np.bincount(group)
    members = -(-int(sizes.max()) // MEMBER_BUCKET) * MEMBER_BUCKET
    order = np.argsort(group, kind="stable")
    rank = np.empty(len(group), int)
    rank[order] = np.arange(len(group)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return group * members + rank, members
