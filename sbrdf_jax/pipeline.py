"""Strings the stages together: a measurement and options in, a result out; no files but that of folds."""

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np

from sbrdf_jax.cleaning import CleanResult
from sbrdf_jax.compact_layout import stored_bytes
from sbrdf_jax.encoding import coefficients_allowed, data_basis, encode_field, make_basis
from sbrdf_jax.folds import LEAVE_ONE_OUT, Folds, make_folds
from sbrdf_jax.grid import Grid, has_data, make_grid
from sbrdf_jax.host_blas import one_blas_thread
from sbrdf_jax.metrics import live_wavelengths, measure, needed_nodes, on_rows
from sbrdf_jax.needs import Needs, restrict_theta_i
from sbrdf_jax.options import VECTOR_KINDS, EncodeOptions, RunOptions
from sbrdf_jax.plan import PlanRow, describe_needs, plan_run, plan_validation, predict_cost
from sbrdf_jax.progress import Progress, StageClock
from sbrdf_jax.quadrature import Quadrature, choose_quadrature
from sbrdf_jax.records import STATUS_TEXT, GriddedBRDF, RawSamples, SpectralBasis, Status
from sbrdf_jax.representation import represent_with_plan
from sbrdf_jax.resampling import resample
from sbrdf_jax.resampling.guided import describe_fit
from sbrdf_jax.resampling.kept import Kept
from sbrdf_jax.reuse import Earlier, part_of, read_earlier
from sbrdf_jax.runtime import compile_clock
from sbrdf_jax.scene import find_needs, restrict_wavelengths
from sbrdf_jax.store import RunResult
from sbrdf_jax.summary import count_statuses
from sbrdf_jax.symmetry import contradiction
from sbrdf_jax.validation import validate

FAILED = (Status.MAX_STEPS, Status.NONFINITE)


@dataclasses.dataclass(frozen=True)
class Prepared:
    """What is known before anything is solved."""

    cleaned: CleanResult
    grid: Grid
    rows: list[PlanRow]
    warnings: tuple[str, ...]
    folds: Mapping[str, Folds]  # by scheme; empty where validation is off
    needs: Needs  # what the scene needs of the measurement and the grid
    cost: Mapping[str, tuple[float, float]]  # predicted seconds and MiB by stage
    quadrature: Quadrature | None = None  # where the scene needs colours alone
    earlier: Earlier | None = None  # a result whose parts may be reused


def prepare(raw: RawSamples, options: RunOptions, kept: Kept | None = None) -> Prepared:
    """Clean a measurement, lay out its grid and count the work.

    Args:
        raw: All rows of a file.
        options: Resolved options.
        kept: As for `process`.

    Returns:
        The cleaned samples, the grid, the plan, and what a user must be told.

    Raises:
        UserError: The measurement is not enough for a grid or for its validation, or the fold file is wrong.
    """
    cleaned = (kept or Kept()).cleaned(raw, options.input.bilateral, options.resample.method)
    grid = make_grid(cleaned.samples, options.grid, bilateral=cleaned.report.bilateral)
    needs, quadrature = find_needs(options, grid, raw.wavelength_nm), None
    if options.scene is not None and options.scene.colour is not None:
        place = np.flatnonzero(needs.wavelength)
        quadrature = choose_quadrature(raw.wavelength_nm[place], cleaned.samples.value[:, place], options.scene)
        needs = restrict_wavelengths(needs, np.isin(np.arange(len(needs.wavelength)), place[quadrature.index]))
    dead = np.isin(raw.wavelength_nm, cleaned.report.dead_wavelength_nm)
    num_live = int(np.sum(needs.wavelength & ~dead))
    allowed = coefficients_allowed(num_live, int(options.encode.coefficients), options.encode.basis)
    rows = plan_run(cleaned.samples, raw.num_samples, grid, allowed.coefficients, options, needs)
    folds = make_folds(raw, cleaned.report, options.validate, mirror_twins=options.input.bilateral is not False)
    rows += plan_validation(folds)
    cost = predict_cost(cleaned.samples, grid, options, needs)
    warnings = [f"not measured: {text}" for text in cleaned.report.coverage.missing]
    dark = needs.wavelength & ~dead & ~(cleaned.samples.value > 0).any(axis=0)
    if dark.any():
        names = ", ".join(f"{wavelength:g}" for wavelength in raw.wavelength_nm[dark])
        warnings.append(f"no positive value at {names} nm: what is fitted there is 0")
    difference = contradiction(cleaned.samples) if cleaned.report.bilateral else None
    if difference is not None:
        text = (
            f"the two sides of the plane of incidence differ by {100 * difference:.2g} % at the median and were folded"
        )
        warnings.append(f"{text}; method paper keeps them apart with input.bilateral: false")
    if allowed.warning:
        warnings.append(allowed.warning)
    resume_from, earlier = options.runtime.resume_from, None
    if resume_from is not None:
        earlier = read_earlier(resume_from, raw, options, needs, folds)
        if earlier is None:
            reason = "another source, other versions or other options of input, grid or resample"
            warnings.append(f"runtime.resume_from: {resume_from}: nothing of it is used: {reason}")
    return Prepared(cleaned, grid, rows, tuple(warnings), folds, needs, cost, quadrature, earlier)


def process(
    raw: RawSamples, ready: Prepared, options: RunOptions, progress: Progress, kept: Kept | None = None
) -> RunResult:
    """Run every stage on one measurement.

    Args:
        raw: All rows of a file.
        ready: What `prepare` made of it.
        options: Resolved options.
        progress: Told of each stage.
        kept: What the run before it may have worked out, and the next one may use.

    Returns:
        The result, but for what only its caller knows: config text, time of creation, versions.
    """
    if ready.earlier is not None and ready.earlier.is_whole:
        progress.say(f"{options.runtime.resume_from} holds all of this: nothing is computed")
        return dataclasses.replace(ready.earlier.result, timing={})
    timing: dict[str, dict[str, float]] = {}
    samples, report, needs = ready.cleaned.samples, ready.cleaned.report, ready.needs
    known = None if ready.earlier is None else ready.earlier.result.gridded
    with _timed(progress, timing, "resample"):
        gridded = None if known is None else part_of(known, ready.grid, needs, samples.wavelength_nm)
        if gridded is None:
            say, precision = progress.update, options.runtime.precision
            gridded = resample(samples, ready.grid, options.resample, say, kept, needs, known, precision)
        else:
            progress.update(f"taken from {options.runtime.resume_from}")
        if gridded.field is None and not needs.node.all():
            gridded = dataclasses.replace(gridded, needed=needs.node)
    notes = () if gridded.field is None else describe_fit(gridded.field)

    live = finite_part(gridded)
    with _timed(progress, timing, "encode"):
        basis = spectral_basis(live, options.encode)
        field = encode_field(live, basis)
        used = np.shape(field.coefficient)[-1]
        progress.update(f"{used} coefficients, basis {basis.kind}")

    matching = None if ready.quadrature is None else ready.quadrature.matching
    with _timed(progress, timing, "represent"):
        part, live = restrict_theta_i(field, live, ready.grid.theta_i[needs.theta_i])
        budget = None if options.scene is None else options.scene.error_budget
        compact, searched = represent_with_plan(part, options.represent, live, matching, budget)
        missed, rounding = tuple(searched.pop("warnings", ())), searched.pop("storage_error")
        half = searched.pop("half_field", None)
        progress.update(count_statuses(compact.status))

    with _timed(progress, timing, "measure"), one_blas_thread():
        metrics = measure(gridded, field, compact, absolute=raw.quantity == "brdf", matching=matching, half=half)
        metrics.value.update(storage_scores(compact, rounding, gridded))

    validation = {}
    if ready.folds:
        with _timed(progress, timing, "validate"):
            validation = validate(raw, ready.folds, ready.grid, options.resample, report, progress.update)
            progress.update(f"{sum(len(folds.labels) for folds in ready.folds.values())} fits")

    return RunResult(
        gridded=gridded,
        field=field,
        compact=compact,
        metrics=metrics.value,
        clean=report,
        input={
            "source": raw.source,
            "format": raw.source_format,
            "quantity": raw.quantity,
            "num_samples": raw.num_samples,
            "notes": list(raw.notes),
        },
        validation=validation,
        plan={
            "needed": {f"{row.stage} {row.what}": dataclasses.asdict(row) for row in ready.rows},
            "predicted": {name: {"seconds": pair[0], "mebibytes": pair[1]} for name, pair in ready.cost.items()},
            "represent": searched,
            "coefficients_used": used,
            "wavelengths_met_at_start": met_at_start(gridded),
            "spectral_components_kept": components_kept(gridded),
            "scene": describe_needs(needs, raw.wavelength_nm, gridded),
        },
        timing=timing,
        warnings=ready.warnings + notes + missed + metrics.warnings,
        source_sha256=raw.source_sha256,
        quadrature=ready.quadrature,
    )


def met_at_start(gridded: GriddedBRDF) -> int:
    """Count the wavelengths whose start was within the tolerance: they took no step."""
    return int(np.sum((np.asarray(gridded.num_steps) == 0) & (np.asarray(gridded.status) == int(Status.OK))))


def components_kept(gridded: GriddedBRDF) -> int:
    """Count the dimensions of the spectra that the resampling kept: method guided leaves out those that are noise."""
    if gridded.field is None:
        return len(gridded.wavelength_nm)
    measured = gridded.field.measured
    return np.shape(measured.to_component)[1] or len(measured.wavelength_nm)


def storage_scores(compact, rounding: np.ndarray, gridded: GriddedBRDF) -> dict[str, np.ndarray]:
    """Return how many bytes a compact form takes, and what rounding it added at the incident angles of the grid."""
    rows = np.isin(np.asarray(gridded.theta_i), np.asarray(compact.theta_i))
    return {"stored_bytes": np.asarray(stored_bytes(compact)), "storage_error": on_rows(rounding, rows)}


def spectral_basis(gridded: GriddedBRDF, options: EncodeOptions) -> SpectralBasis:
    """Return the spectral basis that the options name; that of the data from the incident angles that have any."""
    wavelength_nm, wanted = np.asarray(gridded.wavelength_nm), int(options.coefficients)
    allowed = coefficients_allowed(len(wavelength_nm), wanted, options.basis)
    if allowed.kind not in VECTOR_KINDS:
        return make_basis(wavelength_nm, allowed.kind, wanted)
    known = has_data(gridded)
    brdf = np.where(needed_nodes(gridded)[..., None], np.asarray(gridded.brdf), 0.0)
    return data_basis(wavelength_nm, brdf[known] if known.any() else brdf, allowed.coefficients, allowed.kind)


def finite_part(gridded: GriddedBRDF) -> GriddedBRDF:
    """Return the wavelengths of a grid that are finite, so that a lane that failed spoils no spectrum."""
    live = live_wavelengths(gridded)
    if live.all():
        return gridded
    per_wavelength = ("wavelength_nm", "kkt_residual", "num_steps", "status")
    parts = {name: np.asarray(getattr(gridded, name))[live] for name in per_wavelength}
    return dataclasses.replace(
        gridded,
        brdf=np.asarray(gridded.brdf)[..., live],
        standard_error=None,
        residual_variance=None,
        field=None,
        **parts,
    )


def failed_lanes(result: RunResult) -> list[str]:
    """Return a line for each group of lanes that ended without reaching its tolerance, or not finite."""
    lines = []
    stages = {"resample": (result.gridded.status, "wavelengths")}
    if result.compact is not None:
        stages["represent"] = (result.compact.status, "lanes")
    for stage, group in (("validate", ""), (f"validate {LEAVE_ONE_OUT}", f"{LEAVE_ONE_OUT}/")):
        if f"{group}status" in result.validation:
            stages[stage] = (result.validation[f"{group}status"], "wavelengths of the folds")
    for stage, (status, what) in stages.items():
        status = np.asarray(status)
        for value in FAILED:
            bad = np.argwhere(status == int(value))
            if len(bad):
                first = ", ".join(_lane_name(result, stage, index) for index in bad[:5])
                more = ", ..." if len(bad) > 5 else ""
                lines.append(f"{stage}: {len(bad)} of {status.size} {what} {STATUS_TEXT[value]}: {first}{more}")
    return lines


def _lane_name(result: RunResult, stage: str, index: np.ndarray) -> str:
    if stage == "resample":
        return f"{np.asarray(result.gridded.wavelength_nm)[index[0]]:g} nm"
    if stage.startswith("validate"):
        return f"fit {index[0] + 1}, {result.measured_nm[index[1]]:g} nm"
    theta_i = f"theta_i {np.rad2deg(np.asarray(result.gridded.theta_i)[index[0]]):g} degrees"
    return theta_i if len(index) == 1 else f"{theta_i}, coefficient {index[1]}"


@contextlib.contextmanager
def _timed(progress: Progress, timing: dict[str, dict[str, float]], name: str) -> Iterator[StageClock]:
    with progress.stage(name) as clock, compile_clock() as compiled:
        yield clock
        clock.compile_seconds = compiled.seconds
    timing[name] = {"total": clock.seconds, "compile": compiled.seconds, "run": clock.seconds - compiled.seconds}
