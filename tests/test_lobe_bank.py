"""The bank of widths: many lobes at once, against SciPy, planted ones, and lanes that are hard."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from sbrdf_jax.representation.lobe_bank import fit_lobe_bank

WIDTHS = np.geomspace(1e-3, 30, 48)


@pytest.fixture
def lanes(rng):
    """Two groups of 12 lanes: a lobe, another one, and noise; one exponent a group."""
    alpha = np.sort(rng.uniform(0, 1.5, (2, 80)), axis=1)
    exponent = np.stack([alpha[0] ** 2, np.tan(alpha[1])])
    height, width = rng.normal(size=(2, 12, 1)), np.exp(rng.uniform(-4, 1, (2, 12, 1)))
    target = height * np.exp(-exponent[:, None] / width)
    target += 0.3 * rng.normal(size=(2, 12, 1)) * np.exp(-exponent[:, None] / 3) + 0.02 * rng.normal(size=(2, 12, 80))
    weight = rng.uniform(0.5, 2, (2, 12, 80)) * (rng.uniform(size=(2, 12, 80)) < 0.8)
    return target, weight, exponent, np.tile(WIDTHS, (2, 1)), height[..., 0], width[..., 0]


def test_scipy_from_many_starts_is_no_better(lanes):
    target, weight, exponent, widths, _, _ = lanes
    found = fit_lobe_bank(target, weight, exponent, widths)
    bounds = ([-np.inf, np.log(WIDTHS[0])], [np.inf, np.log(WIDTHS[-1])])
    for group in range(2):
        for lane in range(0, 12, 3):
            root = np.sqrt(weight[group, lane])

            def residual(x, group=group, lane=lane, root=root):
                return root * (target[group, lane] - x[0] * np.exp(-exponent[group] * np.exp(-x[1])))

            fits = [least_squares(residual, [0.5, start], bounds=bounds, xtol=1e-12) for start in (-4.0, -1.0, 1.0)]
            best = min(fits, key=lambda fit: fit.cost)
            error = float(found.error[group, lane])
            assert error <= 2 * best.cost * (1 + 1e-9)
            if error > 2 * best.cost * (1 - 1e-9):  # the same optimum
                np.testing.assert_allclose(found.height[group, lane], best.x[0], rtol=1e-4)
                np.testing.assert_allclose(np.log(found.width[group, lane]), best.x[1], rtol=0, atol=1e-4)


def test_planted_lobes_come_back_and_hard_lanes_harm_no_other(lanes):
    _, weight, exponent, widths, height, width = lanes
    target = height[..., None] * np.exp(-exponent[:, None] / width[..., None])
    plain = fit_lobe_bank(target, weight, exponent, widths)
    np.testing.assert_allclose(plain.height, height, rtol=1e-7)
    np.testing.assert_allclose(plain.width, width, rtol=1e-7)
    hard, light = target.copy(), weight.copy()
    hard[0, 0], hard[0, 1, 5], light[0, 2], hard[0, 3] = 0.0, np.nan, 0.0, np.exp(-exponent[0] / 1e-6)
    found = fit_lobe_bank(hard, light, exponent, widths)
    assert found.height[0, 0] == 0 and found.height[0, 2] == 0 and np.isnan(found.height[0, 1])
    np.testing.assert_allclose(found.width[0, 3], WIDTHS[0], rtol=1e-9)
    np.testing.assert_array_equal(found.width[1], plain.width[1])
    np.testing.assert_allclose(found.width[0, 4:], plain.width[0, 4:], rtol=1e-12)


def test_a_lane_alone_is_the_lane_in_a_batch(lanes):
    target, weight, exponent, widths, _, _ = lanes
    whole = fit_lobe_bank(target, weight, exponent, widths)
    alone = fit_lobe_bank(target[:1, 3:4], weight[:1, 3:4], exponent[:1], widths[:1])
    np.testing.assert_allclose(alone.width[0, 0], whole.width[0, 3], rtol=1e-9)
