"""What the stages make of a hostile measurement: the answer of each, how good and how well posed it is."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sbrdf_jax.cleaning import clean
from sbrdf_jax.encoding import encode_field
from sbrdf_jax.evaluation import evaluate_in_chunks
from sbrdf_jax.grid import make_grid
from sbrdf_jax.nnls import scale_of
from sbrdf_jax.options import EncodeOptions, RepresentOptions, ResampleOptions
from sbrdf_jax.pipeline import finite_part, spectral_basis
from sbrdf_jax.records import GriddedBRDF, SpectralField
from sbrdf_jax.representation import represent
from sbrdf_jax.resampling import resample
from sbrdf_jax.resampling.guided.centres import PADDING_NOISE
from sbrdf_jax.resampling.guided.field import field_whitener
from sbrdf_jax.resampling.normal import normal_equations
from tests.stress.hostile import GRID, HIGHEST_DEG, HostileProblem, Method, directions

TOLERANCE = {"paper": 1e-8, "guided": 1e-6}
WEIGHT: dict[str, Any] = {"paper": 1.0, "guided": "data"}
ENCODE = {"paper": EncodeOptions("fourier", 19), "guided": EncodeOptions("data", 12)}
REPRESENT = {"paper": RepresentOptions("paper"), "guided": RepresentOptions("lobe_tensor")}


class Outcome(NamedTuple):
    """The answers of all stages."""

    gridded: GriddedBRDF
    field: SpectralField
    compact: Any


def solve(problem: HostileProblem, method: Method) -> Outcome:
    """Run cleaning, resampling, encoding and representation.

    Raises:
        UserError: Cleaning refuses the measurement.
    """
    cleaned = clean(problem.samples, bilateral=True, method=method)
    grid = make_grid(cleaned.samples, GRID, bilateral=True)
    gridded = resample(cleaned.samples, grid, options_of(problem, method))
    live = finite_part(gridded)
    field = encode_field(live, spectral_basis(live, ENCODE[method]))
    return Outcome(gridded, field, represent(field, REPRESENT[method], live))


def options_of(problem: HostileProblem, method: Method) -> ResampleOptions:
    """Options of the resampling of one problem."""
    weight = problem.smoothness_weight.get(method, WEIGHT[method])
    return ResampleOptions(method=method, smoothness_weight=weight, tolerance=TOLERANCE[method])


def forward_errors(problem: HostileProblem, gridded: GriddedBRDF) -> tuple[float, float]:
    """Eq. (18) of the worst wavelength and the median relative error, between the samples; nan without a truth."""
    if problem.truth is None:
        return float("nan"), float("nan")
    angles = directions(np.random.default_rng(5), (0.0, 15.0, 30.0, 45.0, 60.0), highest_deg=HIGHEST_DEG - 5)
    truth, found = problem.truth(*angles), evaluate_in_chunks(gridded, *angles)
    worst = np.max(np.linalg.norm(found - truth, axis=0) / np.linalg.norm(truth, axis=0))
    return float(worst), float(np.median(np.abs(found - truth) / truth))


def condition_number(problem: HostileProblem, method: Method, gridded: GriddedBRDF) -> float:
    """Of the matrix that all wavelengths share: the scaled A'A, or the guided method's prior plus noise."""
    if method == "guided":
        root = np.linalg.inv(np.asarray(field_whitener(gridded.field).lower))
        seen = np.asarray(gridded.field.noise).reshape(-1) < PADDING_NOISE
        return float(np.linalg.cond((root @ root.T)[np.ix_(seen, seen)]))
    samples = clean(problem.samples, bilateral=True, method=method).samples
    grid = make_grid(samples, GRID, bilateral=True)
    operator, rhs = normal_equations(samples, grid, float(options_of(problem, method).smoothness_weight))
    scale = np.asarray(scale_of(operator))
    matrix = np.asarray(jax.jit(operator.multiply)(jnp.eye(rhs.shape[0])))
    return float(np.linalg.cond(matrix / scale[:, None] / scale))
