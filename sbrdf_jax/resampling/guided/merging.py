"""Fewer, better samples: repeated and mirrored directions become one, very long measurements are thinned by averaging.

Two samples of one direction must not stand on both sides of a leave-one-out test, or the
noise would be taken for structure. Past `MAX_CENTRES` the cells grow until few enough are left.
"""

from typing import NamedTuple

import numpy as np

MAX_CENTRES = 3600
SMALLEST_CELL = np.deg2rad(0.3)
GROWTH = 1.3
HALF_STRETCH = 4.0  # cells are so much longer in log(theta_h + 1) than in radians


class Centres(NamedTuple):
    """Which centre each sample belongs to, and how many samples each centre stands for."""

    index: np.ndarray  # [sample]
    count: np.ndarray  # [centre]

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Average over each centre's samples, along the first axis."""
        total = np.zeros((len(self.count), *values.shape[1:]))
        np.add.at(total, self.index, values)
        return total / self.count.reshape(-1, *[1] * (values.ndim - 1))


def merge_samples(
    theta_i: np.ndarray, theta_o: np.ndarray, azimuth: np.ndarray, half: np.ndarray, max_centres: int = MAX_CENTRES
) -> Centres:
    """Group samples into cells of (theta_i, theta_o, azimuth) [rad] and half = log(theta_h[deg] + 1)."""
    cell = SMALLEST_CELL
    while True:
        features = np.stack([theta_i, theta_o, azimuth * np.sin(theta_o), half / HALF_STRETCH], axis=1)
        cells = np.round(features / cell).astype(np.int64)
        _, index, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        if len(count) <= max_centres:
            return Centres(index=index.reshape(-1), count=count)
        cell *= GROWTH
