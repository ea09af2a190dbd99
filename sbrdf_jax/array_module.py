"""One formula for NumPy and JAX: what is given NumPy arrays is computed by NumPy, and nothing is compiled.

A fit plans and solves on the host, where compiling a formula takes a hundred times longer than
evaluating it; the same formula is traced where a result is evaluated under `jit`, `vmap` or `grad`.
"""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

AnyArray = np.ndarray | np.generic | jax.Array  # a scalar of NumPy is no array of its


def array_module(*arrays: Any) -> ModuleType:
    """Return `jax.numpy` if any of the arrays is JAX's or is being traced, else NumPy."""
    return jnp if any(isinstance(a, jax.Array) for a in arrays) else np
