"""Fewer, better samples: repeated and mirrored directions become one, very long measurements are thinned by averaging.

Two samples of one direction must not stand on both sides of a leave-one-out test, or the
noise would be taken for structure. Past `MAX_CENTRES` the cells grow until few enough are left.
"""

import numpy as np

MAX_CENTRES = 1600
SMALLEST_CELL = np.deg2rad(0.3)
GROWTH = 1.3
HALF_STRETCH = 4.0  # cells are so much longer in log(theta_h + 1) than in radians


def merge_samples(
    group: np.ndarray, theta_o: np.ndarray, azimuth: np.ndarray, half: np.ndarray, max_centres: int = MAX_CENTRES
) -> np.ndarray:
    """Return each sample's cell: by the group of theta_i, theta_o, azimuth [rad] and half = log(theta_h [deg] + 1)."""
    cell = SMALLEST_CELL
    places = theta_o, azimuth * np.sin(theta_o), half / HALF_STRETCH
    while True:
        number = group  # of the cell; one integer sorts twenty times faster than a row of four
        for place in places:
            step = np.round(place / cell).astype(np.int64)
            number = number * (step.max() + 1) + step
        distinct, index = np.unique(number, return_inverse=True)
        if len(distinct) <= max(max_centres, 2 * (group.max() + 1)):
            return index.reshape(-1)
        cell *= GROWTH
