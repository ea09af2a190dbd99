"""What an earlier result holds that a run need not compute again: keyed by its source and the options that matter."""

import dataclasses
from typing import NamedTuple

import numpy as np

from sbrdf_jax.config import parse_config
from sbrdf_jax.errors import UserError
from sbrdf_jax.grid import Grid
from sbrdf_jax.needs import Needs
from sbrdf_jax.options import OutputOptions, RunOptions, RuntimeOptions
from sbrdf_jax.records import GriddedBRDF, RawSamples, Status
from sbrdf_jax.resampling.guided.lanes import take_field
from sbrdf_jax.resampling.guided.reading import known_rows
from sbrdf_jax.runtime import versions
from sbrdf_jax.store import RunResult, load


class Earlier(NamedTuple):
    """An earlier result, and the options that made it."""

    result: RunResult
    options: RunOptions


def read_earlier(path: str) -> Earlier:
    """Read the result that `runtime.resume_from` names.

    Raises:
        UserError: There is no such result, or it cannot be read.
    """
    try:
        result = load(path)
        return Earlier(result, parse_config(result.config, name=path))
    except UserError as error:
        raise UserError(f"runtime.resume_from: {error}") from None


def is_whole_answer(earlier: Earlier, raw: RawSamples, options: RunOptions) -> bool:
    """Whether nothing but where and how the result is written has changed."""

    def relevant(given: RunOptions) -> RunOptions:
        without_path = dataclasses.replace(given.input, path="-")
        return dataclasses.replace(given, input=without_path, output=OutputOptions(), runtime=RuntimeOptions())

    return _is_same_source(earlier, raw) and relevant(earlier.options) == relevant(options)


def usable_grid(earlier: Earlier, raw: RawSamples, options: RunOptions) -> GriddedBRDF | None:
    """Return the earlier grid stage where its source and the options of its method are those of this run."""

    def relevant(given: RunOptions):
        steps = given.grid if given.resample.method == "paper" else given.grid.reciprocal
        return dataclasses.replace(given.input, path="-"), steps, given.resample

    same = _is_same_source(earlier, raw) and relevant(earlier.options) == relevant(options)
    return earlier.result.gridded if same else None


def _is_same_source(earlier: Earlier, raw: RawSamples) -> bool:
    ours, theirs = versions(), earlier.result.versions
    same_code = all(ours.get(name) == theirs.get(name) for name in ("sbrdf_jax", "jax", "numpy"))
    return same_code and earlier.result.source_sha256 == raw.source_sha256 != ""


def part_of(known: GriddedBRDF, grid: Grid, needs: Needs, wavelength_nm: np.ndarray) -> GriddedBRDF | None:
    """Return what is needed of an earlier grid stage, or None where it lacks some of it.

    Args:
        known: The earlier grid stage, of the same method and options.
        grid: The whole grid.
        needs: What is needed of it.
        wavelength_nm: All measured wavelengths [nm].
    """
    rows = known_rows(known, grid)
    wanted, theta_i = wavelength_nm[needs.wavelength], needs.theta_i
    if rows is None or (rows[theta_i] < 0).any() or not np.isin(wanted, known.wavelength_nm).all():
        return None
    row, lane = rows[theta_i], np.searchsorted(known.wavelength_nm, wanted)
    if known.field is None and len(row) != len(known.theta_i):
        row = np.arange(len(known.theta_i))  # the nodes are the field: eq. (5) takes all
    node = needs.node[theta_i] if known.field is not None else np.ones(np.shape(known.brdf)[:3], bool)
    brdf = np.asarray(known.brdf)[row][..., lane]
    solved = np.asarray(known.status)[lane] == int(Status.OK)
    if not np.isfinite(brdf[node][:, solved]).all():
        return None
    parts = {name: np.asarray(getattr(known, name))[lane] for name in ("kkt_residual", "num_steps", "status")}
    error = known.standard_error
    if error is not None:
        parts["standard_error"] = np.where(node[..., None], np.asarray(error)[row][..., lane], np.nan)
    if known.residual_variance is not None:
        parts["residual_variance"] = np.where(node, np.asarray(known.residual_variance)[row], np.nan)
    if known.field is not None:
        parts["field"] = take_field(known.field, np.searchsorted(known.field.wavelength_nm, wanted))
    return dataclasses.replace(
        known,
        theta_i=np.asarray(known.theta_i)[row],
        extrapolated=np.asarray(known.extrapolated)[row],
        wavelength_nm=wanted,
        brdf=np.where(node[..., None], brdf, np.nan),
        needed=None if node.all() else node,
        **parts,
    )
