"""How near predictions are to measured values that they were made without: plain formulae, NumPy only."""

import numpy as np
from jaxtyping import Float

from sbrdf_jax.metrics import relative_error

SMALLEST_RELATIVE = 1e-3  # 1/sr; relative errors are taken of larger values only
LOG_FLOOR = 1e-3  # 1/sr; added before the logarithm, so that zeros count
CALM_SHARE = 0.95  # of the rows, by energy: the others hold a few peaks and most of the energy
HIGH_SHARE = 0.9
HALF_ANGLE_EDGES_DEG = (0.0, 1.0, 5.0, 15.0, 30.0, 90.0)

SCORE_TEXT = {
    "median_rel": "median of |error| / value where the value is above 1e-3 1/sr",
    "p90_rel": "90th percentile of the same",
    "calm_l2": "relative L2 error without the 5 % of rows of most energy",
    "log_rms": "root mean square of the difference of log(value + 1e-3)",
    "rel_l2": "relative L2 error of everything",
    "negative_share": "share of predictions below 0",
}


def held_out_scores(
    predicted: Float[np.ndarray, "row wavelength"], measured: Float[np.ndarray, "row wavelength"]
) -> dict[str, float]:
    """Score predictions; the keys are those of SCORE_TEXT.

    Args:
        predicted: Predictions [1/sr], finite.
        measured: Measured values [1/sr], finite. A negative one is noise round a small one
            and counts as 0; a prediction does so in the logarithm only.

    Returns:
        The scores; nan where no value is there to be scored.
    """
    if not predicted.size:
        return dict.fromkeys(SCORE_TEXT, float("nan"))
    measured = np.maximum(measured, 0.0)
    squared = (predicted - measured) ** 2
    big = measured > SMALLEST_RELATIVE
    relative = np.abs(predicted - measured)[big] / measured[big]
    energy = (measured**2).sum(axis=1)
    calm = energy <= np.quantile(energy, CALM_SHARE)
    log_ratio = np.log(np.maximum(predicted, 0.0) + LOG_FLOOR) - np.log(measured + LOG_FLOOR)
    return {
        "median_rel": float(np.median(relative)) if relative.size else float("nan"),
        "p90_rel": float(np.quantile(relative, HIGH_SHARE)) if relative.size else float("nan"),
        "calm_l2": float(relative_error(squared[calm].sum(), energy[calm].sum())),
        "log_rms": float(np.sqrt(np.mean(log_ratio**2))),
        "rel_l2": float(relative_error(squared.sum(), energy.sum())),
        "negative_share": float(np.mean(predicted < 0)),
    }


def coverage(
    predicted: Float[np.ndarray, "..."], measured: Float[np.ndarray, "..."], expected_error: Float[np.ndarray, "..."]
) -> float:
    """Share of the measured values above 1e-3 1/sr that lie within one expected error of their prediction.

    An honest error model covers 68 %.
    """
    big = measured > SMALLEST_RELATIVE
    return float(np.mean((np.abs(predicted - measured) <= expected_error)[big])) if big.any() else float("nan")


def coverage_by(
    label: np.ndarray,
    predicted: Float[np.ndarray, "row wavelength"],
    measured: Float[np.ndarray, "row wavelength"],
    expected_error: Float[np.ndarray, "row wavelength"],
) -> dict[str, np.ndarray]:
    """Coverage of each distinct finite label [row, wavelength]: `label`, `share` and `count` of values [bin]."""
    label = np.where(measured > SMALLEST_RELATIVE, label, np.nan)
    distinct = np.unique(label[np.isfinite(label)])
    masks = [label == one for one in distinct]
    share = [coverage(predicted[mask], measured[mask], expected_error[mask]) for mask in masks]
    return {"label": distinct, "share": np.array(share), "count": np.array([int(mask.sum()) for mask in masks])}


def scores_by_half_angle(
    predicted: Float[np.ndarray, "row wavelength"],
    measured: Float[np.ndarray, "row wavelength"],
    half_angle: Float[np.ndarray, " row"],
) -> dict[str, np.ndarray]:
    """Score the rows of each bin of the half angle by themselves.

    Args:
        predicted: As for `held_out_scores`.
        measured: As for `held_out_scores`.
        half_angle: Angle between the normal and the half vector [rad], at most pi / 2.

    Returns:
        Arrays [bin]: every score, `count` of rows, `lower_deg` and `upper_deg` of the bin (lower edge included).
    """
    edges = np.array(HALF_ANGLE_EDGES_DEG)
    index = np.clip(np.searchsorted(edges, np.degrees(half_angle), "right") - 1, 0, len(edges) - 2)
    rows = [index == k for k in range(len(edges) - 1)]
    scored = [held_out_scores(predicted[mask], measured[mask]) for mask in rows]
    found = {name: np.array([scores[name] for scores in scored]) for name in SCORE_TEXT}
    count = np.array([int(mask.sum()) for mask in rows])
    return found | {"count": count, "lower_deg": edges[:-1], "upper_deg": edges[1:]}
