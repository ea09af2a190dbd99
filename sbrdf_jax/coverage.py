"""Which directions a measurement covers, and in words which it does not."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from sbrdf_jax.angles import MIRROR_AZIMUTH, fold_azimuth
from sbrdf_jax.records import RawSamples

SAME_INCIDENCE = np.radians(0.5)  # incident angles within this span are one setting of the goniometer
OFF_PLANE = np.radians(0.5)  # azimuths closer to the plane of incidence lie in it
NEAR_POLE = np.radians(1.0)  # below this theta_o an azimuth says nothing
BOTH_HALVES_SHARE = 0.1  # of the samples off the plane of incidence, in the lesser half
WIDE_THETA_I_GAP = np.radians(15.5)  # two steps of the paper's grid, and a little
WIDE_PHI_GAP = np.radians(30.5)
HOLE = np.radians(5.0)  # round the mirror or the incidence direction


@dataclasses.dataclass(frozen=True)
class Coverage:
    """What was measured, as numbers and as lines for a user."""

    theta_i: np.ndarray  # [incidence] rad, distinct, increasing
    count: np.ndarray  # [incidence] samples of each
    theta_o_range: tuple[float, float]  # rad
    covers_both_half_planes: bool  # phi_o on both sides of the plane of incidence
    covered: tuple[str, ...]  # a line each
    missing: tuple[str, ...]  # a line each


def cluster_incidences(
    theta_i: Float[np.ndarray, " sample"],
) -> tuple[Float[np.ndarray, " incidence"], Int[np.ndarray, " sample"]]:
    """Return the distinct incident angles [rad], increasing, and which of them each sample has.

    Angles within 0.5 degrees of the smallest of their group are one setting: encoders jitter, and
    scattered incident angles must not chain into one group.
    """
    order = np.argsort(theta_i, kind="stable")
    angle = theta_i[order]
    starts = []
    start = 0
    while start < len(angle):
        starts.append(start)
        start = int(np.searchsorted(angle, angle[start] + SAME_INCIDENCE, "right"))
    index = np.empty(len(angle), int)
    index[order] = np.searchsorted(np.array(starts, int), np.arange(len(angle)), "right") - 1
    first = angle[starts]
    # the mean as an offset, so that equal angles come back exactly
    return first + np.bincount(index, theta_i - first[index]) / np.bincount(index), index


def find_coverage(samples: RawSamples) -> Coverage:
    """Describe which directions the samples cover; by angles alone.

    Args:
        samples: At least one sample, angles finite and above the horizon.

    Returns:
        The coverage; `missing` names each gap once, in degrees.
    """
    theta_i, index = cluster_incidences(samples.theta_i)
    count = np.bincount(index)
    theta_o_range = (float(samples.theta_o.min()), float(samples.theta_o.max()))
    side = _side(samples)
    halves = np.array([np.sum(side > 0), np.sum(side < 0)])
    both = bool(halves.min() > 0 and halves.min() >= BOTH_HALVES_SHARE * halves.sum())

    def deg(angle) -> str:
        return f"{np.degrees(angle):.4g}"

    angles = ", ".join(map(deg, theta_i)) if len(theta_i) <= 20 else f"{deg(theta_i[0])} to {deg(theta_i[-1])}"
    azimuth = "both half-planes" if both else "one half-plane" if halves.any() else "the plane of incidence"
    per = f"{count.min()}" if count.min() == count.max() else f"{count.min()} to {count.max()}"
    covered = (
        f"{len(theta_i)} incident angles: {angles} degrees, {per} samples each",
        f"theta_o {deg(theta_o_range[0])} to {deg(theta_o_range[1])} degrees, phi_o over {azimuth}",
    )
    missing = [*_missing_theta_i(theta_i, deg), *_missing_theta_o(theta_o_range, deg)]
    if not both and halves.any():
        away = "0 to 180" if halves[0] <= halves[1] else "180 to 360"
        missing.append(f"azimuths {away} degrees: one half-plane only, so bilateral symmetry cannot be tested")
    if not halves.any():
        missing.append("everything off the plane of incidence")
    missing += [*_missing_azimuth(samples, deg), *_holes(samples, theta_i, index, deg)]
    return Coverage(theta_i, count, theta_o_range, both, covered, tuple(missing))


def _side(samples: RawSamples) -> np.ndarray:
    """+1 where phi_o lies in (0, 180) degrees, -1 in (180, 360), 0 in the plane of incidence or at the pole."""
    folded = fold_azimuth(samples.phi_o)
    off = (folded > OFF_PLANE) & (folded < np.pi - OFF_PLANE) & (samples.theta_o > NEAR_POLE)
    return np.where(off, np.where(samples.phi_o < np.pi, 1, -1), 0)


def _missing_theta_i(theta_i: np.ndarray, deg) -> list[str]:
    lines = []
    if theta_i[0] > np.radians(1):
        lines.append(f"incident angles below {deg(theta_i[0])} degrees")
    if theta_i[-1] < np.radians(89):
        lines.append(f"incident angles above {deg(theta_i[-1])} degrees")
    for k in np.flatnonzero(np.diff(theta_i) > WIDE_THETA_I_GAP):
        lines.append(f"incident angles between {deg(theta_i[k])} and {deg(theta_i[k + 1])} degrees")
    if len(theta_i) < 3:
        lines.append(f"fewer than 3 incident angles ({len(theta_i)}): nothing is interpolated between them")
    return lines


def _missing_theta_o(theta_o_range: tuple[float, float], deg) -> list[str]:
    lines = []
    if theta_o_range[0] > np.radians(10):
        lines.append(f"theta_o below {deg(theta_o_range[0])} degrees")
    if theta_o_range[1] < np.radians(89):
        lines.append(f"theta_o above {deg(theta_o_range[1])} degrees")
    return lines


def _missing_azimuth(samples: RawSamples, deg) -> list[str]:
    """Wide gaps of |phi_o|, 0 to 180 degrees, over all incident angles together."""
    folded = np.sort(fold_azimuth(samples.phi_o[samples.theta_o > NEAR_POLE]))
    edges = np.concatenate([[0.0], folded, [np.pi]])
    wide = np.flatnonzero(np.diff(edges) > WIDE_PHI_GAP) if len(folded) else []
    return [f"|phi_o| between {deg(edges[k])} and {deg(edges[k + 1])} degrees" for k in wide]


def _holes(samples: RawSamples, theta_i: np.ndarray, index: np.ndarray, deg) -> list[str]:
    """Empty surroundings of the incidence and of the mirror direction, as far as theta_o was measured."""
    lines = []
    for name, azimuth in (("incidence", 0.0), ("mirror", MIRROR_AZIMUTH)):
        cosine = np.cos(samples.theta_i) * np.cos(samples.theta_o)
        cosine = cosine + np.sin(samples.theta_i) * np.sin(samples.theta_o) * np.cos(samples.phi_o - azimuth)
        nearest = np.full(len(theta_i), np.inf)
        np.minimum.at(nearest, index, np.arccos(np.clip(cosine, -1, 1)))
        within = theta_i <= samples.theta_o.max() + HOLE
        hole = within & (nearest > HOLE)
        if hole.any():
            where = ", ".join(map(deg, theta_i[hole][:12])) + (", ..." if hole.sum() > 12 else "")
            widest = deg(nearest[hole].max())
            lines.append(f"directions within {widest} degrees (at most) of the {name} direction at theta_i = {where}")
    return lines
