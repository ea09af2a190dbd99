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
from sbrdf_jax.cleaning import DROPPED, CleanReport, clean
from sbrdf_jax.evaluation import evaluate_in_chunks
from sbrdf_jax.folds import LEAVE_ONE_OUT, Folds
from sbrdf_jax.grid import Grid
from sbrdf_jax.options import ResampleOptions
from sbrdf_jax.records import RawSamples
from sbrdf_jax.resampling import resample
from sbrdf_jax.scores import held_out_scores, scores_by_half_angle


@dataclasses.dataclass(frozen=True)
class Prediction:
    """What one fit says at the directions that it did not see."""

    value: Float[np.ndarray, "direction wavelength"]  # 1/sr
    status: Int[np.ndarray, " wavelength"]  # Status of the fit


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """Predictions of all rows, each by a fit that did not see its fold."""

    predicted: Float[np.ndarray, "row wavelength"]  # 1/sr; nan where the row is in no fold
    fold: Int[np.ndarray, " row"]  # NO_FOLD where the row is in none
    status: Int[np.ndarray, "fold wavelength"]  # Status of each fold's fit, folds in increasing order


def predict(
    train: RawSamples,
    grid: Grid,
    options: ResampleOptions,
    theta_i: Float[np.ndarray, " direction"],
    theta_o: Float[np.ndarray, " direction"],
    phi_o: Float[np.ndarray, " direction"],
    report: Callable[[int, int], None] | None = None,
) -> Prediction:
    """Fit cleaned samples and evaluate the fitted field at other directions [rad].

    The one place where validation meets a method.
    """
    gridded = resample(train, grid, options, report)
    return Prediction(evaluate_in_chunks(gridded, theta_i, theta_o, phi_o), np.asarray(gridded.status, int))


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
    predicted = np.full(raw.value.shape, np.nan)
    status = np.zeros((len(labels), len(raw.wavelength_nm)), int)
    top = np.pi / 2  # above it by rounding, as cleaning clips it
    for number, label in enumerate(labels):

        def say(done: int, total: int, place: str = f"fold {number + 1} of {len(labels)}") -> None:
            if report is not None:
                report(f"{place}: {done} of {total} wavelengths converged")

        held_out = folds.label == label
        train = clean(raw.take(~held_out), bilateral=bilateral, method=options.method).samples
        angles = np.minimum(raw.theta_i[held_out], top), np.minimum(raw.theta_o[held_out], top), raw.phi_o[held_out]
        found = predict(train, grid, options, *angles, say)
        predicted[held_out], status[number] = found.value, found.status
    return HeldOut(predicted, folds.label, status)


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
    return {f"scores/{name}": np.asarray(value) for name, value in overall.items()} | {
        f"half_angle/{name}": value for name, value in binned.items()
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
