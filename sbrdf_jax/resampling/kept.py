"""What one run works out and the next may use: what depends on angles alone, and what a whole measurement says."""

import dataclasses
import hashlib
from collections.abc import Callable
from typing import Any, Literal

import jax
import numpy as np

from sbrdf_jax.cleaning import CleanResult, clean
from sbrdf_jax.multipliers import InverseNormal, invert_normal
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.records import RawSamples
from sbrdf_jax.resampling.guided import Centres, Estimates, GuidedField, estimate_whole, place_centres
from sbrdf_jax.resampling.guided.estimates import live_part, restore_estimates
from sbrdf_jax.resampling.normal import TiedGridNormal


class Kept:
    """The last geometry and the last measurement: materials of one geometry, and scenes of one material.

    Numerics:
        What is kept is what would be computed again, to the last bit.
    """

    def __init__(self):
        """Begin with none."""
        self._cleaned: tuple[str, CleanResult | None] = "", None
        self._inverse: tuple[str, InverseNormal | None] = "", None
        self._centres: tuple[str, Centres | None] = "", None
        self._estimates: tuple[str, Estimates | None] = "", None

    def cleaned(self, raw: RawSamples, bilateral: bool | Literal["auto"], method: str) -> CleanResult:
        """`cleaning.clean` for the next scene of the same material."""
        parts = [np.asarray(getattr(raw, field.name)) for field in dataclasses.fields(raw)]
        key = _key([*parts, np.array([str(bilateral), method])])
        found = self._cleaned[1]
        if found is None or self._cleaned[0] != key:
            found = clean(raw, bilateral=bilateral, method=method)
            self._cleaned = key, found
        return found

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

    def estimates(
        self,
        samples: RawSamples,
        options: ResampleOptions,
        centres: Centres,
        report: Callable[[str], None] | None = None,
        stored: GuidedField | None = None,
    ) -> Estimates:
        """`guided.estimate_whole` for the next scene of the same material, or what `stored`, its field, holds of it."""
        setting = np.array([str(options.smoothness_weight), str(centres.reciprocal)])
        key = _key([samples.row, samples.theta_i, samples.theta_o, samples.phi_o, samples.value, setting])
        found = self._estimates[1]
        if found is None or self._estimates[0] != key:
            self._estimates = "", None  # before the next are made: their matrices take 34 MB
            if stored is None:
                found = estimate_whole(samples, options, centres, report)
            else:
                found = restore_estimates(stored, live_part(samples), centres)
            self._estimates = key, found
        return found


def _key(arrays: list[Any]) -> str:
    digest = hashlib.blake2b()  # as safe as SHA-256, in half of the time
    for array in map(np.asarray, arrays):
        digest.update(f"{array.shape}{array.dtype}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
