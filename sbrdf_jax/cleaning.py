"""Quality of a measurement: every sample that is dropped, clipped, folded or flagged has a count and a reason.

Only what cannot be is dropped. What is doubtful is flagged and kept: a negative value is noise
round a small one, and a method that weighs samples decides for itself what a flag means.
"""

import dataclasses
import enum
from typing import Literal

import numpy as np

from sbrdf_jax.coverage import Coverage, cluster_incidences, find_coverage
from sbrdf_jax.dropouts import find_dropouts
from sbrdf_jax.errors import UserError
from sbrdf_jax.formats.table import MIN_SAMPLES
from sbrdf_jax.records import RawSamples

HORIZON_TOLERANCE = 1e-5  # rad; rounding in a text file puts 90 degrees at 1.5708
SAME_DIRECTION = 1e-6  # rad; the last digit that text files keep
HALF_TURN_TOLERANCE = 1e-4  # rad; text files put pi at 3.1416
MAX_VALUE = 1e30  # 1/sr; no measurement is larger, and squares stay finite
MIN_VALUE = 1e-30  # 1/sr; a measurement without a larger one holds nothing that could be computed with
NUM_EXAMPLES = 3


class Flag(enum.IntFlag):
    """What is known of one row of the file; a row may have several."""

    OK = 0
    NONFINITE = 1
    BELOW_HORIZON = 2
    CLIPPED = 4
    NEGATIVE = 8
    ZERO = 16
    DUPLICATE = 32
    DROPOUT = 64
    FOLDED = 128


DROPPED = Flag.NONFINITE | Flag.BELOW_HORIZON
ACTION_AND_REASON = {
    Flag.NONFINITE: ("dropped", "an angle or a value is not a finite number, or beyond 1e30"),
    Flag.BELOW_HORIZON: ("dropped", "theta_o is above 90 degrees: below the horizon"),
    Flag.CLIPPED: ("clipped", "theta_i or theta_o was 90 degrees but for rounding, and was set to it"),
    Flag.NEGATIVE: ("flagged", "some value is negative: noise round a small value, kept"),
    Flag.ZERO: ("flagged", "some value is exactly 0: at or below the noise, not a measurement of 0; kept"),
    Flag.DUPLICATE: ("flagged", "its direction was measured before; each counts as a measurement"),
    Flag.DROPOUT: (
        "flagged",
        "far below its angular neighbours at most wavelengths: something stood in the way; left out by method guided",
    ),
    Flag.FOLDED: ("folded", "bilateral sample: used at its mirror image, phi_o from 0 to 180 degrees"),
}


@dataclasses.dataclass(frozen=True)
class CleanEntry:
    """One line of the quality table."""

    name: str  # of the flag, in lower case
    action: str  # dropped, clipped, flagged or folded
    rows: int
    values: int  # how many single values; 0 where the whole row is meant
    reason: str
    examples: tuple[str, ...]  # a few rows, with their directions


@dataclasses.dataclass(frozen=True)
class CleanReport:
    """What cleaning found; `flag` and the columns of `entries` are what a result stores."""

    flag: np.ndarray  # [row of the file] uint16, bits of `Flag`
    entries: tuple[CleanEntry, ...]  # one for each flag, those with no row too
    dead_wavelength_nm: np.ndarray  # not finite in more than half of the samples: not used
    num_rows: int  # of the file
    num_kept: int
    bilateral: bool  # as resolved: |phi_o| is folded
    coverage: Coverage

    def lines(self) -> list[str]:
        """The quality table as text."""
        lines = [f"{self.num_kept} of {self.num_rows} samples kept"]
        for entry in self.entries:
            if entry.rows:
                values = f" ({entry.values} values)" if entry.values else ""
                lines.append(f"  {entry.action:8}{entry.rows:>8}  {entry.name}{values}: {entry.reason}")
                if entry.name not in ("folded", "zero", "negative"):
                    lines += [f"{'':20}{example}" for example in entry.examples]
        if len(self.dead_wavelength_nm):
            names = ", ".join(f"{w:g}" for w in self.dead_wavelength_nm)
            lines.append(f"  not used: wavelengths {names} nm, not finite in more than half of the samples")
        return lines


@dataclasses.dataclass(frozen=True)
class CleanResult:
    """The samples that are left, and why the others are not."""

    samples: RawSamples
    report: CleanReport


def clean(raw: RawSamples, *, bilateral: bool | Literal["auto"] = "auto", method: str = "paper") -> CleanResult:
    """Drop the impossible, flag the doubtful, and resolve `input.bilateral`.

    A row is dropped if an angle or a value of it is not finite, or if it lies below the horizon. A
    wavelength that is not finite in more than half of the rows is a dead channel: it is NaN in
    every sample afterwards, so its lane fails alone, and it drops no row. Method "guided" leaves out
    drop-outs too: what stood in the way says nothing of the surface. phi_o stays as measured:
    the grid of a bilateral sample folds it, and the report counts what is folded.

    Args:
        raw: All rows of a file.
        bilateral: As in the config; "auto" is true, but for method "paper" on data of both half-planes.
        method: `resample.method`.

    Returns:
        The samples that are left, in file order with their row numbers, and the report.

    Raises:
        UserError: fewer than 4 samples or no positive value above `MIN_VALUE` are left.
    """
    finite = np.abs(raw.value) <= MAX_VALUE
    angles_finite = np.isfinite(raw.theta_i) & np.isfinite(raw.theta_o) & np.isfinite(raw.phi_o)
    dead = np.mean(finite, axis=0) < 0.5
    flag = np.zeros(raw.num_samples, np.uint16)
    values = dict.fromkeys(Flag, 0)

    def mark(bit: Flag, mask: np.ndarray) -> None:
        flag[mask] |= np.uint16(bit)

    mark(Flag.NONFINITE, ~(angles_finite & np.all(finite | dead, axis=1)))
    values[Flag.NONFINITE] = int(np.sum(~finite[:, ~dead]))
    top = np.pi / 2
    mark(Flag.BELOW_HORIZON, angles_finite & (raw.theta_o > top + HORIZON_TOLERANCE))
    keep = (flag & np.uint16(DROPPED)) == 0
    kept = dataclasses.replace(raw.take(keep), value=np.where(dead, np.nan, raw.value[keep]))
    where = np.flatnonzero(keep)
    if kept.num_samples < MIN_SAMPLES:
        raise UserError(
            f"{raw.source}: found {kept.num_samples} usable samples of {raw.num_samples}, "
            f"expected at least {MIN_SAMPLES}; the others are not finite or below the horizon"
        )
    live = kept.value[:, ~dead]
    if not np.any(live > MIN_VALUE):
        found = f"no positive value in the {kept.num_samples} usable samples"
        raise UserError(f"{raw.source}: {found}" + f", but below {MIN_VALUE:g}" * bool(np.any(live > 0)))

    mark(Flag.CLIPPED, where[np.maximum(kept.theta_i, kept.theta_o) > top])
    kept = dataclasses.replace(kept, theta_i=np.minimum(kept.theta_i, top), theta_o=np.minimum(kept.theta_o, top))
    for bit, wrong in ((Flag.NEGATIVE, live < 0), (Flag.ZERO, live == 0)):
        mark(bit, where[wrong.any(axis=1)])
        values[bit] = int(wrong.sum())
    mark(Flag.DUPLICATE, where[_repeated(kept)])
    mark(Flag.DROPOUT, where[find_dropouts(kept, cluster_incidences(kept.theta_i)[1])])
    dropped = DROPPED | Flag.DROPOUT if method == "guided" else DROPPED
    stays = (flag[where] & np.uint16(dropped)) == 0
    kept, where = kept.take(stays), where[stays]

    coverage = find_coverage(kept)
    folded = resolve_bilateral(bilateral, method, coverage)
    if folded:
        mark(Flag.FOLDED, where[(kept.phi_o > np.pi + HALF_TURN_TOLERANCE) & (kept.theta_o > 0)])
    report = CleanReport(
        flag=flag,
        entries=tuple(_entry(bit, flag, values[bit], raw, dropped) for bit in ACTION_AND_REASON),
        dead_wavelength_nm=raw.wavelength_nm[dead],
        num_rows=raw.num_samples,
        num_kept=kept.num_samples,
        bilateral=folded,
        coverage=coverage,
    )
    return CleanResult(kept, report)


def resolve_bilateral(setting: bool | Literal["auto"], method: str, coverage: Coverage) -> bool:
    """Return whether |phi_o| is folded: "auto" is true, but for method "paper" on data of both half-planes."""
    if setting == "auto":
        return not (method == "paper" and coverage.covers_both_half_planes)
    return setting


def _repeated(samples: RawSamples) -> np.ndarray:
    """Mask of samples whose direction occurs earlier; a mirror twin is another direction."""
    # at theta_o = 0 every azimuth is the same direction; 2 pi is 0
    phi_o = np.where(samples.theta_o < SAME_DIRECTION, 0.0, samples.phi_o)
    key = np.round(np.stack([samples.theta_i, samples.theta_o, phi_o]) / SAME_DIRECTION).astype(np.int64)
    key[2] %= round(2 * np.pi / SAME_DIRECTION)
    order = np.lexsort(key)  # stable: equal directions stay in file order
    again = np.zeros(samples.num_samples, bool)
    again[order[1:]] = np.all(key[:, order[1:]] == key[:, order[:-1]], axis=0)
    return again


def _entry(bit: Flag, flag: np.ndarray, values: int, raw: RawSamples, dropped: Flag) -> CleanEntry:
    """Return the line of the table for one flag."""
    rows = np.flatnonzero(flag & np.uint16(bit))
    angles = np.degrees(np.stack([raw.theta_i, raw.theta_o, raw.phi_o], axis=1))
    examples = tuple(
        "row {}: theta_i {:.5g}, theta_o {:.5g}, phi_o {:.5g} degrees".format(raw.row[r], *angles[r])
        for r in rows[:NUM_EXAMPLES]
    )
    action, reason = ACTION_AND_REASON[bit]
    action = "dropped" if bit & dropped else action
    return CleanEntry(str(bit.name).lower(), action, len(rows), values, reason, examples)
