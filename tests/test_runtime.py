"""Process-wide settings: the clocks of compilation, and the refusal of float32."""

import jax
import jax.numpy as jnp
import pytest
from small_results import small_field, small_grid

from sbrdf_jax.builtin import measure
from sbrdf_jax.config import parse_config, resolve
from sbrdf_jax.errors import UserError
from sbrdf_jax.grid import make_grid
from sbrdf_jax.representation import represent
from sbrdf_jax.resampling import resample
from sbrdf_jax.runtime import compile_clock


def test_clocks_within_clocks_count_what_was_compiled_while_each_was_on():
    with compile_clock() as outer, compile_clock() as idle:
        with compile_clock() as inner:
            jax.jit(lambda x: jnp.sin(x) + 41.0)(jnp.ones(7)).block_until_ready()
        counted = inner.num_compiled
        jax.jit(lambda x: jnp.cos(x) + 43.0)(jnp.ones(7)).block_until_ready()
    assert counted == inner.num_compiled >= 1 and inner.seconds > 0
    assert outer.num_compiled == idle.num_compiled > inner.num_compiled


def test_nothing_is_fitted_in_float32(rng):
    options = resolve(parse_config("input: {path: 'builtin:amber_glass'}"))
    samples = measure("amber_glass", count=20)
    grid, field = make_grid(samples, options.grid, bilateral=True), small_field(small_grid(rng))
    with jax.enable_x64(False):
        with pytest.raises(UserError, match="jax_enable_x64"):
            resample(samples, grid, options.resample)
        with pytest.raises(UserError, match="jax_enable_x64"):
            represent(field, options.represent)
