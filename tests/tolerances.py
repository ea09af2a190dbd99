"""Tolerances of the tests, by dtype and quantity: the only place where they are set.

A test that needs a looser one writes its own number and the reason on the same line.
"""

import numpy as np

# Agreement of two ways to the same number, relative to the largest value: rounding over a few hundred operations.
ROUNDING = {np.dtype(np.float64): 1e-12, np.dtype(np.float32): 2e-5}

# A lane alone against the same lane in a batch: only the order of sums differs.
LANE = {np.dtype(np.float64): 1e-12, np.dtype(np.float32): 2e-5}

# A planted answer that comes back through a fit or a solve, relative.
PLANTED = {np.dtype(np.float64): 1e-9, np.dtype(np.float32): 1e-3}

# A derivative by JAX against a central difference, relative; the difference itself loses half of the digits.
GRADIENT = {np.dtype(np.float64): 1e-6, np.dtype(np.float32): 2e-2}

# The relative KKT residual at which the solver for method "paper" stops, and its certificate.
KKT = {np.dtype(np.float64): 1e-8, np.dtype(np.float32): 1e-4}

# The solver's objective against scipy.optimize.nnls, relative.
OBJECTIVE = {np.dtype(np.float64): 1e-9, np.dtype(np.float32): 1e-4}

# A float32 run against the float64 run of the same input, relative to the largest value.
FLOAT32_LOSS = 1e-4


def tolerance(table: dict[np.dtype, float], dtype) -> float:
    """Look up a table of this file by anything that names a dtype."""
    return table[np.dtype(dtype)]
