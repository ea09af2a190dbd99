"""What is needed of a measurement and its grid: the wavelengths, the incident angles, the nodes."""

import dataclasses

import numpy as np
from jaxtyping import Bool

from sbrdf_jax.grid import Grid
from sbrdf_jax.records import GriddedBRDF, SpectralField


@dataclasses.dataclass(frozen=True)
class Needs:
    """Masks of what has to be computed; what is outside them is skipped, and nan where it has a place."""

    wavelength: Bool[np.ndarray, " wavelength"]  # of the measured ones
    node: Bool[np.ndarray, "theta_i theta_o phi_o"]  # of the grid; phi_o from 0 to 2 pi inclusive

    @property
    def theta_i(self) -> Bool[np.ndarray, " theta_i"]:
        """Which of the grid's incident angles have a node that is needed."""
        return self.node.any(axis=(1, 2))


def everything(grid: Grid, num_wavelengths: int) -> Needs:
    """Return the needs of no scene in particular."""
    node = np.ones((len(grid.theta_i), len(grid.theta_o), grid.num_phi_o + 1), bool)
    return Needs(np.ones(num_wavelengths, bool), node)


def restrict_theta_i(
    field: SpectralField, gridded: GriddedBRDF, theta_i: np.ndarray
) -> tuple[SpectralField, GriddedBRDF]:
    """Return what the compact form is made of: the incident angles [rad] that are needed, of a grid that has more."""
    rows = np.isin(np.asarray(gridded.theta_i), theta_i)
    if rows.all():
        return field, gridded
    part = dataclasses.replace(
        gridded,
        theta_i=np.asarray(gridded.theta_i)[rows],
        brdf=np.asarray(gridded.brdf)[rows],
        extrapolated=np.asarray(gridded.extrapolated)[rows],
        needed=None,
        standard_error=None,
        residual_variance=None,
    )
    coefficient = np.asarray(field.coefficient)[rows]
    return dataclasses.replace(field, theta_i=part.theta_i, coefficient=coefficient), part
