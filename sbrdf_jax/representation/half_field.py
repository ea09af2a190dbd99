"""What a lobe tensor is fitted to: a field on one side of the plane of incidence, at its nodes and between them.

SciPy's interpolation and images take half a second to import, and few runs need them: functions import them.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sbrdf_jax.angles import SAME_ANGLE
from sbrdf_jax.encoding import logarithm
from sbrdf_jax.evaluation import evaluate_where
from sbrdf_jax.grid import has_data, midpoints
from sbrdf_jax.records import GriddedBRDF, SpectralField
from sbrdf_jax.representation.midway import Rows, between_incident_angles, left_out_error
from sbrdf_jax.representation.target import azimuth_twins

SKIPPED_WEIGHT = 1e-3  # of a node that no scene needs: it has its neighbour's value, and is not to run wild
UNKNOWN_WEIGHT = 0.01  # of an incident angle without data: it does not count, but is not to run wild
BETWEEN_WEIGHT = 0.03  # of the error between the nodes, beside that at them, where the field is known there
MIRROR_WEIGHT = 0.02  # of the error near the mirror direction, closer to it than any node or midpoint but its own
NEAR_MIRROR = np.array([2 / 3, 1 / 3, 1 / 6, 1 / 12, 1 / 24, 0.0])  # steps of phi_o off the plane of incidence
GUESS_WEIGHT = 1e-4  # where it is interpolated: enough that nothing runs wild
WIDE_GAP = np.radians(15.0)  # of incident angles so far apart what is midway counts like a node; below it splines
# are better by the sixth power of the gap, and it counts less
RELATIVE_SHARE = 0.03  # of the error relative to each direction's own energy
RELATIVE_FLOOR = 1e-3  # of the mean energy of a direction
NOTHING = 1e-6  # of the energy of a typical direction: its logarithm does not count
COLOUR_SHARE = 3.0  # of squared errors of lightness, where a colour difference is asked for
LINEAR_BELOW = (6 / 29) ** 3  # CIE 1976 L*: linear in Y below it, a cube root above


class Block(NamedTuple):
    """Spectra at every combination of three axes."""

    theta_i: Float[np.ndarray, " i"]  # rad
    theta_o: Float[np.ndarray, " o"]  # rad
    phi_o: Float[np.ndarray, " p"]  # rad, 0 to pi
    brdf: Float[np.ndarray, "i o p wavelength"]  # 1/sr
    weight: Float[np.ndarray, "i o p"]  # of squared errors
    needed: Bool[np.ndarray, "i o p"]  # what counts


class HalfField(NamedTuple):
    """The nodes, then the midpoints of theta_o and phi_o at their incident angles, then what lies elsewhere between."""

    blocks: tuple[Block, ...]
    known: Bool[np.ndarray, " theta_i"]  # incident angles that count: finite, not zero throughout, and with data
    asymmetry: float  # largest relative size of what is odd in phi_o, which is dropped
    is_field: bool = False  # what is between the nodes is known, not interpolated
    left_out: Float[np.ndarray, " theta_i"] | None = None  # where it is not: eta of incident angles guessed from others

    @property
    def nodes(self) -> Block:
        """The block that eq. (18) is about."""
        return self.blocks[0]


def half_field(
    field: SpectralField,
    brdf: Float[np.ndarray, "i o p wavelength"],
    gridded: GriddedBRDF | None,
    *,
    in_colour: bool = False,
    in_logarithm: bool = False,
) -> HalfField:
    """Gather what a lobe tensor is fitted to.

    Args:
        field: The axes.
        brdf: Spectra at the nodes [1/sr].
        gridded: The grid stage: which incident angles have data, and what the field is between
            its nodes where it has a field of its own. Otherwise monotone cubics through logarithms.
        in_colour: A colour difference is asked for: errors count as an eye sees them.
        in_logarithm: Weights are those of squared errors of logarithms.
    """
    theta_i, theta_o, phi_o = (np.asarray(a, np.float64) for a in (field.theta_i, field.theta_o, field.phi_o))
    count = (len(phi_o) + 1) // 2
    half, mirrored = brdf[:, :, :count], brdf[:, :, ::-1][:, :, :count]
    even = (half + mirrored) / 2
    needed = np.ones(even.shape[:3], bool)
    if gridded is not None and gridded.needed is not None:
        needed = np.asarray(gridded.needed)[:, :, :count]
        even = np.where(needed[..., None], even, 0.0)
    energy = _energy(even, np.ones(count))
    usable = np.isfinite(energy) & (energy > 0)
    known = usable.copy()
    if gridded is not None:
        known &= has_data(gridded)
    if not known.any():
        known = usable
    if not usable.any():
        return HalfField((), known, 0.0)
    odd = np.where(needed[..., None], half - even, 0.0)
    asymmetry = float(np.sqrt((_energy(odd, np.ones(count))[usable] / energy[usable]).max()))
    place = np.arange(usable.argmax(), len(usable) - usable[::-1].argmax())  # from the first to the last
    share = np.where(known, 1.0, np.where(usable, UNKNOWN_WEIGHT, 0.0))[place]
    needed = needed[place]
    block = functools.partial(_block, in_colour=in_colour, in_logarithm=in_logarithm)
    nodes = block(theta_i[place], theta_o, phi_o[:count], even[place], share, needed)
    mid_o, mid_phi = midpoints(theta_o), midpoints(phi_o[:count])
    every_o, near = near_mirror(theta_o, phi_o)
    less = np.minimum(share[:-1], share[1:])
    blocks = [nodes]

    def add(theta_i, theta_o, phi_o, brdf, share, needed=None) -> None:
        needed = np.ones(brdf.shape[:3], bool) if needed is None else needed
        blocks.append(block(theta_i, theta_o, phi_o, brdf, share, needed))

    if gridded is None or gridded.field is None:
        left_out, logarithms = np.full(len(theta_i), np.nan), logarithm(nodes.brdf)
        for at_o, at_phi in ((mid_o, mid_phi), (every_o, near)):
            add(nodes.theta_i, at_o, at_phi, _interpolate(nodes, logarithms, at_o, at_phi), GUESS_WEIGHT * share)
        gaps = np.diff(nodes.theta_i)
        if field.interpolate_theta_i and len(gaps) and np.ptp(gaps) < SAME_ANGLE:
            rows = Rows(*nodes[:3], logarithms, share > 0)
            trust = min(float(gaps[0] / WIDE_GAP), 1.0) ** 12
            add(midpoints(nodes.theta_i), *between_incident_angles(rows), trust * less)
            left_out[place] = left_out_error(rows)
        return HalfField(tuple(blocks), known, asymmetry, left_out=left_out)
    finite = np.isin(np.asarray(gridded.field.wavelength_nm), np.asarray(field.basis.wavelength_nm))
    cell, beside = cells_between(needed), beside_mirror(needed)
    rows = [(nodes.theta_i, share, cell, beside)]
    if field.interpolate_theta_i and len(nodes.theta_i) > 1:
        rows.append((midpoints(nodes.theta_i), less, cell[:-1] & cell[1:], beside[:-1] & beside[1:]))
    for kind, (at_o, at_phi, part) in enumerate(((mid_o, mid_phi, BETWEEN_WEIGHT), (every_o, near, MIRROR_WEIGHT))):
        for at_i, weight, *masks in rows:
            mask = masks[kind]
            brdf = _evaluate_needed(gridded, at_i, at_o, at_phi, mask)[..., finite]
            add(at_i, at_o, at_phi, brdf, part * weight, mask)
    return HalfField(tuple(blocks), known, asymmetry, is_field=True)


def near_mirror(theta_o, phi_o) -> tuple[Float[np.ndarray, " between"], Float[np.ndarray, " near"]]:
    """Return theta_o of nodes and midpoints, and azimuths close to the plane of incidence, the last one in it."""
    every_o = np.sort(np.concatenate([theta_o, midpoints(theta_o)]))
    return every_o, np.pi - np.diff(phi_o).mean() * NEAR_MIRROR


def beside_mirror(needed: Bool[np.ndarray, "i o p"]) -> Bool[np.ndarray, "i between near"]:
    """Which nodes and midpoints of theta_o have needed nodes around them next to the plane of incidence."""
    nodes = needed[:, :, -1] & needed[:, :, -2]
    mask = np.zeros((len(nodes), 2 * nodes.shape[1] - 1), bool)
    mask[:, ::2], mask[:, 1::2] = nodes, nodes[:, :-1] & nodes[:, 1:]
    return np.repeat(mask[:, :, None], len(NEAR_MIRROR), axis=2)


def cells_between(needed: Bool[np.ndarray, "i o p"]) -> Bool[np.ndarray, "i o-1 p-1"]:
    """Which midpoints of theta_o and phi_o have four nodes around them that are needed."""
    return needed[:, :-1, :-1] & needed[:, 1:, :-1] & needed[:, :-1, 1:] & needed[:, 1:, 1:]


def _evaluate_needed(gridded: GriddedBRDF, theta_i, theta_o, phi_o, needed: Bool[np.ndarray, "i o p"]) -> np.ndarray:
    """Evaluate those combinations of three axes that are needed; 0 elsewhere."""
    value = np.zeros((*needed.shape, np.size(gridded.wavelength_nm)))
    value[needed] = evaluate_where(gridded, theta_i, theta_o, phi_o, needed)
    return value


def _block(theta_i, theta_o, phi_o, brdf, share, needed, *, in_colour: bool, in_logarithm: bool) -> Block:
    """Return a block in which an incident angle weighs `share`, whatever its energy.

    Squares of errors count relative to the energy of the incident angle, as in eq. (18), and to
    a small part relative to the direction's own: the colour of dark directions rests on that. In
    colour, they count by the slope of CIE 1976 L* there too. An error of a logarithm counts as
    that of the value to first order, and relative to the direction's own unless that is nothing.
    """
    twins = azimuth_twins(phi_o)
    energy = _energy(brdf, twins)
    usable = np.isfinite(energy) & (energy > 0) & (share > 0)
    clean = np.where(usable[:, None, None, None], brdf, 0.0)
    energy = np.where(usable, energy, 1.0)[:, None, None]
    clean = _filled(clean, needed)
    each = (clean**2).sum(axis=-1)
    number = (needed * twins).sum(axis=(1, 2))[:, None, None]
    relative = RELATIVE_SHARE / (number * each + RELATIVE_FLOOR * energy)
    if in_colour:
        slope = np.maximum(np.pi * clean.mean(axis=-1), LINEAR_BELOW) ** (-2 / 3)  # 1 for the perfect diffuser
        seen = np.where(needed, slope**2 * each * twins, 0.0).sum(axis=(1, 2))
        relative += COLOUR_SHARE * slope**2 / np.where(seen > 0, seen, 1.0)[:, None, None]
    weight = 1 / energy + relative
    if in_logarithm:
        typical = np.median(each, axis=(1, 2), keepdims=True)
        fades = each / np.maximum(each + NOTHING * typical, 1e-300)
        weight = (weight * each + RELATIVE_SHARE / np.maximum(number, 1) * fades) / clean.shape[-1]
    weight = np.where(usable, share, 0.0)[:, None, None] * weight * twins
    return Block(theta_i, theta_o, phi_o, clean, np.where(needed, weight, SKIPPED_WEIGHT * weight), needed)


def _filled(brdf: np.ndarray, needed: Bool[np.ndarray, "i o p"]) -> np.ndarray:
    """Give what is skipped the value of the nearest direction of its incident angle that is needed."""
    if needed.all():
        return brdf
    from scipy.ndimage import distance_transform_edt

    filled = brdf.copy()
    for value, mask in zip(filled, needed, strict=True):
        if mask.any() and not mask.all():
            nearest = distance_transform_edt(~mask, return_distances=False, return_indices=True)
            value[:] = value[tuple(nearest)]
    return filled


def _energy(brdf, twins):
    return np.einsum("iopw,iopw,p->i", brdf, brdf, twins)


def _interpolate(nodes: Block, logarithms: np.ndarray, theta_o, phi_o):
    """Interpolate nodes by monotone cubics through their logarithms: in theta_o, then in phi_o."""
    from scipy.interpolate import PchipInterpolator

    value = PchipInterpolator(nodes.theta_o, logarithms, axis=1)(theta_o)
    return np.exp(PchipInterpolator(nodes.phi_o, value, axis=2)(phi_o))
