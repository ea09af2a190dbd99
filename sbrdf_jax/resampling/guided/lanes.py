"""Wavelengths of a fitted field: some of it, two joined, and those that no data tell anything about."""

import dataclasses

import numpy as np

from sbrdf_jax.resampling.guided.field import LAST_AXIS, GuidedField
from sbrdf_jax.resampling.guided.fit import GuidedFit

_PROOF = ("kkt_residual", "num_steps", "status")


def take_field(field: GuidedField, index: np.ndarray) -> GuidedField:
    """Return a field at some of its wavelengths, by mask or index."""
    parts = {name: np.asarray(getattr(field, name))[..., index] for name in LAST_AXIS}
    lobe = dataclasses.replace(field.lobe, log_amplitude=np.asarray(field.lobe.log_amplitude)[:, index])
    return dataclasses.replace(field, lobe=lobe, **parts)


def take_fit(fit: GuidedFit, index: np.ndarray) -> GuidedFit:
    """Return a fit at some of its wavelengths, by mask or index."""
    return fit._replace(
        field=take_field(fit.field, index), **{name: np.asarray(getattr(fit, name))[index] for name in _PROOF}
    )


def join_fits(one: GuidedFit, other: GuidedFit) -> GuidedFit:
    """Return a fit at the wavelengths of two of one measurement, increasing; what they share is taken from `other`."""
    order = np.argsort(np.concatenate([one.field.wavelength_nm, other.field.wavelength_nm]))

    def joined(first, second):
        return np.concatenate([np.asarray(first), np.asarray(second)], axis=-1)[..., order]

    parts = {name: joined(getattr(one.field, name), getattr(other.field, name)) for name in LAST_AXIS}
    amplitude = joined(one.field.lobe.log_amplitude, other.field.lobe.log_amplitude)
    lobe = dataclasses.replace(other.field.lobe, log_amplitude=amplitude)
    proof = {name: joined(getattr(one, name), getattr(other, name)) for name in _PROOF}
    return other._replace(field=dataclasses.replace(other.field, lobe=lobe, **parts), **proof)


def spread(array: np.ndarray, known: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Put an array [..., known wavelength] among all wavelengths, those that are not known as `missing`."""
    whole = np.broadcast_to(missing, (*array.shape[:-1], len(known))).copy()
    whole[..., known] = array
    return whole


def with_dead_wavelengths(
    field: GuidedField, wavelength_nm: np.ndarray, known: np.ndarray, missing: np.ndarray
) -> GuidedField:
    """Return the field at more wavelengths: `missing` is 0 where nothing was seen, nan where a value was not finite."""
    if known.all():
        return field
    names = [name for name in LAST_AXIS if name != "wavelength_nm"]
    parts = {name: spread(np.asarray(getattr(field, name)), known, missing) for name in names}
    amplitude = spread(np.asarray(field.lobe.log_amplitude), known, np.full(len(known), -np.inf))
    lobe = dataclasses.replace(field.lobe, log_amplitude=amplitude)
    return dataclasses.replace(field, wavelength_nm=wavelength_nm, lobe=lobe, **parts)
