"""The compact form fitted once per lobe kind at one incident angle, for figure 10."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from sbrdf_jax.lobes import LOBE_KINDS
from sbrdf_jax.metrics import on_axes, relative_error
from sbrdf_jax.options import RepresentOptions
from sbrdf_jax.records import CompactBRDF, GriddedBRDF, SpectralField
from sbrdf_jax.representation import represent


class KindFit(NamedTuple):
    """A compact form with one lobe kind throughout, and its eta of eq. (18) at its incident angle."""

    kind: str
    max_degree: int
    compact: CompactBRDF
    error: float


def fit_lobe_kinds(
    field: SpectralField, gridded: GriddedBRDF, incidence: int, degrees: tuple[int, ...] = (1, 4)
) -> list[KindFit]:
    """Fit eqs. (14), (15) and (16) to one incident angle, for each maximal degree of the harmonics.

    Args:
        field: Spectral coefficients on the grid.
        gridded: The grid, which the error is measured against.
        incidence: Index of the incident angle.
        degrees: Values of L; the paper has 1 and 4.

    Returns:
        A fit for each degree and kind, degrees first.
    """
    one = slice(incidence, incidence + 1)
    part = dataclasses.replace(
        field,
        theta_i=np.asarray(field.theta_i)[one],
        coefficient=jnp.asarray(field.coefficient)[one],
        interpolate_theta_i=False,
    )
    live = np.isin(np.asarray(gridded.wavelength_nm), np.asarray(field.basis.wavelength_nm))
    original = np.asarray(gridded.brdf)[incidence][..., live]
    fits = []
    for degree in degrees:
        for kind in LOBE_KINDS[1:]:
            options = RepresentOptions(method="paper", max_degree=degree, lobe=kind)  # type: ignore[arg-type]
            compact = represent(part, options)
            value = on_axes(compact, float(gridded.theta_i[incidence]), gridded.theta_o, gridded.phi_o)
            error = float(relative_error(((value - original) ** 2).sum(), (original**2).sum()))
            fits.append(KindFit(kind, degree, compact, error))
    return fits
