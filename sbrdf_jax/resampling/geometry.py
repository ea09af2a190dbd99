"""What depends on the angles of a measurement alone, kept for the next measurement at the same angles."""

import hashlib
from typing import Any

import jax
import numpy as np

from sbrdf_jax.multipliers import InverseNormal, invert_normal
from sbrdf_jax.records import RawSamples
from sbrdf_jax.resampling.guided.centres import Centres, place_centres
from sbrdf_jax.resampling.normal import TiedGridNormal


class Geometry:
    """The last geometry of each method: materials of one geometry, one after the other, work it out once.

    Numerics:
        What is kept is what would be computed again, to the last bit.
    """

    def __init__(self):
        """Begin with none."""
        self._inverse: tuple[str, InverseNormal | None] = "", None
        self._centres: tuple[str, Centres | None] = "", None

    def inverse(self, operator: TiedGridNormal) -> InverseNormal | None:
        """`multipliers.invert_normal`, for method paper."""
        key = _key(jax.tree.leaves(operator))
        if self._inverse[0] != key:
            self._inverse = "", None  # before the next is made: each takes up to 290 MB
            self._inverse = key, invert_normal(operator)
        return self._inverse[1]

    def centres(self, samples: RawSamples, reciprocal: bool) -> Centres:
        """`centres.place_centres`, for method guided, with the covariances that it has worked out."""
        key = _key([samples.row, samples.theta_i, samples.theta_o, samples.phi_o, np.array(reciprocal)])
        found = self._centres[1]
        if found is None or self._centres[0] != key:
            found = place_centres(samples, reciprocal)
            self._centres = key, found
        return found


def _key(arrays: list[Any]) -> str:
    digest = hashlib.sha256()
    for array in map(np.asarray, arrays):
        digest.update(f"{array.shape}{array.dtype}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
