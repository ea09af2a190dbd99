"""Held-out validation: every row is predicted by a fit that did not see it, and the predictions are scored.

Whatever depends on values (cleaning by neighbours, and all that `resample` estimates) is
found anew without the held-out rows; the grid depends on angles alone and is that of the
whole measurement. Any method is validated in the same way, through `predict`.
"""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Bool, Float, Int

from sbrdf_jax.angles import half_angle
from sbrdf_jax.cleaning import DROPPED, CleanReport, Flag, clean
from sbrdf_jax.coverage import cluster_incidences
from sbrdf_jax.evaluation import evaluate_in_chunks
from sbrdf_jax.folds import LEAVE_ONE_OUT, Folds
from sbrdf_jax.grid import Grid
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.records import RawSamples
from sbrdf_jax.resampling import resample
from sbrdf_jax.resampling.guided import Centres, fit_field, place_centres
from sbrdf_jax.resampling.guided.field import evaluate_with_error, evaluated_part
from sbrdf_jax.resampling.guided.shadows import measured_value
from sbrdf_jax.scores import coverage, coverage_by, held_out_scores, scores_by_half_angle


@dataclasses.dataclass(frozen=True)
class Prediction:
    """What one fit says at the directions that it did not see."""

    value: Float[np.ndarray, "direction wavelength"]  # 1/sr
    status: Int[np.ndarray, " wavelength"]  # Status of the fit
    expected_error: Float[np.ndarray, "direction wavelength"] | None = None  # 1/sr, field and one measurement together


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """Predictions of all rows, each by a fit that did not see its fold."""

    predicted: Float[np.ndarray, "row wavelength"]  # 1/sr; nan where the row is in no fold
    fold: Int[np.ndarray, " row"]  # NO_FOLD where the row is in none
    status: Int[np.ndarray, "fold wavelength"]  # Status of each fold's fit, folds in increasing order
    expected_error: Float[np.ndarray, "row wavelength"] | None = None  # 1/sr, where the method has one


def predict(
    train: RawSamples,
    dropouts: RawSamples,
    grid: Grid,
    options: ResampleOptions,
    theta_i: Float[np.ndarray, " direction"],
    theta_o: Float[np.ndarray, " direction"],
    phi_o: Float[np.ndarray, " direction"],
    report: Callable[[str], None] | None = None,
    centres: Centres | None = None,
) -> Prediction:
    """Fit cleaned samples and tell what would be measured in other directions [rad].

    The one place where validation meets a method.

    Args:
        train: Cleaned samples.
        dropouts: Samples that method guided left out: its field knows nothing of what stood in the way there, but a
            measurement would.
        grid: The grid of the whole measurement.
        options: Resolved options.
        theta_i: Polar angle of incidence [rad].
        theta_o: Polar angle of exitance [rad].
        phi_o: Azimuth of exitance [rad].
        report: Told how far it is.
        centres: For method guided, what depends on angles alone.
    """
    angles = theta_i, theta_o, phi_o
    if options.method == "guided":
        fit = fit_field(train, options, report, None if centres is None else centres.take(train.row))
        field = evaluated_part(fit.field)
        value, error, noise = map(np.asarray, evaluate_with_error(field, fit.whiten, *angles))
        shaded = measured_value(field, value, angles, train, dropouts)
        return Prediction(shaded, fit.status, np.sqrt(error**2 + noise**2 + (value - shaded) ** 2))
    gridded = resample(train, grid, options, report)
    return Prediction(evaluate_in_chunks(gridded, *angles), np.asarray(gridded.status, int))


def share_angles(raw: RawSamples, grid: Grid, options: ResampleOptions, bilateral: bool) -> Centres | None:
    """Return what fits to parts of a measurement share, because it depends on angles alone; None for method paper."""
    if options.method != "guided":
        return None
    positive = dataclasses.replace(raw, value=np.ones_like(raw.value))  # no row is dropped for its values
    return place_centres(clean(positive, bilateral=bilateral, method=options.method).samples, grid.reciprocal)


def predict_held_out(
    raw: RawSamples,
    folds: Folds,
    grid: Grid,
    options: ResampleOptions,
    *,
    bilateral: bool,
    report: Callable[[str], None] | None = None,
) -> HeldOut:
    """Predict every row by a fit to the rows outside its fold.

    Args:
        raw: All rows of a file. The values of a fold's rows do not influence their prediction.
        folds: Which rows are held out together.
        grid: The grid of the whole measurement.
        options: Resolved options of the method.
        bilateral: Whether |phi_o| is folded, as resolved for the whole measurement.
        report: Called with how far it is: "fold 2 of 5: 12 of 31 wavelengths converged".

    Returns:
        Predictions of all rows, those that cleaning drops for their values too.

    Raises:
        UserError: The rows outside a fold are not enough for a fit.
    """
    labels = folds.labels
    predicted, expected = np.full((2, *raw.value.shape), np.nan)
    centres = share_angles(raw, grid, options, bilateral)
    status = np.zeros((len(labels), len(raw.wavelength_nm)), int)
    top = np.pi / 2  # above it by rounding, as cleaning clips it
    for number, label in enumerate(labels):

        def say(text: str, place: str = f"fold {number + 1} of {len(labels)}") -> None:
            if report is not None:
                report(f"{place}: {text}")

        held_out = folds.label == label
        rest = raw.take(~held_out)
        cleaned = clean(rest, bilateral=bilateral, method=options.method)
        dropouts = rest.take((cleaned.report.flag & np.uint16(Flag.DROPOUT)) > 0)
        angles = np.minimum(raw.theta_i[held_out], top), np.minimum(raw.theta_o[held_out], top), raw.phi_o[held_out]
        found = predict(cleaned.samples, dropouts, grid, options, *angles, say, centres)
        predicted[held_out], status[number] = found.value, found.status
        if found.expected_error is not None:
            expected[held_out] = found.expected_error
    return HeldOut(predicted, folds.label, status, expected if np.isfinite(expected).any() else None)


def score(held_out: HeldOut, raw: RawSamples, report: CleanReport) -> dict[str, np.ndarray]:
    """Compare predictions with what was measured, over everything and by half angle.

    Measured values are the raw ones after `input.scale` and the conversion to BRDF, negative
    ones counted as 0. Left out are rows that cleaning of the whole measurement drops or that
    are in no fold, dead wavelengths, and wavelengths at which a prediction is not finite.

    Args:
        held_out: The predictions.
        raw: The measurement.
        report: What cleaning found in the whole of it.

    Returns:
        `scores/NAME`, with `scores/count` of rows and `scores/num_wavelengths`, and `half_angle/NAME` [bin].
    """
    rows, live = compared(held_out, raw, report)
    predicted, measured = held_out.predicted[rows][:, live], raw.value[rows][:, live]
    overall = held_out_scores(predicted, measured) | {"count": int(rows.sum()), "num_wavelengths": int(live.sum())}
    angle = half_angle(raw.theta_i[rows], raw.theta_o[rows], raw.phi_o[rows])
    binned = scores_by_half_angle(predicted, measured, angle)
    found = _calibration(held_out, raw, rows, live) if held_out.expected_error is not None else {}
    return (
        found
        | {f"scores/{name}": np.asarray(value) for name, value in overall.items()}
        | {f"half_angle/{name}": value for name, value in binned.items()}
    )


def _calibration(held_out: HeldOut, raw: RawSamples, rows, live) -> dict[str, np.ndarray]:
    """How many measured values lie within their expected error: overall, by incident angle, by decade of value."""
    arrays = held_out.predicted, raw.value, held_out.expected_error
    predicted, measured, expected = (np.asarray(a)[rows][:, live] for a in arrays)
    _, group = cluster_incidences(raw.theta_i[rows])
    angle = np.degrees(np.bincount(group, raw.theta_i[rows]) / np.bincount(group))[group]
    by_angle = coverage_by(np.broadcast_to(angle[:, None], measured.shape), predicted, measured, expected)
    decade = np.floor(np.log10(np.maximum(measured, 1e-300)))
    by_decade = coverage_by(decade, predicted, measured, expected)
    return {
        "scores/coverage": np.asarray(coverage(predicted, measured, expected)),
        **{f"coverage_by_theta_i/{name}": value for name, value in by_angle.items()},
        **{f"coverage_by_decade/{name}": value for name, value in by_decade.items()},
    }


def compared(
    held_out: HeldOut, raw: RawSamples, report: CleanReport
) -> tuple[Bool[np.ndarray, " row"], Bool[np.ndarray, " wavelength"]]:
    """Return the rows and the wavelengths at which both sides are finite."""
    rows = ((report.flag & np.uint16(DROPPED)) == 0) & np.isfinite(held_out.predicted).any(axis=1)
    live = ~np.isin(raw.wavelength_nm, report.dead_wavelength_nm)
    return rows, live & np.isfinite(held_out.predicted[rows]).all(axis=0)


def validate(
    raw: RawSamples,
    schemes: Mapping[str, Folds],
    grid: Grid,
    options: ResampleOptions,
    cleaning: CleanReport,
    report: Callable[[str], None] | None = None,
) -> dict[str, np.ndarray]:
    """Predict and score by every scheme.

    Args:
        raw: All rows of a file.
        schemes: From `make_folds`.
        grid: The grid of the whole measurement.
        options: Resolved options of the method.
        cleaning: What cleaning found in the whole measurement.
        report: As for `predict_held_out`.

    Returns:
        Arrays by their names below `validation` in the result file: `predicted`, `fold`,
        `status`, `scores/...` and `half_angle/...`, those of the second scheme below its name.
    """
    found: dict[str, np.ndarray] = {}
    for name, folds in schemes.items():
        held_out = predict_held_out(raw, folds, grid, options, bilateral=cleaning.bilateral, report=report)
        group = f"{LEAVE_ONE_OUT}/" if name == LEAVE_ONE_OUT else ""
        arrays = {field: value for field, value in vars(held_out).items() if value is not None}
        found |= {f"{group}{field}": value for field, value in (arrays | score(held_out, raw, cleaning)).items()}
    return found
