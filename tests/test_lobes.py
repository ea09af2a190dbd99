"""The three lobe shapes, their edges and their gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sbrdf_jax.lobes import LOBE_KINDS, lobe_value, lobe_value_any

ALPHA = np.array([0.0, 1e-9, 0.1, 0.8, 1.5, np.pi / 2 - 1e-12, np.pi / 2, 1.6, 2.5, np.pi])
SHAPES = {  # eqs. (14), (15), (16) as printed, for alpha below pi/2
    "none": lambda alpha: np.full_like(alpha, np.inf),
    "angle_squared": lambda alpha: alpha**2,
    "tan_squared": lambda alpha: np.tan(alpha) ** 2,
    "tan": np.tan,
}


@pytest.mark.parametrize("kind", LOBE_KINDS)
@pytest.mark.parametrize(("height", "width"), [(2.0, 0.05), (-3.0, 30.0), (1e6, 1e-4)])
def test_shapes_are_the_papers_below_a_right_angle_and_0_from_there_on(kind, height, width):
    with np.errstate(over="ignore"):
        expected = height * np.exp(-SHAPES[kind](ALPHA) / width)
    if kind != "angle_squared":
        expected = np.where(ALPHA < np.pi / 2, expected, 0.0)
    np.testing.assert_allclose(lobe_value(ALPHA, height, width, kind=kind), expected, rtol=1e-13)


@pytest.mark.parametrize("kind", LOBE_KINDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_values_and_gradients_are_finite_everywhere(kind, dtype):
    def total(alpha, height, width):
        return lobe_value(alpha, height, width, kind=kind).sum()

    arguments = (jnp.asarray(ALPHA, dtype), jnp.asarray(2.0, dtype), jnp.asarray(1e-4, dtype))
    value, slopes = jax.value_and_grad(total, argnums=(0, 1, 2))(*arguments)
    assert value.dtype == dtype
    assert np.isfinite(value) and all(np.isfinite(slope).all() for slope in slopes)
    if kind == "tan":  # the only one with a corner at its peak
        np.testing.assert_allclose(slopes[0][0], -2.0 / 1e-4, rtol=1e-6)
    else:
        assert slopes[0][0] == 0


def test_an_unknown_kind_is_refused():
    with pytest.raises(ValueError, match="expected one of none, angle_squared, tan_squared, tan"):
        lobe_value(ALPHA, 1.0, 1.0, kind="cosine")


def test_kinds_as_data_equal_kinds_by_name(rng):
    height, width = rng.normal(size=4), rng.uniform(0.01, 2, 4)
    alpha = rng.uniform(0, np.pi, (3, 5))
    found = jax.jit(lobe_value_any)(alpha, height, width, np.arange(4))
    for index, kind in enumerate(LOBE_KINDS):
        expected = lobe_value(alpha, height[index], width[index], kind=kind)
        np.testing.assert_allclose(found[..., index], expected, rtol=1e-14, atol=1e-300)
    one_each = np.broadcast_to(np.arange(4), (3, 5, 4))
    np.testing.assert_allclose(lobe_value_any(alpha, height, width, one_each), found, rtol=1e-12)
