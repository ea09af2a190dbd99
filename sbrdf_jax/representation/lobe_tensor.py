"""The compact form `lobe_tensor`: one Tucker decomposition of a whole field, lobes of all widths in its third factor.

Incident angles are scaled to equal energy; a directional factor of the half angle holds the
lobe, wherever its peak is, so that the factors of theta_i and theta_o are smooth and few.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sbrdf_jax import colour
from sbrdf_jax.encoding import decode, restore, spectral_vectors, transform, vector_basis
from sbrdf_jax.options import ErrorBudget, RepresentOptions
from sbrdf_jax.records import GriddedBRDF, LobeTensor, SpectralBasis, SpectralField, Status
from sbrdf_jax.representation.direction_functions import (
    direction_functions,
    half_angle_floor,
    num_direction_functions,
)
from sbrdf_jax.representation.half_field import Block, HalfField, half_field
from sbrdf_jax.representation.target import Target, azimuth_twins, in_words, is_met, make_target, measured, node_errors
from sbrdf_jax.representation.tensor_fit import Factors, Normal, TensorFit
from sbrdf_jax.representation.tensor_growth import NO_ERROR, grow
from sbrdf_jax.representation.tensor_pruning import stored_cells
from sbrdf_jax.splines import spline_weights

MOST_FUNCTIONS = 13  # of one polar angle; the factors are smooth, however fine the grid
ASYMMETRIC = 0.01  # relative size of the part odd in phi_o from which a user is told that it is dropped
USELESS = 0.5  # error at the worst incident angle from which a user is told that a size was too small
SHARES = (0.7, 3.0)  # least and most that the balance takes an incident angle's error for, over that of all
MOST_BETWEEN = 5.0  # times a target's error may be that between the nodes, of a field that is known there


class Layout(NamedTuple):
    """What fixes the size of a tensor, but for its ranks."""

    num_theta_i: int  # nodes of the grid
    functions: tuple[int, int, int]  # of theta_i, theta_o, direction
    num_wavelengths: int
    stores_vectors: bool  # of the basis; they are counted

    def numbers(self, a: int, b: int, q: int, channels: int, core: int) -> int:
        """Count all numbers that the `compact` group holds, its axes and the `core` of a core included."""
        n_i, n_o, n_q = self.functions
        axes = 2 * self.num_theta_i + 2 + self.num_wavelengths + sum(self.functions) + a + b + q + channels
        vectors = channels * self.num_wavelengths if self.stores_vectors else 0
        return axes + n_i + n_i * a + n_o * b + n_q * q + core + vectors


def stored_numbers(tensor: LobeTensor) -> int:
    """Count all numbers that the `compact` group of a result holds, its axes and statuses included."""
    a, b, q, channels = np.shape(tensor.core)
    factors = tensor.theta_i_factor, tensor.theta_o_factor, tensor.direction_factor
    functions = tuple(len(factor) for factor in factors)
    num_wavelengths, is_data = np.size(tensor.basis.wavelength_nm), tensor.basis.stores_vectors
    return Layout(np.size(tensor.theta_i), functions, num_wavelengths, is_data).numbers(
        a, b, q, channels, stored_cells(tensor.core)
    )


def represent(
    field: SpectralField,
    options: RepresentOptions,
    gridded: GriddedBRDF | None = None,
    matching: colour.ColourMatching | None = None,
    budget: ErrorBudget | None = None,
) -> tuple[LobeTensor, dict[str, Any]]:
    """Return the smallest lobe tensor that meets the target, or the best that there is, and what was found.

    Args:
        field: Coefficients at the nodes; phi_o from 0 to 2 pi inclusive. In basis "data" the
            vectors are taken in order, as many as pay; of another basis all coefficients are.
        options: `target` is used.
        gridded: The grid stage, if there is one: the spectra before encoding, which incident
            angles have data, and the field between the nodes.
        matching: Colours of the field's wavelengths, where they are not those of all that was measured.
        budget: An error that is enough, where the target asks for less or for another thing.

    Returns:
        The tensor, and a plan: ranks, what was promised and what was measured, `warnings`, and `half_field`, what it
        was fitted to; of a grid without a field `left_out_error`, eta of incident angles guessed from every second one.

    Numerics:
        Least squares of the values themselves; the clip at 0 comes last and lowers the error of a
        field that is nowhere negative. What is odd in phi_o is dropped, with a warning.
    """
    if gridded is not None:
        field = dataclasses.replace(field, interpolate_theta_i=gridded.interpolate_theta_i)
    theta_i, theta_o = np.asarray(field.theta_i, np.float64), np.asarray(field.theta_o, np.float64)
    brdf = np.asarray(
        decode(np.asarray(field.coefficient, np.float64), field.basis) if gridded is None else gridded.brdf
    )
    num_wavelengths = np.size(field.basis.wavelength_nm)
    target = make_target(options.target, len(theta_i), num_wavelengths, budget)
    half = half_field(field, brdf, gridded, in_colour=target.in_colour, in_logarithm=field.basis.is_logarithmic)
    floor = half_angle_floor(float(np.diff(theta_o).min()))
    if half.blocks:
        ends = half.nodes.theta_i[[0, -1]]
    else:
        ends = theta_i[[0, -1]]
    num_rows = len(np.unique(np.concatenate([block.theta_i for block in half.blocks]))) if half.blocks else len(theta_i)
    num_i = min(num_rows, MOST_FUNCTIONS) if field.interpolate_theta_i else len(theta_i)
    functions = num_i, min(len(theta_o), MOST_FUNCTIONS), num_direction_functions(floor, is_field=half.is_field)
    layout = Layout(len(theta_i), functions, num_wavelengths, field.basis.stores_vectors)
    finite = np.isfinite(brdf).all(axis=3)
    if gridded is not None and gridded.needed is not None:
        finite |= ~np.asarray(gridded.needed)
    status = np.where(finite.all(axis=(1, 2)), int(Status.SKIPPED), int(Status.NONFINITE))
    status = np.where(half.known, int(Status.OK), status)
    basis = field.basis
    if not half.blocks:  # zero or nothing everywhere
        basis = vector_basis(basis.wavelength_nm, basis.synthesis) if basis.is_logarithmic else basis  # has no zero
        factors, log_scale = Factors(*(np.zeros((n, 1)) for n in functions), _no_core(basis)), np.zeros(num_i)
        achieved = worst = 0.0
    else:
        factors, log_scale, basis, achieved, worst = _fit(field, half, layout, target, floor, matching)
    tensor = LobeTensor(
        theta_i,
        ends,
        basis,
        log_scale,
        *factors,
        status,
        half_angle_floor=floor,
        interpolate_theta_i=field.interpolate_theta_i,
    )
    plan = {"method": "lobe_tensor", "ranks": np.array(np.shape(tensor.core)), "half_field": half}
    if half.left_out is not None:
        plan["left_out_error"] = half.left_out
    return tensor, plan | make_plan(target, achieved, worst, half)


def _fit(field: SpectralField, half: HalfField, layout: Layout, target: Target, floor: float, matching):
    """Return factors, scales, the basis that they are in, what was measured of the target, and the worst error."""
    vectors, to_coefficient = channels_of(field.basis, half)
    place = np.isin(np.asarray(field.theta_i, np.float64), half.nodes.theta_i)
    rows = np.unique(np.concatenate([block.theta_i for block in half.blocks]))
    columns = np.unique(np.concatenate([block.theta_o for block in half.blocks]))
    if field.interpolate_theta_i:
        low, high = half.nodes.theta_i[[0, -1]]
        at_rows = spline_weights((rows - low) / (high - low if high > low else 1.0), layout.functions[0])
    else:
        at_rows = np.eye(layout.functions[0])[place]
    at_columns = spline_weights(columns * (2 / np.pi), layout.functions[1])

    energy = np.einsum("iopw,iopw->i", half.nodes.brdf, half.nodes.brdf)
    scaled = np.flatnonzero(energy > 0)
    log_energy = np.interp(rows, half.nodes.theta_i[scaled], np.log(energy[scaled]))
    if field.basis.is_logarithmic:  # a factor is a sum there
        log_energy = np.zeros(len(rows))
    log_scale = np.linalg.lstsq(at_rows, -0.5 * log_energy)[0]
    scale = np.exp(at_rows @ log_scale)

    size, count = layout.functions[2], len(vectors)
    gram, moment = np.zeros((len(rows), len(columns), size, size)), np.zeros((len(rows), len(columns), size, count))
    total = np.zeros(len(rows))
    for block in half.blocks:
        o, fitted = np.searchsorted(columns, block.theta_o), transform(block.brdf, field.basis)
        for i, angle in enumerate(block.theta_i):
            row = np.searchsorted(rows, angle)
            function = _functions(angle, block.theta_o, block.phi_o, floor, size)
            weight = (block.weight[i] / scale[row] ** 2)[..., None]
            weighted = np.swapaxes(function * weight, 1, 2)
            value = scale[row] * (fitted[i] @ vectors.T)
            gram[row, o] += weighted @ function
            moment[row, o] += weighted @ value
            total[row] += (weight * value**2).sum()
    fit = TensorFit(Normal(gram, moment, total, at_rows, at_columns))

    nodes, counts = half.nodes, half.known[place]
    seen = [_Seen.of(block, rows, columns, floor, size) for block in half.blocks[: 2 if half.is_field else 1]]
    if target.in_colour and matching is None:
        matching = colour.colour_matching(np.asarray(field.basis.wavelength_nm))

    def value(part: _Seen, factors: Factors) -> np.ndarray:
        amplitude = fit.amplitudes(factors.theta_i, factors.theta_o, factors.core)[np.ix_(part.rows, part.columns)]
        value = ((part.function @ factors.direction) @ amplitude) @ vectors[: factors.core.shape[3]]
        return np.maximum(restore(value / scale[part.rows][:, None, None, None], field.basis), 0.0)

    def eta(number: int, factors: Factors) -> np.ndarray:
        """Errors of the needed directions of a block, at each incident angle that counts."""
        part, block = seen[number], half.blocks[number]
        mask = block.needed[..., None]
        found, wanted = (np.where(mask, brdf, 0.0) for brdf in (value(part, factors), block.brdf))
        return node_errors(found, wanted, part.twins)[counts]

    def measure(target: Target, factors: Factors) -> float:
        stored = layout.numbers(*factors.ranks, factors.core.shape[3], stored_cells(factors.core))
        if target.is_size:
            return measured(target, stored, nodes.brdf, nodes.brdf, seen[0].twins, counts, None)
        found = value(seen[0], factors)
        return measured(target, stored, found, nodes.brdf, seen[0].twins, counts, matching, nodes.needed)

    def is_enough(factors: Factors) -> bool:
        if not target.stops or not all(is_met(stop, measure(stop, factors)) for stop in target.stops):
            return False
        allowed = MOST_BETWEEN * min((stop.value for stop in target.stops if stop.kind == "error"), default=np.inf)
        if allowed >= 1 or not half.is_field:
            return True
        return bool(eta(1, factors).max(initial=0.0) <= allowed)

    def errors(factors: Factors) -> np.ndarray:
        at_nodes = eta(0, factors)
        share = at_nodes / np.sqrt(max(np.mean(at_nodes**2), NO_ERROR))
        return np.interp(rows, nodes.theta_i[counts], np.clip(share, *SHARES))

    first = min(2, count) if layout.stores_vectors else count
    # what whole hemispheres may cost is too much for a part of them
    share, axes = float(np.mean(nodes.needed)), layout.numbers(0, 0, 0, 0, 0)
    spectra = layout.num_wavelengths if layout.stores_vectors else 0

    def numbers(*sizes: int) -> int:
        """Count numbers; of axes and spectra, which all hemispheres share, those that a part of them is to pay for."""
        return layout.numbers(*sizes) - int((1 - share) * (axes + spectra * sizes[3]))

    factors = grow(fit, numbers, share * target.budget, is_enough, errors, first_channels=first)
    achieved, used = measure(target, factors), factors.core.shape[3]
    worst = measure(target._replace(kind="error"), factors) if target.is_size else achieved
    basis = field.basis
    if basis.stores_vectors:
        basis = vector_basis(basis.wavelength_nm, vectors[:used], basis.kind)
    return factors._replace(core=factors.core @ to_coefficient[:used, :used]), log_scale, basis, achieved, worst


class _Seen(NamedTuple):
    """A block as the factors see it."""

    rows: np.ndarray  # among those of the fit
    columns: np.ndarray
    function: Float[np.ndarray, "i o p function"]
    twins: Float[np.ndarray, " p"]  # how many directions of the circle each azimuth stands for

    @classmethod
    def of(cls, block: Block, rows: np.ndarray, columns: np.ndarray, floor: float, count: int) -> "_Seen":
        """See a block among the rows and columns of a fit."""
        function = [_functions(angle, block.theta_o, block.phi_o, floor, count) for angle in block.theta_i]
        places = (np.searchsorted(axis, own) for axis, own in ((rows, block.theta_i), (columns, block.theta_o)))
        return cls(*places, np.stack(function), azimuth_twins(block.phi_o))


def _functions(theta_i, theta_o, phi_o, floor, count) -> Float[np.ndarray, "o p function"]:
    """Return the directional functions of one incident angle at every combination of two axes."""
    mesh = np.meshgrid(theta_o, phi_o, indexing="ij")
    return direction_functions(np.full(mesh[0].shape, theta_i), *mesh, floor, count)


def channels_of(basis: SpectralBasis, half: HalfField) -> tuple[np.ndarray, np.ndarray]:
    """Return orthonormal spectra [channel, wavelength], and the matrix from channels to coefficients.

    Vectors of a material are found anew, between the nodes too: there may be peaks there.
    """
    synthesis = np.asarray(basis.synthesis, np.float64)
    if basis.stores_vectors:
        rows = [np.sqrt(b.weight)[..., None] * transform(b.brdf, basis) for b in half.blocks]
        vectors = spectral_vectors(np.concatenate([row.reshape(-1, synthesis.shape[1]) for row in rows]))
        return vectors[: len(synthesis)], np.eye(len(synthesis))
    columns, triangle = np.linalg.qr(synthesis.T)
    return columns.T, np.linalg.inv(triangle).T


def _no_core(basis: SpectralBasis) -> np.ndarray:
    return np.zeros((1, 1, 1, np.shape(basis.synthesis)[0]))


def make_plan(target: Target, achieved: float, worst: float, half: HalfField) -> dict[str, Any]:
    """Say what was promised and what was measured; `worst`: the worst incident angle's error, or Delta E if asked."""
    met = is_met(target, achieved)
    warnings = []
    if not met:
        warnings.append(f"compact: the target, {target.text}, is not met: {in_words(target, achieved)} is the best")
    if target.is_size and worst > USELESS:
        says = f"compact: so few numbers leave an error of {100 * worst:.3g} % at the worst incident angle"
        warnings.append(f"{says}; represent.target: {{error: 0.02}} would take what it needs")
    for stop in target.stops:
        if target.is_size and stop.kind == "error" and not is_met(stop, worst):
            warnings.append(f"compact: scene.error_budget, {stop.text}, is not met: {in_words(stop, worst)} is reached")
    if half.asymmetry > ASYMMETRIC:
        share = f"{100 * half.asymmetry:.2g} %"
        warnings.append(f"compact: {share} of the field is not symmetric to the plane of incidence and was dropped")
    return {
        "promised": target.text,
        "measured": in_words(target, achieved),
        "is_met": int(met),
        "worst": worst,
        "warnings": warnings,
    }
