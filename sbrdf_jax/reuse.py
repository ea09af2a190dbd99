"""What an earlier result holds that a run need not compute again: keyed by its source and the options that matter."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from sbrdf_jax.config import parse_config
from sbrdf_jax.errors import UserError
from sbrdf_jax.folds import K_FOLD, Folds
from sbrdf_jax.grid import Grid
from sbrdf_jax.needs import Needs
from sbrdf_jax.options import OutputOptions, RunOptions, RuntimeOptions
from sbrdf_jax.records import GriddedBRDF, RawSamples, Status
from sbrdf_jax.resampling.guided.lanes import take_field
from sbrdf_jax.resampling.guided.reading import known_rows
from sbrdf_jax.runtime import versions
from sbrdf_jax.store import RunResult, load


class Earlier(NamedTuple):
    """An earlier result of the same source, code and options of its grid."""

    result: RunResult
    is_whole: bool  # the other options are the same too, but for where and how it is written


def read_earlier(
    path: str, raw: RawSamples, options: RunOptions, needs: Needs, folds: Mapping[str, Folds]
) -> Earlier | None:
    """Read the result that `runtime.resume_from` names; None where nothing of it can be used.

    Args:
        path: The result.
        raw: The measurement of this run.
        options: Its options.
        needs: What its scene needs: the files that a scene names may have changed.
        folds: Its folds by scheme, whose file may have changed too.

    Raises:
        UserError: There is no such result, or it cannot be read.
    """
    try:
        result = load(path)
        made_with = parse_config(result.config, name=path)
    except UserError as error:
        raise UserError(f"runtime.resume_from: {error}") from None
    ours, theirs = versions(), result.versions
    same_code = all(ours[name] == theirs.get(name) for name in ("sbrdf-jax", "jax", "numpy"))
    same_source = result.source_sha256 == raw.source_sha256 != ""
    if not (same_code and same_source and _of_grid(made_with) == _of_grid(options)):
        return None
    same_answer = _of_answer(made_with) == _of_answer(options)
    return Earlier(result, same_answer and _has_same_files(result, needs, folds))


def _of_grid(options: RunOptions) -> tuple[Any, ...]:
    """Options that decide the grid stage; where a field of its own is read off, not the nodes'."""
    steps = options.grid if options.resample.method == "paper" else options.grid.reciprocal
    return dataclasses.replace(options.input, path="-"), steps, options.resample


def _of_answer(options: RunOptions) -> RunOptions:
    """Options that decide the answer."""
    without_path = dataclasses.replace(options.input, path="-")
    return dataclasses.replace(options, input=without_path, output=OutputOptions(), runtime=RuntimeOptions())


def _has_same_files(result: RunResult, needs: Needs, folds: Mapping[str, Folds]) -> bool:
    """Whether the files that a config names, a mask's, directions' or folds', said the same when it was made."""
    scene = result.plan.get("scene", {})
    wanted = {"node_needed": needs.node, "wavelength_needed": needs.wavelength}
    if not all(name in scene and np.array_equal(scene[name] > 0, mask) for name, mask in wanted.items()):
        return False
    given = folds.get(K_FOLD)
    return given is None or np.array_equal(result.validation.get("fold", ()), given.label)


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
