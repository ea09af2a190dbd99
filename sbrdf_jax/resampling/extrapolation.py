"""Where the data stand behind a node of the grid, and where nothing does."""

import numpy as np
from scipy.spatial import KDTree

from sbrdf_jax.angles import fold_azimuth, unit_vector
from sbrdf_jax.coverage import SAME_INCIDENCE
from sbrdf_jax.grid import Grid
from sbrdf_jax.records import RawSamples
from sbrdf_jax.schema import BEYOND, INTERPOLATED, MEASURED

WIDEST_AZIMUTH_GAP = np.deg2rad(45.0)  # a gap round the circle wider than this was not measured, not sampled thinly


def extrapolated_nodes(samples: RawSamples, grid: Grid) -> np.ndarray:
    """Flag every node of the stored grid by what the measurement says of it.

    0 measured nearby: a sample lies within one step of the node in incident angle and
    within one step (the wider one) in outgoing direction. 2 beyond the measured range:
    its incident or outgoing polar angle lies outside the range of the samples, or its
    azimuth in a gap wider than 45 degrees. 1 between the two: interpolated.

    Args:
        samples: The samples that were fitted.
        grid: The nodes; with `bilateral` a sample also stands for its mirror twin.

    Returns:
        uint8 flags [theta_i, theta_o, phi_o inclusive].
    """
    step_i = grid.steps[0] if grid.interpolate_theta_i else SAME_INCIDENCE
    reach = max(grid.steps[1:])
    phi_node = fold_azimuth(grid.phi_o) if grid.bilateral else grid.phi_o
    phi_sample = fold_azimuth(samples.phi_o) if grid.bilateral else samples.phi_o
    theta_o, phi_o = (a.ravel() for a in np.meshgrid(grid.theta_o, phi_node, indexing="ij"))
    nodes, directions = unit_vector(theta_o, phi_o), unit_vector(samples.theta_o, phi_sample)
    chord = 2 * np.sin((reach + 1e-9) / 2)
    flags = np.full((len(grid.theta_i), len(nodes)), INTERPOLATED, np.uint8)
    for index, angle in enumerate(grid.theta_i):
        near = np.abs(samples.theta_i - angle) <= step_i + 1e-9
        if near.any():
            distance, _ = KDTree(directions[near]).query(nodes)
            flags[index, distance <= chord] = MEASURED
    beyond = theta_o > samples.theta_o.max() + 1e-9
    if samples.theta_o.min() > reach:  # a hole round the normal; a narrower one is between samples on all sides
        beyond |= theta_o < samples.theta_o.min() - 1e-9
    beyond |= _in_azimuth_gap(phi_o, phi_sample[samples.theta_o > 1e-6], grid.bilateral) & (theta_o > 0)
    flags[:, beyond] = BEYOND
    outside = (grid.theta_i > samples.theta_i.max() + 1e-9) | (grid.theta_i < samples.theta_i.min() - 1e-9)
    if grid.interpolate_theta_i:
        flags[outside] = BEYOND
    return flags.reshape(len(grid.theta_i), len(grid.theta_o), -1)


def _in_azimuth_gap(phi: np.ndarray, measured: np.ndarray, folded: bool) -> np.ndarray:
    if len(measured) == 0:
        return np.ones(len(phi), bool)
    angle = np.sort(measured)
    if folded:  # the half circle continues into its mirror image at both ends
        angle = np.concatenate([-angle[::-1], angle, 2 * np.pi - angle[::-1]])
    else:
        angle = np.concatenate([angle[-1:] - 2 * np.pi, angle, angle[:1] + 2 * np.pi])
    after = np.clip(np.searchsorted(angle, phi, side="right"), 1, len(angle) - 1)
    gap = angle[after] - angle[after - 1]
    inside = np.minimum(phi - angle[after - 1], angle[after] - phi) > 1e-9
    return (gap > WIDEST_AZIMUTH_GAP) & inside
