"""Process-wide settings: the clocks of compilation."""

import jax
import jax.numpy as jnp

from sbrdf_jax.runtime import compile_clock


def test_clocks_within_clocks_count_what_was_compiled_while_each_was_on():
    with compile_clock() as outer, compile_clock() as idle:
        with compile_clock() as inner:
            jax.jit(lambda x: jnp.sin(x) + 41.0)(jnp.ones(7)).block_until_ready()
        counted = inner.num_compiled
        jax.jit(lambda x: jnp.cos(x) + 43.0)(jnp.ones(7)).block_until_ready()
    assert counted == inner.num_compiled >= 1 and inner.seconds > 0
    assert outer.num_compiled == idle.num_compiled > inner.num_compiled
