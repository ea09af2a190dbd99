"""What the figures read off a grid: its interpolation on fine axes, nearest measured wavelength, ring effect."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sbrdf_jax import colour
from sbrdf_jax.evaluation import evaluate_on_axes
from sbrdf_jax.grid import has_data
from sbrdf_jax.metrics import live_wavelengths
from sbrdf_jax.records import GriddedBRDF

PAPER_WAVELENGTH_NM = 550.0
PAPER_INCIDENCES = np.radians([0.0, 15.0, 45.0])


class Picked(NamedTuple):
    """A place on an axis that stands for the wanted one; `text` says so where it is another."""

    index: int
    value: float
    text: str


def pick_wavelength(wavelength_nm: Float[np.ndarray, " wavelength"], wanted: float = PAPER_WAVELENGTH_NM) -> Picked:
    """Return the measured wavelength [nm] nearest to the wanted one."""
    index = int(np.argmin(np.abs(wavelength_nm - wanted)))
    value = float(wavelength_nm[index])
    text = f"{value:g} nm" if np.isclose(value, wanted) else f"{value:g} nm (nearest to {wanted:g} nm)"
    return Picked(index, value, text)


def finite_wavelengths(gridded: GriddedBRDF) -> np.ndarray:
    """Indices of the wavelengths that are finite at every node that is needed."""
    return np.flatnonzero(live_wavelengths(gridded))


def pick_incidences(gridded: GriddedBRDF) -> list[Picked]:
    """Return the nodes of theta_i nearest to the paper's 0, 15 and 45 degrees, each once."""
    nodes = np.asarray(gridded.theta_i)
    picked = {}
    for wanted in PAPER_INCIDENCES:
        index = int(np.argmin(np.abs(nodes - wanted)))
        if index not in picked:
            is_exact = abs(nodes[index] - wanted) < np.radians(0.01)
            text = f"{np.degrees(nodes[index]):.4g}°" + ("" if is_exact else f" (for {np.degrees(wanted):.4g}°)")
            text += ", no data" if has_no_data(gridded, index) else ""
            picked[index] = Picked(index, float(nodes[index]), text)
    return list(picked.values())


def has_no_data(gridded: GriddedBRDF, incidence: int) -> bool:
    """Whether every node of an incident angle lies beyond the measured range."""
    return not has_data(gridded)[incidence]


@dataclasses.dataclass(frozen=True)
class FineGrid:
    """A grid's interpolation, eq. (5), with and without the window of eq. (17), on fine axes."""

    incidences: list[Picked]
    theta_o: np.ndarray  # [theta_o] rad, 0 to pi/2
    phi_o: np.ndarray  # [phi_o] rad, 0 to 2 pi inclusive
    wavelength: Picked
    windowed: np.ndarray  # [incidence, theta_o, phi_o, channel]: value at `wavelength` [1/sr], then linear sRGB
    plain: np.ndarray  # likewise, without the window

    def plane(self, values: np.ndarray, incidence: int, channel: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Signed angles [rad] and values in the plane of incidence; the mirror side (phi_o = pi) is positive."""
        middle = len(self.phi_o) // 2
        before, after = values[incidence, :, 0, channel], values[incidence, :, middle, channel]
        return np.concatenate([-self.theta_o[:0:-1], self.theta_o]), np.concatenate([before[:0:-1], after])


def interpolate_finely(gridded: GriddedBRDF, num_theta: int = 181, num_phi: int = 181) -> FineGrid:
    """Interpolate a grid at the paper's incidences, at one wavelength and in colour, from the finite wavelengths.

    Interpolation is linear in the node values, so the colours of the interpolated spectra are the interpolated colours
    of the nodes: four channels in place of all wavelengths.

    Args:
        gridded: A grid that is finite at one wavelength at least.
        num_theta: Points from 0 to 90 degrees.
        num_phi: Points from 0 to 360 degrees, odd so that 180 is one of them.

    Returns:
        The interpolation under the grid's window and under none; for a field of its own, that field as both.
    """
    solved = finite_wavelengths(gridded)
    wavelength_nm = np.asarray(gridded.wavelength_nm)[solved]
    wavelength = pick_wavelength(wavelength_nm)
    incidences = pick_incidences(gridded)
    chosen = wavelength._replace(index=int(solved[wavelength.index]))
    if gridded.field is not None:
        return _evaluate_finely(gridded, incidences, chosen, solved)
    brdf = np.asarray(gridded.brdf)[..., solved]
    matching = colour.colour_matching(wavelength_nm)
    channels = np.concatenate(
        [brdf[..., wavelength.index : wavelength.index + 1], colour.brdf_to_srgb(brdf, matching, gamma=False)], axis=-1
    )
    theta_o, phi_o = np.linspace(0, np.pi / 2, num_theta), np.linspace(0, 2 * np.pi, num_phi)
    reduced = dataclasses.replace(gridded, brdf=channels, wavelength_nm=np.arange(4.0))
    plain, windowed = (
        evaluate_on_axes(
            dataclasses.replace(reduced, window=window), np.array([p.value for p in incidences]), theta_o, phi_o
        )
        for window in ("none", gridded.window)
    )
    return FineGrid(incidences, theta_o, phi_o, chosen, windowed, plain)


def _evaluate_finely(
    gridded: GriddedBRDF, incidences: list[Picked], wavelength: Picked, solved: np.ndarray, num: int = 91
) -> FineGrid:
    theta_o, phi_o = np.linspace(0, np.pi / 2, num), np.linspace(0, 2 * np.pi, num)
    half = phi_o[: (num + 1) // 2]  # a field is the same on both sides of the plane of incidence
    value = evaluate_on_axes(gridded, np.array([p.value for p in incidences]), theta_o, half)
    matching = colour.colour_matching(np.asarray(gridded.wavelength_nm)[solved])
    linear = colour.brdf_to_srgb(value[..., solved], matching, gamma=False)
    channels = np.concatenate([value[..., wavelength.index, None], linear], axis=-1)
    channels = np.concatenate([channels, channels[:, :, -2::-1]], axis=2)
    return FineGrid(incidences, theta_o, phi_o, wavelength, channels, channels)


@dataclasses.dataclass(frozen=True)
class RingEffect:
    """Total variation [1/sr] of the field over the hemisphere at one incident angle and wavelength."""

    nodes: float  # of the straight lines between the nodes: what a field without rings would have
    plain: float  # of eq. (5)
    windowed: float  # of eq. (5) under the window of eq. (17)

    def ratio(self, value: float) -> float:
        """Return a variation over that of the nodes; 1 where neither varies."""
        return value / self.nodes if self.nodes > 0 else (1.0 if value == 0 else float("inf"))


def total_variation(
    value: Float[np.ndarray, "theta_o phi_o"],
    theta_o: Float[np.ndarray, " theta_o"],
    phi_o: Float[np.ndarray, " phi_o"],
) -> float:
    """Integral of the gradient's length over the hemisphere, by central cells.

    Args:
        value: Field on the axes [1/sr].
        theta_o: Increasing polar angles [rad].
        phi_o: Increasing azimuths [rad] over the full turn.

    Returns:
        Total variation [rad / sr]: a ring of height h round the pole at angle t adds 4 pi sin(t) h.
    """
    step_theta, step_phi = np.diff(theta_o)[:, None], np.diff(phi_o)[None, :]
    along_theta = (np.diff(value, axis=0)[:, 1:] + np.diff(value, axis=0)[:, :-1]) / 2
    along_phi = (np.diff(value, axis=1)[1:] + np.diff(value, axis=1)[:-1]) / 2
    sine = np.sin((theta_o[1:] + theta_o[:-1]) / 2)[:, None]
    return float(np.hypot(along_theta * sine * step_phi, along_phi * step_theta).sum())


def ring_effect(gridded: GriddedBRDF, fine: FineGrid, incidence: int = 0) -> RingEffect:
    """Measure the ring effect of eq. (5), and what the window of eq. (17) leaves of it, at one picked incidence."""
    node_value = np.asarray(gridded.brdf)[fine.incidences[incidence].index, :, :, fine.wavelength.index]
    rows = np.array([np.interp(fine.theta_o, gridded.theta_o, column) for column in node_value.T])
    straight = np.array([np.interp(fine.phi_o, gridded.phi_o, row) for row in rows.T])
    axes = (fine.theta_o, fine.phi_o)
    return RingEffect(
        nodes=total_variation(straight, *axes),
        plain=total_variation(fine.plain[incidence, :, :, 0], *axes),
        windowed=total_variation(fine.windowed[incidence, :, :, 0], *axes),
    )
