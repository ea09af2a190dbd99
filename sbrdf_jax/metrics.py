"""How well each stage stands for the one before it, and for physics: eq. (18) and its companions.

Everything is measured through `evaluation`, as a user would see it, one incident angle at a
time, so that memory stays that of one slice of the grid.
"""

import dataclasses
import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from sbrdf_jax import colour
from sbrdf_jax.angles import angle_between, fold_azimuth
from sbrdf_jax.encoding import decode, restore, transform
from sbrdf_jax.evaluation import evaluate_in_chunks, evaluate_where, measured_wavelengths
from sbrdf_jax.grid import midpoints
from sbrdf_jax.needs import restrict_theta_i
from sbrdf_jax.records import CompactBRDF, GriddedBRDF, LobeHarmonics, LobeTensor, SpectralBasis, SpectralField
from sbrdf_jax.representation import lobe_harmonics, lobe_tensor
from sbrdf_jax.representation.half_field import HalfField, beside_mirror, cells_between, near_mirror
from sbrdf_jax.representation.paper import compact_coefficient
from sbrdf_jax.representation.target import PAPER_DIRECTIONS
from sbrdf_jax.schema import BEYOND

NUM_RANDOM_DIRECTIONS, RANDOM_PER_THETA_I = 4096, 512
MOST_NUMBERS = 1 << 23  # of the incident angles that are evaluated together
CHUNK_SIZE = 1024  # one shape for all compact evaluations here: they compile once
ALBEDO_THETA, ALBEDO_PHI = 48, 96  # fewest quadrature points; two a node on finer grids

# How the result file labels the scores: arrays run over theta_i and numbers have no unit, but for these.
METRIC_AXES = {
    "albedo": ("theta_i", "wavelength"),
    "albedo_compact": ("theta_i", "wavelength"),
    "relative_error_between_theta_i": ("theta_i_between",),
}
METRIC_UNITS = {"negative_depth": "1/sr", "negative_depth_grid": "1/sr", "stored_bytes": "byte"}


@dataclasses.dataclass(frozen=True)
class Metrics:
    """Scores by the names that the result file gives them, and what a user must be told."""

    value: dict[str, np.ndarray]
    warnings: tuple[str, ...]


def measure(
    gridded: GriddedBRDF,
    field: SpectralField | None = None,
    compact: CompactBRDF | LobeHarmonics | LobeTensor | None = None,
    *,
    absolute: bool = True,
    matching: colour.ColourMatching | None = None,
    half: HalfField | None = None,
    seed: int = 0,
) -> Metrics:
    """Measure the grid, and the compact form against it.

    Args:
        gridded: The resampled field.
        field: Its spectral coefficients, for the split of the error.
        compact: Its compact form, of the wavelengths that are finite; without it only the grid is measured.
        absolute: False where values are only proportional to a BRDF: albedo then warns of nothing.
        matching: Colours of the grid's wavelengths, where they are not those of all that was measured.
        half: What the compact form was fitted to, where it holds the grid stage between the nodes.
        seed: Of the random directions.

    Returns:
        The scores of the grid and, where given, of the compact form, over the nodes that are needed; albedos are
        nan where some of the hemisphere is not.
    """
    value, warnings = measure_grid(gridded, absolute=absolute, seed=seed)
    if compact is not None:
        value |= error_between(compact, gridded, half) | compression(compact)
        live = live_wavelengths(gridded)
        if matching is None:
            matching = colour.colour_matching(np.asarray(gridded.wavelength_nm)[live])
        else:
            matching = dataclasses.replace(matching, weight=matching.weight[live])
        value |= error_at_nodes(compact, gridded, matching)
        if matching.note:
            warnings.append(f"colour: {matching.note}")
        rows = np.isin(np.asarray(gridded.theta_i), np.asarray(compact.theta_i))
        needed, whole = needed_nodes(gridded)[rows], whole_hemispheres(gridded)[rows]
        if field is not None:
            split = error_split(compact, *restrict_theta_i(field, gridded, np.asarray(compact.theta_i)))
            value |= {name: on_rows(part, rows) for name, part in split.items()}
        share, depth, reciprocity = off_node_scores(compact, seed=seed, needed=needed)
        value |= {"negative_share": share, "negative_depth": depth, "reciprocity_error_compact": reciprocity}
        of_compact = albedo(compact, whole)
        value["albedo_compact"] = np.full(value["albedo"].shape, np.nan)
        value["albedo_compact"][np.ix_(rows, live)] = of_compact
        if absolute:
            warnings += albedo_warnings(of_compact, compact, "compact")
    return Metrics({name: np.asarray(v) for name, v in value.items()}, tuple(warnings))


def on_rows(part: np.ndarray, rows: Bool[np.ndarray, " theta_i"]) -> np.ndarray:
    """Put values of some incident angles among all, nan at the others."""
    every = np.full(len(rows), np.nan)
    every[rows] = part
    return every


def measure_grid(gridded: GriddedBRDF, *, absolute: bool = True, seed: int = 0) -> tuple[dict, list[str]]:
    """Albedo, negative values and reciprocity of the grid stage, the share of nodes without data, and warnings."""
    share, depth, reciprocity = off_node_scores(gridded, seed=seed, needed=needed_nodes(gridded))
    value = {
        "albedo": albedo(gridded, whole_hemispheres(gridded)),
        "negative_share_grid": share,
        "negative_depth_grid": depth,
        "reciprocity_error": reciprocity,
        "extrapolated_share": (np.asarray(gridded.extrapolated) == BEYOND).mean(axis=(1, 2)),
    }
    return value, albedo_warnings(value["albedo"], gridded, "grid") if absolute else []


def relative_error(error_energy, energy):
    """Xu, eq. (18): sqrt(sum of squared differences / sum of squares); 0 where both sums are 0."""
    error_energy, energy = np.asarray(error_energy, float), np.asarray(energy, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((error_energy == 0) & (energy == 0), 0.0, np.sqrt(error_energy / energy))


def relative_deviation(reconstructed: np.ndarray, original: np.ndarray) -> np.ndarray:
    """|reconstructed - original| / |original|, value by value; 0 where both are equal, infinite where only one is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        deviation = np.abs(reconstructed - original) / np.abs(original)
    return np.where(reconstructed == original, 0.0, deviation)


def error_at_nodes(
    compact: CompactBRDF | LobeHarmonics | LobeTensor, gridded: GriddedBRDF, matching: colour.ColourMatching
) -> dict:
    """Compare compact form and grid at the grid's nodes: eq. (18), median relative error, Delta E 2000.

    All nodes that are needed count, copies at the poles and at 360 degrees included, as the paper
    counts; wavelengths count where the whole grid is finite, which are those of the compact form.
    """
    live, needed = live_wavelengths(gridded), needed_nodes(gridded)
    counts = needed.any(axis=(1, 2))
    error_energy, energy, deviation, delta_e = [], [], [], []
    axes = np.asarray(gridded.theta_i)[counts], gridded.theta_o, gridded.phi_o
    nodes = zip(np.asarray(gridded.brdf)[counts], needed[counts], strict=True)
    for (brdf, mask), reconstructed in zip(nodes, slices(compact, *axes, needed[counts]), strict=True):
        original = brdf[mask][:, live]
        error_energy.append(((reconstructed - original) ** 2).sum())
        energy.append((original**2).sum())
        deviation.append(relative_deviation(reconstructed, original).ravel())
        delta_e.append(colour.delta_e_2000(reconstructed, original, matching))
    overall = {
        "relative_error": relative_error(sum(error_energy), sum(energy)),
        "median_relative_error": np.median(np.concatenate(deviation)),
        **_delta_e_scores(np.concatenate(delta_e)),
    }
    scores = {name: np.full(len(counts), np.nan) for name in overall}
    scores["relative_error"][counts] = relative_error(error_energy, energy)
    for row, differences, deviations in zip(np.flatnonzero(counts), delta_e, deviation, strict=True):
        scores["median_relative_error"][row] = np.median(deviations)
        for name, value in _delta_e_scores(differences).items():
            scores[name][row] = value
    return scores | {f"{name}_overall": value for name, value in overall.items()}


def _delta_e_scores(difference: np.ndarray) -> dict:
    return {
        "delta_e_median": np.median(difference),
        "delta_e_p95": np.quantile(difference, 0.95),
        "delta_e_max": np.max(difference),
    }


def live_wavelengths(gridded: GriddedBRDF) -> np.ndarray:
    """Mask of the wavelengths finite at all nodes that are needed; the others are lanes that failed, and say so."""
    finite = np.isfinite(np.asarray(gridded.brdf))
    return np.all(finite, axis=(0, 1, 2)) if gridded.needed is None else np.all(finite[gridded.needed], axis=0)


def needed_nodes(gridded: GriddedBRDF) -> Bool[np.ndarray, "theta_i theta_o phi_o"]:
    """Mask of the nodes that were computed."""
    return np.ones(np.shape(gridded.brdf)[:3], bool) if gridded.needed is None else np.asarray(gridded.needed, bool)


def whole_hemispheres(gridded: GriddedBRDF) -> Bool[np.ndarray, " theta_i"]:
    """Mask of the incident angles whose every node was computed."""
    return needed_nodes(gridded).all(axis=(1, 2))


def error_between(
    compact: CompactBRDF | LobeHarmonics | LobeTensor, gridded: GriddedBRDF, half: HalfField | None = None
) -> dict:
    """Eq. (18) at cell midpoints of theta_o and phi_o, against the grid stage there; and with theta_i midway too.

    Where the grid stage is a field, close to the mirror direction as well: at theta_o of nodes and midpoints, up to two
    thirds of a step of phi_o off the plane of incidence. Midpoints count whose neighbours are all needed; it is nan
    where there are none, and midway between incident angles where the grid interpolates nothing over them. What
    `half` holds of the grid stage is not evaluated again.
    """
    theta_i, needed = np.asarray(gridded.theta_i), needed_nodes(gridded)
    theta_o, phi_o = midpoints(gridded.theta_o), midpoints(gridded.phi_o)
    live, cell = live_wavelengths(gridded), cells_between(needed)
    held = half.blocks if half is not None and half.is_field and live.all() else ()

    def grid_at(theta_i, theta_o, phi_o, cells):
        one_side = phi_o[phi_o <= np.pi]  # the field is even
        for block in held:
            if all(map(np.array_equal, (block.theta_i, block.theta_o, block.phi_o), (theta_i, theta_o, one_side))):
                twin = np.minimum(np.arange(len(phi_o)), np.arange(len(phi_o))[::-1])
                twin = twin if len(one_side) < len(phi_o) else np.arange(len(phi_o))
                return (value[:, twin][mask] for value, mask in zip(block.brdf, cells, strict=True) if mask.any())
        counts = cells.any(axis=(1, 2))
        return (value[:, live] for value in slices(gridded, theta_i[counts], theta_o, phi_o, cells[counts]))

    def at(theta_i, theta_o, phi_o, cells):
        errors, counts = np.full(len(cells), np.nan), cells.any(axis=(1, 2))
        wanted = grid_at(theta_i, theta_o, phi_o, cells)
        found = slices(compact, theta_i[counts], theta_o, phi_o, cells[counts])
        pairs = zip(wanted, found, strict=True)
        errors[counts] = [relative_error(((got - want) ** 2).sum(), (want**2).sum()) for want, got in pairs]
        return errors

    both = cell[:-1] & cell[1:] if gridded.interpolate_theta_i else np.zeros_like(cell[:-1])
    scores = {
        "relative_error_between": at(theta_i, theta_o, phi_o, cell),
        "relative_error_between_theta_i": at(midpoints(theta_i), theta_o, phi_o, both),
    }
    if gridded.field is not None:
        beside = beside_mirror(needed[:, :, : (len(phi_o) + 2) // 2])
        scores["relative_error_near_mirror"] = at(theta_i, *near_mirror(gridded.theta_o, gridded.phi_o), beside)
    return scores


def error_split(compact: CompactBRDF | LobeHarmonics | LobeTensor, field: SpectralField, gridded: GriddedBRDF) -> dict:
    """Split the error at the nodes into spectral truncation, background and lobe, each as an eta of eq. (18).

    Of other methods than the paper's only the first, by the spectra that it stores.
    Spectral: the grid against its own truncated spectra. The rest is the misfit of the
    coefficients, which belongs to the lobe within the lane's critical angle and to the
    background elsewhere, and everywhere in lanes without a lobe. Squares add up to that of
    the whole but for cross terms, which are small because the bases are nearly orthogonal.
    """
    live = live_wavelengths(gridded)
    if not isinstance(compact, CompactBRDF):
        brdf = np.where(needed_nodes(gridded)[..., None], np.asarray(gridded.brdf), 0.0)
        return {"error_spectral": truncation_error(compact.basis, brdf[..., live])}
    parts = {"error_spectral": [], "error_background": [], "error_lobe": []}
    for i in range(len(gridded.theta_i)):
        original = np.asarray(gridded.brdf[i])[..., live]
        energy = (original**2).sum()
        slice_parts = _slice_split(compact, field, jnp.asarray(original), i)
        for name, error in zip(parts, slice_parts, strict=True):
            parts[name].append(relative_error(float(error), energy))
    return {name: np.array(values) for name, values in parts.items()}


def truncation_error(
    basis: SpectralBasis, brdf: Float[np.ndarray, "theta_i theta_o phi_o wavelength"]
) -> Float[np.ndarray, " theta_i"]:
    """Eq. (18) of spectra against their best approximation in a basis, which least squares finds."""
    columns = np.linalg.qr(np.asarray(basis.synthesis, np.float64).T)[0]
    rest = brdf - restore(transform(brdf, basis) @ columns @ columns.T, basis)
    return relative_error((rest**2).sum(axis=(1, 2, 3)), (brdf**2).sum(axis=(1, 2, 3)))


@jax.jit
def _slice_split(compact, field, original, i):
    """Squared errors of one incident angle: spectral truncation, background, lobe."""
    theta_o, phi_o = jnp.meshgrid(jnp.asarray(field.theta_o), jnp.asarray(field.phi_o), indexing="ij")
    at_node = jax.vmap(jax.vmap(functools.partial(compact_coefficient, compact, i)))
    wanted = jnp.asarray(field.coefficient)[i]
    misfit = at_node(theta_o, phi_o) - wanted
    peak = jnp.full_like(theta_o, jnp.asarray(compact.lobe_peak_theta_o)[i])
    alpha = angle_between(theta_o, phi_o, peak, jnp.full_like(phi_o, jnp.pi))
    critical = jnp.asarray(compact.critical_angle)[i]  # nan compares false: no lobe, all background
    inside = alpha[..., None] <= critical[None, None, :]
    spectral = original - decode(wanted, field.basis)
    background = decode(jnp.where(inside, 0.0, misfit), field.basis)
    lobe = decode(jnp.where(inside, misfit, 0.0), field.basis)
    return tuple((part**2).sum() for part in (spectral, background, lobe))


def stored_numbers(compact: CompactBRDF | LobeHarmonics | LobeTensor) -> int:
    """Count all numbers that the `compact` group of a result holds, its axes included.

    The matrices of the spectral basis are not stored but for the vectors found in a material: they follow
    from kind, wavelengths and count.
    """
    if isinstance(compact, LobeTensor):
        return lobe_tensor.stored_numbers(compact)
    if isinstance(compact, LobeHarmonics):
        return lobe_harmonics.stored_numbers(compact)
    fields = ("theta_i", "background", "lobe_kind", "lobe_height", "lobe_width", "critical_angle", "lobe_peak_theta_o")
    held = sum(np.size(getattr(compact, name)) for name in (*fields, "status"))
    num_coefficients, num_harmonics = np.shape(compact.background)[1:]
    vectors = np.size(compact.basis.synthesis) if compact.basis.stores_vectors else 0
    return held + np.size(compact.basis.wavelength_nm) + num_coefficients + num_harmonics + vectors


def compression(compact: CompactBRDF | LobeHarmonics | LobeTensor) -> dict:
    """Numbers of the grid at the paper's 13 x 49 x wavelengths an incident angle over the numbers of the compact form.

    Only 13 x 49 - 60 of those directions are distinct, and half of them are mirror images.
    `compression_ratio` counts everything that is stored; `compression_ratio_paper` only
    harmonics, height and width, as the paper does, of its form alone.
    """
    grid = PAPER_DIRECTIONS * np.size(compact.basis.wavelength_nm)
    everything = {"compression_ratio": np.size(compact.theta_i) * grid / stored_numbers(compact)}
    if not isinstance(compact, CompactBRDF):
        return everything
    _, num_coefficients, num_harmonics = np.shape(compact.background)
    return everything | {"compression_ratio_paper": grid / ((num_harmonics + 2) * num_coefficients)}


def off_node_scores(
    result, *, seed: int = 0, needed: Bool[np.ndarray, "theta_i theta_o phi_o"] | None = None
) -> tuple[float, float, float]:
    """Share of negative values, depth of the deepest [1/sr, positive] and reciprocity error at random directions.

    The reciprocity error is the relative RMS difference of f(i, o) and f(o, i); exchanged
    directions have the azimuth -phi_o. Pairs beyond the incident angles of the result do not
    count; it is NaN where nothing is interpolated over theta_i, or where some nodes are not needed: then directions
    near those that are needed count.
    """
    theta_i, theta_o, phi_o = random_directions(result, seed)
    if needed is not None and not needed.all():
        near = _near_needed(np.asarray(result.theta_i), needed, theta_i, theta_o, phi_o)
        forward = evaluate_in_chunks(result, theta_i[near], theta_o[near], phi_o[near], chunk_size=CHUNK_SIZE)
        below = np.where(forward < 0, -forward, 0.0)
        return float((forward < 0).mean()) if near.any() else 0.0, float(below.max(initial=0.0)), float("nan")
    forward = evaluate_in_chunks(result, theta_i, theta_o, phi_o, chunk_size=CHUNK_SIZE)
    share, depth = float((forward < 0).mean()), float(np.where(forward < 0, -forward, 0.0).max())
    if not result.interpolate_theta_i:
        return share, depth, float("nan")
    backward = evaluate_in_chunks(result, theta_o, theta_i, -phi_o, chunk_size=CHUNK_SIZE)
    first, last = np.asarray(result.theta_i)[[0, -1]]
    known = (theta_o >= first) & (theta_o <= last)
    live = np.isfinite(forward) & np.isfinite(backward) & known[:, None]
    forward, backward = forward[live], backward[live]
    energy = (forward**2 + backward**2).sum() / 2
    return share, depth, float(relative_error(((forward - backward) ** 2).sum(), energy))


def _near_needed(nodes_i, needed, theta_i, theta_o, phi_o) -> Bool[np.ndarray, " direction"]:
    """Mask of the directions whose nearest node is needed."""
    _, num_o, num_phi = needed.shape
    row = np.argmin(np.abs(theta_i[:, None] - nodes_i), axis=1)
    place_o = np.rint(theta_o / (np.pi / 2) * (num_o - 1)).astype(int)
    return needed[row, place_o, np.rint(phi_o / (2 * np.pi) * (num_phi - 1)).astype(int)]


def random_directions(result, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Seeded random directions [rad]: theta_i even in angle (or on its nodes), exitance even over the hemisphere."""
    rng = np.random.default_rng(seed)
    nodes = np.asarray(result.theta_i)
    count = min(NUM_RANDOM_DIRECTIONS, RANDOM_PER_THETA_I * len(nodes))
    theta_i = rng.uniform(nodes[0], nodes[-1], count)
    if not result.interpolate_theta_i:
        theta_i = nodes[rng.integers(len(nodes), size=count)]
    theta_o = np.arccos(rng.uniform(0.0, 1.0, count))
    return theta_i, theta_o, rng.uniform(0.0, 2 * np.pi, count)


def albedo(result, whole: Bool[np.ndarray, " theta_i"] | None = None) -> Float[np.ndarray, "theta_i wavelength"]:
    """Directional-hemispherical reflectance at each incident angle of a result: the integral of f cos(theta_o).

    Gauss-Legendre in theta_o (48 points or two a node) times the midpoint rule in phi_o (96
    or two a node) of the evaluated field, so between its nodes too. Measured on the paper's
    grid filled with noise: right to 1e-5 under window "factor", to 1e-3 under the others,
    which have corners.
    """
    nodes_o, nodes_phi = np.size(getattr(result, "theta_o", ())), np.size(getattr(result, "phi_o", ()))
    num_theta, num_phi = max(ALBEDO_THETA, 2 * nodes_o), max(ALBEDO_PHI, 2 * (nodes_phi - 1))
    point, weight = np.polynomial.legendre.leggauss(num_theta)
    theta_o = (point + 1) * np.pi / 4
    weight = weight * np.pi / 4 * np.cos(theta_o) * np.sin(theta_o)
    step = 2 * np.pi / num_phi
    if _is_symmetric(result):  # one side of the plane of incidence stands for both
        num_phi, weight = num_phi // 2, 2 * weight
    phi_o = (np.arange(num_phi) + 0.5) * step
    nodes = np.asarray(result.theta_i)
    rows = np.full((len(nodes), np.size(measured_wavelengths(result))), np.nan)
    whole = np.ones(len(nodes), bool) if whole is None else whole
    every = np.ones((whole.sum(), num_theta, num_phi), bool)
    values = slices(result, nodes[whole], theta_o, phi_o, every)
    for i, value in zip(np.flatnonzero(whole), values, strict=True):
        rows[i] = weight @ value.reshape(num_theta, num_phi, -1).sum(axis=1)
    return rows * step


def albedo_warnings(albedo: np.ndarray, result, stage: str) -> list[str]:
    """One sentence for each incident angle at which a stage reflects more than it receives."""
    wavelength = np.asarray(measured_wavelengths(result))
    warnings = []
    for theta_i, row in zip(np.asarray(result.theta_i), albedo, strict=True):
        if (row > 1).any():
            warnings.append(
                f"{stage} stage, theta_i {np.rad2deg(theta_i):g} degrees: albedo up to {np.nanmax(row):.3g} "
                f"at {wavelength[np.nanargmax(row)]:g} nm, above 1 at {(row > 1).sum()} of {row.size} wavelengths: "
                "it creates energy"
            )
    return warnings


def on_axes(result, theta_i: float, theta_o, phi_o) -> Float[np.ndarray, "theta_o phi_o wavelength"]:
    """Evaluate one incident angle at every combination of theta_o and phi_o [rad]."""
    every = np.ones((1, np.size(theta_o), np.size(phi_o)), bool)
    return next(slices(result, [theta_i], theta_o, phi_o, every)).reshape(*every.shape[1:], -1)


def slices(
    result, theta_i, theta_o, phi_o, where: Bool[np.ndarray, "theta_i theta_o phi_o"]
) -> Iterator[Float[np.ndarray, "direction wavelength"]]:
    """Evaluate where a mask over three axes [rad] is true, incident angle by incident angle; mirror twins once."""
    theta_i, theta_o, phi_o = (np.asarray(a) for a in (theta_i, theta_o, phi_o))
    back = np.arange(len(phi_o))
    if _is_symmetric(result):
        _, first, back = np.unique(np.round(fold_azimuth(phi_o), 12), return_index=True, return_inverse=True)
        phi_o, back = phi_o[first], back.reshape(-1)
    distinct = np.stack([where[..., back == k].any(axis=-1) for k in range(len(phi_o))], axis=-1)
    step = max(1, MOST_NUMBERS // (len(theta_o) * len(phi_o) * np.size(measured_wavelengths(result))))
    for start in range(0, len(theta_i), step):
        part = distinct[start : start + step]
        value = evaluate_where(result, theta_i[start : start + step], theta_o, phi_o, part, chunk_size=CHUNK_SIZE)
        place = np.cumsum(part).reshape(part.shape) - 1  # of each direction that is evaluated, among them
        for each, mask in zip(place, where[start : start + step], strict=True):
            yield value[each[:, back][mask]]


def _is_symmetric(result) -> bool:
    """Whether a result is the same on both sides of the plane of incidence."""
    return isinstance(result, LobeHarmonics | LobeTensor) or bool(getattr(result, "bilateral", False))
