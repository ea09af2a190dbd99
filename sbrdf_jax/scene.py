"""From what a scene looks at to the wavelengths and nodes that have to be computed."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from sbrdf_jax.direction_file import read_directions
from sbrdf_jax.errors import UserError
from sbrdf_jax.grid import Grid
from sbrdf_jax.masks import nodes_of_mask, read_mask
from sbrdf_jax.needs import Needs, everything
from sbrdf_jax.options import OutgoingOptions, RunOptions, SceneOptions, ThetaRange, WavelengthRange

SAME_NM = 1e-3  # a wavelength of a list is the measured one within this
SAME_ANGLE = 1e-9  # rad
WHOLE_HEMISPHERE = ("paper", "lobe_harmonics")  # represent methods whose harmonics need every outgoing direction


def find_needs(options: RunOptions, grid: Grid, wavelength_nm: Float[np.ndarray, " wavelength"]) -> Needs:
    """Work out what a config's scene needs of a measurement.

    Args:
        options: `scene`, and the methods, some of which need more than the scene itself.
        grid: The whole grid.
        wavelength_nm: All measured wavelengths [nm].

    Raises:
        UserError: The scene is impossible: no wavelength in range, nothing left, a wrong file.
    """
    needs = everything(grid, len(wavelength_nm))
    scene = options.scene
    if scene is None:
        return needs
    node = np.array(needs.node)
    if scene.theta_i_deg is not None:
        node &= _incident_angles(scene.theta_i_deg, grid)[:, None, None]
    if scene.outgoing is not None:
        node &= _outgoing(scene.outgoing, grid)
    if scene.footprint is not None:
        node &= nodes_of_mask(read_mask(scene.footprint, "scene.footprint"), grid)
    if not node.any():
        keys = [name for name in ("theta_i_deg", "outgoing", "footprint") if getattr(scene, name) is not None]
        raise UserError(f"scene: found no direction that {' and '.join(keys)} leave; expected at least one")
    if options.resample.method == "paper" or options.represent.method in WHOLE_HEMISPHERE:
        node |= node.any(axis=(1, 2), keepdims=True)
    return Needs(_wavelengths(scene, wavelength_nm), _with_copies(node, grid))


def _wavelengths(scene: SceneOptions, measured: np.ndarray) -> Bool[np.ndarray, " wavelength"]:
    wanted, key = scene.wavelength_nm, "scene.wavelength_nm"
    span = f"{measured[0]:g} to {measured[-1]:g} nm"
    if wanted is None:
        return np.ones(len(measured), bool)
    if isinstance(wanted, WavelengthRange):
        mask = (measured >= wanted.min - SAME_NM) & (measured <= wanted.max + SAME_NM)
        if not mask.any():
            raise UserError(f"{key}: found {wanted.min:g} to {wanted.max:g} nm; expected a range with some of {span}")
        return mask
    mask = np.zeros(len(measured), bool)
    for wavelength in wanted:
        nearest = int(np.argmin(np.abs(measured - wavelength)))
        if abs(measured[nearest] - wavelength) > SAME_NM:
            expected = f"expected measured ones, {span}; the nearest is {measured[nearest]:g}"
            raise UserError(f"{key}: found {wavelength:g} nm; {expected}")
        mask[nearest] = True
    return mask


def _incident_angles(wanted: tuple[float, ...] | ThetaRange, grid: Grid) -> Bool[np.ndarray, " theta_i"]:
    """Return the nodes on both sides of each angle; where nothing is interpolated over theta_i, the nearest."""
    nodes = grid.theta_i
    if isinstance(wanted, ThetaRange):
        low, high = np.deg2rad([wanted.min, wanted.max])
        first, last = (
            np.flatnonzero(_around(angle, nodes, grid.interpolate_theta_i))[[0, -1]] for angle in (low, high)
        )
        mask = np.zeros(len(nodes), bool)
        mask[first[0] : last[1] + 1] = True
        return mask
    return np.any([_around(angle, nodes, grid.interpolate_theta_i) for angle in np.deg2rad(wanted)], axis=0)


def _around(angle: float, nodes: np.ndarray, interpolated: bool = True) -> Bool[np.ndarray, " node"]:
    """Mask of the nodes between which an angle lies, or of the one that it is."""
    distance = np.abs(nodes - angle)
    if not interpolated or distance.min() <= SAME_ANGLE:
        return np.arange(len(nodes)) == np.argmin(distance)
    upper = int(np.clip(np.searchsorted(nodes, angle), 1, len(nodes) - 1)) if len(nodes) > 1 else 0
    return np.isin(np.arange(len(nodes)), (upper - 1, upper))


def _outgoing(wanted: OutgoingOptions, grid: Grid) -> Bool[np.ndarray, "theta_i theta_o phi_o"]:
    shape = (len(grid.theta_i), len(grid.theta_o), len(grid.phi_o))
    if wanted.theta_o_max_deg is not None:
        last = np.flatnonzero(_around(np.deg2rad(wanted.theta_o_max_deg), grid.theta_o))[-1]
        return np.broadcast_to((np.arange(shape[1]) <= last)[:, None], shape)
    if wanted.mask is not None:
        return nodes_of_mask(read_mask(wanted.mask, "scene.outgoing.mask"), grid)
    assert wanted.directions is not None
    angles = np.deg2rad(np.asarray(read_directions(Path(wanted.directions))[1], float).reshape(-1, 3))
    if not len(angles):
        raise UserError(f"scene.outgoing.directions: {wanted.directions}: found no direction; expected at least one")
    node = np.zeros(shape, bool)
    for theta_i, theta_o, phi_o in np.unique(angles % (2 * np.pi), axis=0):
        around = (
            _around(theta_i, grid.theta_i, grid.interpolate_theta_i),
            _around(theta_o, grid.theta_o),
            _around(phi_o, grid.phi_o),
        )
        node[np.ix_(*map(np.flatnonzero, around))] = True
    return node


def _with_copies(node: np.ndarray, grid: Grid) -> Bool[np.ndarray, "theta_i theta_o phi_o"]:
    """Add the nodes that are the same as one that is needed: mirror twins, 0 and 360 degrees, the poles."""
    node = node.copy()
    node[:, :, [0, -1]] |= node[:, :, [-1, 0]]
    if grid.bilateral:
        node |= node[:, :, ::-1]
    pole = grid.theta_o == 0
    node[:, pole] |= node[:, pole].any(axis=2, keepdims=True)
    normal = grid.theta_i == 0
    node[normal] |= node[normal].any(axis=2, keepdims=True)
    return node


def restrict_wavelengths(needs: Needs, chosen: Bool[np.ndarray, " wavelength"]) -> Needs:
    """Return needs at fewer wavelengths."""
    return dataclasses.replace(needs, wavelength=needs.wavelength & chosen)
