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
    for array in arrays:  # asking what is JAX's takes longer
        if not isinstance(array, np.ndarray | np.generic | float | int) and isinstance(array, jax.Array):
            return jnp
    return np
