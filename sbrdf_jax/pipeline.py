"""Strings the stages together: a measurement and options in, a result out; no files but that of folds."""

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np

from sbrdf_jax.cleaning import CleanResult, clean
from sbrdf_jax.encoding import coefficients_allowed, data_basis, encode_field, make_basis
from sbrdf_jax.folds import LEAVE_ONE_OUT, Folds, make_folds
from sbrdf_jax.grid import Grid, has_data, make_grid
from sbrdf_jax.metrics import live_wavelengths, measure
from sbrdf_jax.options import EncodeOptions, RunOptions
from sbrdf_jax.plan import PlanRow, plan_run, plan_validation
from sbrdf_jax.progress import Progress, StageClock
from sbrdf_jax.records import STATUS_TEXT, GriddedBRDF, RawSamples, SpectralBasis, Status
from sbrdf_jax.representation import represent_with_plan
from sbrdf_jax.resampling import resample
from sbrdf_jax.resampling.guided import describe_fit
from sbrdf_jax.resampling.kept import Kept
from sbrdf_jax.runtime import compile_clock
from sbrdf_jax.store import RunResult
from sbrdf_jax.summary import count_statuses
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


def prepare(raw: RawSamples, options: RunOptions) -> Prepared:
    """Clean a measurement, lay out its grid and count the work.

    Args:
        raw: All rows of a file.
        options: Resolved options.

    Returns:
        The cleaned samples, the grid, the plan, and what a user must be told.

    Raises:
        UserError: The measurement is not enough for a grid or for its validation, or the fold file is wrong.
    """
    cleaned = clean(raw, bilateral=options.input.bilateral, method=options.resample.method)
    grid = make_grid(cleaned.samples, options.grid, bilateral=cleaned.report.bilateral)
    num_live = len(raw.wavelength_nm) - len(cleaned.report.dead_wavelength_nm)
    allowed = coefficients_allowed(num_live, int(options.encode.coefficients), options.encode.basis)
    rows = plan_run(cleaned.samples, raw.num_samples, grid, allowed.coefficients, options)
    folds = make_folds(raw, cleaned.report, options.validate, mirror_twins=options.input.bilateral is not False)
    rows += plan_validation(folds)
    warnings = [f"not measured: {text}" for text in cleaned.report.coverage.missing]
    if allowed.warning:
        warnings.append(allowed.warning)
    return Prepared(cleaned, grid, rows, tuple(warnings), folds)


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
    timing: dict[str, dict[str, float]] = {}
    samples, report = ready.cleaned.samples, ready.cleaned.report
    with _timed(progress, timing, "resample"):
        gridded = resample(
            samples,
            ready.grid,
            options.resample,
            progress.update,
            kept,
        )
    notes = () if gridded.field is None else describe_fit(gridded.field)

    live = finite_part(gridded)
    with _timed(progress, timing, "encode"):
        basis = spectral_basis(live, options.encode)
        field = encode_field(live, basis)
        used = np.shape(field.coefficient)[-1]
        progress.update(f"{used} coefficients, basis {basis.kind}")

    with _timed(progress, timing, "represent"):
        compact, searched = represent_with_plan(field, options.represent, live)
        missed = tuple(searched.pop("warnings", ()))
        progress.update(count_statuses(compact.status))

    with _timed(progress, timing, "measure"):
        metrics = measure(gridded, field, compact, absolute=raw.quantity == "brdf")

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
            "represent": searched,
            "coefficients_used": used,
        },
        timing=timing,
        warnings=ready.warnings + notes + missed + metrics.warnings,
        source_sha256=raw.source_sha256,
    )


def spectral_basis(gridded: GriddedBRDF, options: EncodeOptions) -> SpectralBasis:
    """Return the spectral basis that the options name; that of the data from the incident angles that have any."""
    wavelength_nm, wanted = np.asarray(gridded.wavelength_nm), int(options.coefficients)
    allowed = coefficients_allowed(len(wavelength_nm), wanted, options.basis)
    if allowed.kind != "data":
        return make_basis(wavelength_nm, allowed.kind, wanted)
    known = has_data(gridded)
    brdf = np.asarray(gridded.brdf)
    return data_basis(wavelength_nm, brdf[known] if known.any() else brdf, allowed.coefficients)


def finite_part(gridded: GriddedBRDF) -> GriddedBRDF:
    """Return the wavelengths of a grid that are finite, so that a lane that failed spoils no spectrum."""
    live = live_wavelengths(gridded)
    if live.all():
        return gridded
    per_wavelength = ("wavelength_nm", "kkt_residual", "num_steps", "status")
    parts = {name: np.asarray(getattr(gridded, name))[live] for name in per_wavelength}
    return dataclasses.replace(
        gridded, brdf=np.asarray(gridded.brdf)[..., live], standard_error=None, field=None, **parts
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
        return f"fit {index[0] + 1}, {np.asarray(result.gridded.wavelength_nm)[index[1]]:g} nm"
    theta_i = f"theta_i {np.rad2deg(np.asarray(result.gridded.theta_i)[index[0]]):g} degrees"
    return theta_i if len(index) == 1 else f"{theta_i}, coefficient {index[1]}"


@contextlib.contextmanager
def _timed(progress: Progress, timing: dict[str, dict[str, float]], name: str) -> Iterator[StageClock]:
    with progress.stage(name) as clock, compile_clock() as compiled:
        yield clock
        clock.compile_seconds = compiled.seconds
    timing[name] = {"total": clock.seconds, "compile": compiled.seconds, "run": clock.seconds - compiled.seconds}
