"""Nodes, ties and second-difference rows against a plain triple loop."""

import numpy as np
import pytest
from problems import scattered_samples

from sbrdf_jax.grid import Grid, make_grid, second_difference_rows
from sbrdf_jax.options import GridOptions


def grid_of(num_theta: int, num_phi: int, *, bilateral: bool, theta_i=None) -> Grid:
    """A grid of num_theta polar nodes; incident angles as given are not interpolated over."""
    nodes = np.linspace(0, np.pi / 2, num_theta)
    interpolate = theta_i is None
    return Grid(nodes if interpolate else np.asarray(theta_i, float), nodes, num_phi, bilateral, interpolate)


def plain_unknowns(grid: Grid) -> dict[tuple[int, int, int], tuple]:
    """Name the unknown of every node of the circle by the eqs. (7) and (8)."""
    names = {}
    for m, theta_i in enumerate(grid.theta_i):
        for n in range(len(grid.theta_o)):
            for k in range(grid.num_phi_o):
                azimuth = min(k, grid.num_phi_o - k) if grid.bilateral else k
                names[m, n, k] = (m, n, -1 if n == 0 or theta_i == 0 else azimuth)
    return names


@pytest.mark.parametrize("bilateral", [True, False])
@pytest.mark.parametrize("theta_i", [None, [0.0, 0.7], [0.5]])
def test_ties_are_those_of_the_paper(bilateral, theta_i):
    grid = grid_of(4, 12, bilateral=bilateral, theta_i=theta_i)
    names = plain_unknowns(grid)
    by_index: dict[int, set] = {}
    for node, name in names.items():
        by_index.setdefault(int(grid.unknown_index[node]), set()).add(name)
    assert all(len(group) == 1 for group in by_index.values())
    assert sorted(by_index) == list(range(grid.num_unknowns))
    assert len(set(names.values())) == grid.num_unknowns


def test_paper_sizes():
    assert grid_of(13, 48, bilateral=True).num_unknowns == 3625
    assert grid_of(13, 48, bilateral=False).num_unknowns == 13 + 12 * (1 + 12 * 48)


@pytest.mark.parametrize("bilateral", [True, False])
def test_second_differences_are_eq_10_with_multiplicity(bilateral, rng):
    grid = grid_of(4, 8, bilateral=bilateral)
    x = rng.standard_normal(grid.num_unknowns)
    field = x[grid.unknown_index]
    expected = []
    for m in range(4):
        for n in range(4):
            for k in range(8):
                if 0 < m < 3:
                    expected.append(field[m - 1, n, k] - 2 * field[m, n, k] + field[m + 1, n, k])
                if 0 < n < 3:
                    expected.append(field[m, n - 1, k] - 2 * field[m, n, k] + field[m, n + 1, k])
                expected.append(field[m, n, k - 1] - 2 * field[m, n, k] + field[m, n, (k + 1) % 8])
    found = second_difference_rows(grid) @ x
    np.testing.assert_allclose(np.sort(found), np.sort(expected), atol=1e-13)


def test_scatter_repeats_the_first_azimuth_at_360_degrees(rng):
    grid = grid_of(3, 8, bilateral=True)
    full = grid.scatter(rng.standard_normal((grid.num_unknowns, 2)))
    assert full.shape == (3, 3, 9, 2)
    np.testing.assert_array_equal(full[:, :, -1], full[:, :, 0])
    np.testing.assert_array_equal(full[:, :, 1], full[:, :, -2])
    assert np.ptp(full[0], axis=1).max() == 0 and np.ptp(full[:, 0], axis=1).max() == 0


def test_few_incident_angles_are_the_axis(rng):
    two = scattered_samples(rng, [0.1, 30.0], 20, 3)
    grid = make_grid(two, GridOptions(), bilateral=False)
    np.testing.assert_allclose(np.rad2deg(grid.theta_i), [0.0, 30.0])  # 0.1 degrees is normal incidence
    assert not grid.interpolate_theta_i
    three = scattered_samples(rng, [10.0, 30.0, 60.0], 20, 3)
    grid = make_grid(three, GridOptions(theta_i_step_deg=15.0), bilateral=True)
    np.testing.assert_allclose(np.rad2deg(grid.theta_i), np.arange(0, 91, 15))
    assert grid.interpolate_theta_i and grid.num_azimuths == 25
