"""The compact form `lobe_harmonics`: even harmonics and one or two lobes of named shapes at every incident angle.

Background and lobes are fitted jointly; a lobe's kind is the same at all incident angles, its
width and peak are each incident angle's own, its height each coefficient's. Degrees, lobes and
coefficients are taken by the error that each stored number takes away.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sbrdf_jax import colour
from sbrdf_jax.angles import SAME_ANGLE
from sbrdf_jax.encoding import decode, vector_basis
from sbrdf_jax.options import ErrorBudget, RepresentOptions, TargetOptions
from sbrdf_jax.records import GriddedBRDF, LobeHarmonics, LobeTensor, SpectralField, Status
from sbrdf_jax.representation.allocation import Choice, angle_choices, make_ladder, spend
from sbrdf_jax.representation.half_field import HalfField, half_field
from sbrdf_jax.representation.joint_fit import (
    NUM_LOBES,
    AngleProblem,
    Lobes,
    heights_and_errors,
    inner_products,
    make_problem,
    search_bank,
    shapes_of,
)
from sbrdf_jax.representation.joint_polish import polish_lobes
from sbrdf_jax.representation.lobe_family import FIRST_HALF_SHAPE, SHAPES, width_limits
from sbrdf_jax.representation.lobe_harmonics_value import even_orders
from sbrdf_jax.representation.lobe_tensor import channels_of, make_plan
from sbrdf_jax.representation.target import Target, azimuth_twins, is_met, make_target, measured

DEFAULT_MAX_DEGREE = 8
SEARCH_DEGREES = (4, 8)  # of the background while lobes are sought, up to the highest allowed
SEARCH_CHANNELS = 6  # the first ones decide where the lobes are
CLAMPED = 1 + 1e-6  # of the least width


class Solution(NamedTuple):
    """What is stored of every fitted incident angle."""

    lobes: Lobes  # [i, lobe]
    degree: Int[np.ndarray, "i channel"]
    height: Float[np.ndarray, "i lobe channel"]
    background: Float[np.ndarray, "i channel harmonic"]


def stored_numbers(compact: LobeHarmonics) -> int:
    """Count all numbers that the `compact` group of a result holds, its axes and statuses included."""
    stores_vectors, num_wavelengths = compact.basis.stores_vectors, np.size(compact.basis.wavelength_nm)
    fixed = _fixed_numbers(np.size(compact.theta_i), np.asarray(compact.degree), num_wavelengths, stores_vectors)
    return fixed + sum(int(mask.sum()) for mask in stored_harmonics(compact))


def stored_harmonics(
    compact: LobeHarmonics,
) -> tuple[Bool[np.ndarray, "fitted coefficient harmonic"], Bool[np.ndarray, "fitted lobe coefficient"]]:
    """Return masks of the harmonics and the heights that are stored; the others are 0.

    At normal incidence only harmonics that do not depend on phi_o are stored.
    """
    degree, kind = np.asarray(compact.degree), np.asarray(compact.lobe_kind)
    sh_degree, sh_order = np.array(even_orders(compact.max_degree)).T
    at_normal = np.asarray(compact.fitted_theta_i)[:, None] < SAME_ANGLE
    harmonics = (sh_degree <= degree[..., None]) & ~(at_normal & (sh_order > 0))[:, None]
    return harmonics, (kind != 0)[..., None] & (degree >= 0)[:, None]


def _fixed_numbers(num_theta_i, degree, num_wavelengths, stores_vectors):
    """Count axes, statuses, degrees, kinds, widths, peaks and spectral vectors."""
    fitted, count = degree.shape
    vectors = count * num_wavelengths if stores_vectors else 0
    return 2 * num_theta_i + num_wavelengths + NUM_LOBES + fitted * (1 + 3 * NUM_LOBES) + degree.size + count + vectors


def least_numbers(tensor: LobeTensor) -> int:
    """Count what one lobe and a constant at every incident angle that counts takes, beside a lobe tensor of a field."""
    is_data, coefficients = tensor.basis.stores_vectors, len(tensor.basis.synthesis)
    fitted, count = int(np.sum(np.asarray(tensor.status) == int(Status.OK))), 1 if is_data else coefficients
    num_theta_i, num_wavelengths = np.size(tensor.theta_i), np.size(tensor.basis.wavelength_nm)
    fixed = _fixed_numbers(num_theta_i, np.zeros((fitted, count)), num_wavelengths, is_data)
    return fixed + 2 * fitted * count


def represent(
    field: SpectralField,
    options: RepresentOptions,
    gridded: GriddedBRDF | None = None,
    matching: colour.ColourMatching | None = None,
    budget: ErrorBudget | None = None,
) -> tuple[LobeHarmonics, dict[str, Any]]:
    """Return harmonics and lobes that meet the target with few numbers, or the best that there is.

    Args:
        field: Coefficients at the nodes; phi_o from 0 to 2 pi inclusive. In basis "data" the
            vectors are taken in order, as many as pay; of another basis all coefficients are,
            with one degree for all of an incident angle.
        options: `target`, and `max_degree` as a limit.
        gridded: As for `lobe_tensor`.
        matching: As for `lobe_tensor`.
        budget: An error that is enough: where it takes fewer numbers than the target allows, it is the target.

    Returns:
        The compact form, and a plan: kinds, what was promised and what was measured, `warnings`.

    Numerics:
        As for `lobe_tensor`: the clip at 0 comes last, and what is odd in phi_o is dropped.
    """
    target = make_target(options.target, np.size(field.theta_i), np.size(field.basis.wavelength_nm), budget)
    if budget is not None and target.is_size:
        enough = TargetOptions(**vars(budget))
        small = represent(field, dataclasses.replace(options, target=enough), gridded, matching)
        if small[1]["is_met"] and stored_numbers(small[0]) <= target.budget:
            return small
    theta_i, theta_o = np.asarray(field.theta_i, np.float64), np.asarray(field.theta_o, np.float64)
    brdf = np.asarray(
        decode(np.asarray(field.coefficient, np.float64), field.basis) if gridded is None else gridded.brdf
    )
    half = half_field(field, brdf, gridded, in_colour=target.in_colour)
    max_degree = DEFAULT_MAX_DEGREE if options.max_degree == "auto" else options.max_degree
    status = np.where(np.isfinite(brdf).all(axis=(1, 2, 3)), int(Status.SKIPPED), int(Status.NONFINITE))
    status = np.where(half.known, int(Status.OK), status)
    if half.known.any():
        fitted, limits = theta_i[half.known], width_limits(float(np.diff(theta_o).min()))
        solution, achieved, worst = _fit(field, half, target, max_degree, limits, matching)
        status[half.known] = _statuses(solution, limits)
    else:  # zero or nothing everywhere
        fitted, achieved, worst = theta_i[:1], 0.0, 0.0
        solution = _nothing(np.shape(field.coefficient)[3], len(even_orders(max_degree)))
    to_coefficient = channels_of(field.basis, half)[1] if half.blocks else np.eye(solution.degree.shape[1])
    used = solution.degree.shape[1]
    basis = field.basis
    if basis.stores_vectors:
        vectors = channels_of(field.basis, half)[0] if half.blocks else np.asarray(basis.synthesis)
        basis = vector_basis(basis.wavelength_nm, vectors[:used])
    to_coefficient = to_coefficient[:used, :used]
    compact = LobeHarmonics(
        theta_i,
        fitted,
        basis,
        solution.degree,
        np.einsum("ich,cd->idh", solution.background, to_coefficient),
        solution.lobes.kind,
        solution.lobes.width,
        solution.lobes.peak_theta_o,
        solution.height @ to_coefficient,
        status,
        max_degree=max_degree,
        interpolate_theta_i=field.interpolate_theta_i,
    )
    plan = {"method": "lobe_harmonics", "lobe_kinds": [SHAPES[k] for k in solution.lobes.kind.max(axis=0)]}
    return compact, plan | make_plan(target, achieved, worst, half)


def _fit(
    field: SpectralField, half: HalfField, target: Target, max_degree: int, limits, matching
) -> tuple[Solution, float, float]:
    """Return what is stored, what was measured of the target, and the worst incident angle's error or Delta E."""
    fit = _AngleFits(field, half, target, max_degree, limits, matching)
    best = None
    counts = range(1, fit.num_channels + 1) if fit.stores_vectors else [fit.num_channels]
    for count in counts:
        found = fit.allocate(count)
        if best is None or found[0] < best[0]:
            best = found
    assert best is not None
    return fit.finish(best[1], best[2])


class _AngleFits:
    """All incident angles, the sets of lobes that each may have, and what each set with each degree leaves."""

    def __init__(self, field, half, target, max_degree, limits, matching):
        self.target, self.limits = target, limits
        self.stores_vectors = field.basis.stores_vectors
        self.vectors = channels_of(field.basis, half)[0]
        self.num_channels = len(self.vectors)
        self.num_theta_i, self.num_wavelengths = len(np.asarray(field.theta_i)), self.vectors.shape[1]
        nodes = half.nodes
        counts = np.isin(nodes.theta_i, np.asarray(field.theta_i)[half.known])
        self.brdf = nodes.brdf[counts]
        self.twins = azimuth_twins(nodes.phi_o)
        self.problem = _problem(half, counts, self.vectors, max_degree)
        self.matching = matching
        if target.in_colour and matching is None:
            self.matching = colour.colour_matching(np.asarray(field.basis.wavelength_nm))
        self.lobes = self._search(nodes, counts, max_degree)  # [set, i, lobe]
        self._measure()

    def _search(self, nodes, counts, max_degree) -> Lobes:
        """Return the sets of lobes of each incident angle: the bank's best by number and degree, refined."""
        problem = self.problem
        few = problem._replace(value=problem.value[..., :SEARCH_CHANNELS])
        degrees = tuple(degree for degree in SEARCH_DEGREES if degree <= max_degree) or (max_degree,)
        peak = mirror_peaks(nodes.brdf[counts].mean(axis=-1), nodes.theta_i[counts], nodes.theta_o)
        in_bank = search_bank(few, peak, self.limits, degrees).lobes  # [choice, degree, i, lobe]
        refined = Lobes(*(np.concatenate(list(part)) for part in in_bank))
        degree = np.tile(degrees, len(in_bank.kind))
        refined = self._polish(few, refined, degree)
        # a neighbour's lobes, moved with the mirror direction: where an incident angle went astray, and for even tracks
        pairs = [Lobes(*(part[k] for part in refined)) for k in range(len(degrees))]
        beside = [_of_neighbour(pair, nodes.theta_i[counts], step) for pair in pairs for step in (-1, 1)]
        beside = Lobes(*(np.stack(parts) for parts in zip(*beside, strict=True)))
        beside = self._polish(few, beside, np.repeat(degrees, 2))
        none = Lobes(np.zeros((1, *refined.kind.shape[1:]), int), *np.ones((2, 1, *refined.kind.shape[1:])))
        return Lobes(*(np.concatenate(parts) for parts in zip(none, refined, beside, strict=True)))

    def _polish(self, problem: AngleProblem, lobes: Lobes, degree: np.ndarray) -> Lobes:
        """Refine sets of lobes [set, i, lobe], each with its degree of the background."""
        sets, num_i, _ = lobes.kind.shape
        flat = Lobes(*(part.reshape(-1, NUM_LOBES) for part in lobes))
        of_lane = np.broadcast_to(np.repeat(degree, num_i)[:, None], (sets * num_i, problem.value.shape[2]))
        refined = polish_lobes(problem, np.tile(np.arange(num_i), sets), flat, of_lane, self.limits)
        return Lobes(*(part.reshape(sets, num_i, NUM_LOBES) for part in refined))

    def _measure(self):
        """Find what every set of lobes leaves and costs by degree; errors relative to the incident angle's energy."""
        problem = self.problem
        sets, num_i, _ = self.lobes.kind.shape
        flat = Lobes(*(part.reshape(-1, NUM_LOBES) for part in self.lobes))
        lane_i = np.tile(np.arange(num_i), sets)
        shapes = shapes_of(problem, lane_i, flat)
        self.shapes = shapes.reshape(sets, num_i, *shapes.shape[1:])
        inner = [inner_products(problem, i, shape) for i, shape in zip(lane_i.tolist(), shapes, strict=True)]
        stacked = type(inner[0])(*(np.stack(parts) for parts in zip(*inner, strict=True)))
        error = heights_and_errors(stacked)[1].reshape(sets, num_i, -1, self.num_channels)
        error[:, :, 0] = stacked.energy[:, 0].reshape(sets, num_i, -1)  # degree -1: not even heights
        energy = stacked.energy[:num_i, 0].sum(axis=1)
        number = (self.lobes.kind > 0).sum(axis=2)
        cost = problem.count[None] + number[..., None]
        cost = np.concatenate([np.zeros((sets, num_i, 1), int), cost], axis=2)
        same = not self.stores_vectors
        self.ladders = [
            [make_ladder(error[number, i] / energy[i], cost[number, i], same_degree=same) for number in range(sets)]
            for i in range(num_i)
        ]

    def allocate(self, num_channels: int) -> tuple[tuple, list[Choice], int]:
        """Return how good the best choices with so many channels are (less is better), and those choices."""
        shape = np.zeros((len(self.brdf), num_channels))
        fixed = _fixed_numbers(self.num_theta_i, shape, self.num_wavelengths, self.stores_vectors)
        choices = [
            [choice._replace(degree=self._all(choice.degree)) for choice in angle_choices(own, 1.0, num_channels)]
            for own in self.ladders
        ]
        if self.target.is_size:
            taken = spend(choices, self.target.budget - fixed)
            chosen = [own[k] for own, k in zip(choices, taken, strict=True)]
            numbers = fixed + sum(choice.numbers for choice in chosen)
            return (numbers > self.target.budget, sum(choice.error**0.5 for choice in chosen)), chosen, num_channels
        chosen = [self._smallest(i, own) for i, own in enumerate(choices)]
        missed = max(0.0, *(self._reached(i, choice) - self.target.value for i, choice in enumerate(chosen)))
        numbers = fixed + sum(choice.numbers for choice in chosen)
        return (missed, numbers), chosen, num_channels

    def _all(self, degree: np.ndarray) -> np.ndarray:
        """Return degrees of all channels from those that a choice is about."""
        if not self.stores_vectors:
            return np.full(self.num_channels, degree[0])
        return np.concatenate([degree, np.full(self.num_channels - len(degree), -1)])

    def _smallest(self, i: int, choices: list[Choice]) -> Choice:
        """Return the smallest choice of an incident angle that meets an error or a colour difference, by bisection."""
        low, high = 0, len(choices) - 1
        while low < high:
            middle = (low + high) // 2
            if is_met(self.target, self._reached(i, choices[middle])):
                high = middle
            else:
                low = middle + 1
        return choices[low]

    def _reached(self, i: int, choice: Choice) -> float:
        return self._measured(i, *self._solve(i, self.shapes[choice.lobes, i], choice.degree))

    def _solve(self, i: int, shape: np.ndarray, degree: np.ndarray):
        """Return heights [lobe, channel], coefficients of the orthonormal functions [function, channel], shapes."""
        height = heights_and_errors(inner_products(self.problem, i, shape))[0]
        height = np.where(degree >= 0, height[degree + 1, :, np.arange(len(degree))].T, 0.0)
        uses = self.problem.degree_of[:, None] <= degree
        functions = self.problem.functions[i, : len(shape)]
        return height, np.where(uses, functions.T @ (self.problem.value[i] - shape @ height), 0.0), shape

    def _measured(self, i: int, height, smooth, shape) -> float:
        """Return what stands beside the promise at the nodes of one incident angle: eta where it is a size."""
        nodes, functions = self.brdf[i], self.problem.functions[i]
        count = nodes[..., 0].size
        channel = functions[:count] @ smooth + shape[:count] @ height
        value = np.maximum(channel / self.problem.root_weight[i, :count, None] @ self.vectors, 0.0)
        target = self.target if self.target.kind == "delta_e" else self.target._replace(kind="error")
        found = value.reshape(1, *nodes.shape)
        return measured(target, 0, found, nodes[None], self.twins, np.ones(1, bool), self.matching)

    def finish(self, chosen: list[Choice], num_channels: int) -> tuple[Solution, float, float]:
        """Refine the chosen lobes with the chosen degrees, keep what is better, and solve for everything."""
        i = np.arange(len(chosen))
        degree = np.stack([choice.degree for choice in chosen])
        lobes = Lobes(*(part[[choice.lobes for choice in chosen], i] for part in self.lobes))
        refined = polish_lobes(self.problem, i, lobes, degree, self.limits)
        shapes = self.shapes[[choice.lobes for choice in chosen], i], shapes_of(self.problem, i, refined)
        heights, backgrounds, reached = [], [], []
        for k in range(len(chosen)):
            trials = []
            for number, shape in enumerate(shapes):
                solved = self._solve(k, shape[k], degree[k])
                trials.append((self._measured(k, *solved), number, solved))
            value, number, (height, smooth, _) = min(trials, key=lambda trial: trial[:2])
            if number == 0:
                for part, whole in zip(lobes, refined, strict=True):
                    whole[k] = part[k]
            heights.append(height)
            backgrounds.append(np.linalg.solve(self.problem.triangle[k], smooth).T)
            reached.append(value)
        used = num_channels if self.stores_vectors else self.num_channels
        solution = Solution(refined, degree[:, :used], np.stack(heights)[..., :used], np.stack(backgrounds)[:, :used])
        if not self.target.is_size:
            return solution, max(reached), max(reached)
        fixed = _fixed_numbers(self.num_theta_i, solution.degree, self.num_wavelengths, self.stores_vectors)
        stored = fixed + sum(choice.numbers for choice in chosen)
        known = np.ones(len(self.brdf), bool)
        achieved = measured(self.target, stored, self.brdf, self.brdf, self.twins, known, None)
        return solution, achieved, max(reached)


def _of_neighbour(lobes: Lobes, theta_i: np.ndarray, step: int) -> Lobes:
    """Return at each incident angle the lobes of the one before or behind, moved with the mirror direction."""
    place = np.clip(np.arange(len(theta_i)) + step, 0, len(theta_i) - 1)
    off_mirror = (lobes.peak_theta_o - theta_i[:, None])[place]
    peak = np.where(theta_i[:, None] < SAME_ANGLE, 0.0, theta_i[:, None] + off_mirror)
    return Lobes(lobes.kind[place], lobes.width[place], peak)


def mirror_peaks(value: Float[np.ndarray, "i o p"], theta_i: np.ndarray, theta_o: np.ndarray) -> np.ndarray:
    """Return where lobes of each kind but "none" start to point [i, kind], rad.

    The paper's kinds: the vertex of a parabola through the logarithms of the three nodes round the
    highest one at the mirror azimuth, which bounds it. Those of the half vector: the mirror direction.
    """
    curve = np.log(np.maximum(value[:, :, -1], 1e-300))
    top = np.clip(curve.argmax(axis=1), 1, len(theta_o) - 2)
    before, at, behind = (curve[np.arange(len(top)), top + step] for step in (-1, 0, 1))
    bend = before - 2 * at + behind
    share = np.clip(np.where(bend < 0, (before - behind) / np.where(bend < 0, 2 * bend, 1.0), 0.0), -1.0, 1.0)
    peak = np.where(theta_i < SAME_ANGLE, 0.0, theta_o[top] + share * np.diff(theta_o).min())
    number = len(SHAPES) - FIRST_HALF_SHAPE
    return np.stack([peak] * (FIRST_HALF_SHAPE - 1) + [theta_i] * number, axis=1)


def _problem(half: HalfField, counts, vectors, max_degree) -> AngleProblem:
    """Return the problem of the nodes, then of the midpoints of theta_o and phi_o."""
    parts = []
    for block in half.blocks[:2]:
        mesh = np.meshgrid(block.theta_o, block.phi_o, indexing="ij")
        size = mesh[0].size
        value = (block.brdf[counts] @ vectors.T).reshape(counts.sum(), size, -1)
        parts.append((mesh[0].ravel(), mesh[1].ravel(), block.weight[counts].reshape(-1, size), value))
    theta_o, phi_o = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    weight, value = (np.concatenate([part[k] for part in parts], axis=1) for k in (2, 3))
    return make_problem(half.nodes.theta_i[counts], theta_o, phi_o, weight, value, max_degree)


def _statuses(solution: Solution, limits) -> np.ndarray:
    """CLAMPED where a lobe is as narrow as the grid allows, NO_LOBE where none is stored, else OK."""
    kind, width = solution.lobes.kind, solution.lobes.width
    clamped = ((kind > 0) & (width <= CLAMPED * limits[kind, 0])).any(axis=1)
    without = (kind == 0).all(axis=1)
    return np.where(clamped, int(Status.CLAMPED), np.where(without, int(Status.NO_LOBE), int(Status.OK)))


def _nothing(num_channels: int, num_harmonics: int) -> Solution:
    lobes = Lobes(np.zeros((1, NUM_LOBES), int), *np.ones((2, 1, NUM_LOBES)))
    degree = np.full((1, num_channels), -1)
    return Solution(lobes, degree, np.zeros((1, NUM_LOBES, num_channels)), np.zeros((1, num_channels, num_harmonics)))
