"""Which rows of a measurement are held out together: at random, as a file says, or an incident angle at a time.

A fold depends on directions alone, never on values. A row has one label; -1 is a row of no
fold, whose direction is not finite or below the horizon.
"""

import dataclasses
from pathlib import Path

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Int
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from sbrdf_jax.angles import fold_azimuth
from sbrdf_jax.cleaning import DROPPED, HORIZON_TOLERANCE, SAME_DIRECTION, CleanReport
from sbrdf_jax.coverage import cluster_incidences
from sbrdf_jax.errors import UserError
from sbrdf_jax.formats.table import MIN_SAMPLES
from sbrdf_jax.formats.text import numbered_lines, shorten
from sbrdf_jax.options import ValidateOptions
from sbrdf_jax.records import RawSamples

NO_FOLD = -1
FEWEST_FOLDS = 2
FEWEST_INCIDENCES = 3
LARGEST_LABEL = 2**31 - 1
K_FOLD = "folds"  # names of schemes; the second one is also its group in the result file
LEAVE_ONE_OUT = "leave_one_theta_i_out"


@dataclasses.dataclass(frozen=True)
class Folds:
    """One way to part the rows."""

    label: np.ndarray  # [row] int, NO_FOLD or the fold in which the row is held out
    how: str  # in a few words, for the plan

    @property
    def labels(self) -> np.ndarray:
        """The distinct folds, increasing."""
        return np.unique(self.label[self.label != NO_FOLD])


def make_folds(
    raw: RawSamples, report: CleanReport, options: ValidateOptions, *, mirror_twins: bool = True
) -> dict[str, Folds]:
    """Part the rows in each way that the options ask for, before anything is solved.

    Args:
        raw: All rows of a file.
        report: What cleaning found in them.
        options: `fold_file` wins over `folds`.
        mirror_twins: Whether phi_o and 2 pi - phi_o stay in one random fold.

    Returns:
        The folds by scheme, K_FOLD and LEAVE_ONE_OUT; nothing where validation is off.

    Raises:
        UserError: A wrong fold file, more folds than directions, fewer than 3 incident angles
            to leave one out, or a fold without which too little is left.
    """
    usable = has_direction(raw)
    schemes = {}
    if options.fold_file is not None:
        label = read_fold_file(options.fold_file, raw.num_samples)
        schemes[K_FOLD] = Folds(np.where(usable, label, NO_FOLD), f"as in {Path(options.fold_file).name}")
    elif options.folds:
        label = split_at_random(raw, options.folds, options.seed, usable=usable, mirror_twins=mirror_twins)
        twins = "mirror twins and repeats together" if mirror_twins else "repeats together"
        schemes[K_FOLD] = Folds(label, f"at random, seed {options.seed}, {twins}")
    if options.leave_one_theta_i_out:
        schemes[LEAVE_ONE_OUT] = Folds(split_by_incidence(raw, usable=usable), "one incident angle held out at a time")
    for name, folds in schemes.items():
        _check_rest(raw, report, folds, f"validate.{name}")
    return schemes


def has_direction(raw: RawSamples) -> Bool[np.ndarray, " row"]:
    """Mask of the rows whose direction is finite and above the horizon, but for rounding, whatever their values."""
    finite = np.isfinite(raw.theta_i) & np.isfinite(raw.theta_o) & np.isfinite(raw.phi_o)
    return finite & (raw.theta_o <= np.pi / 2 + HORIZON_TOLERANCE)


def split_at_random(
    raw: RawSamples, count: int, seed: int, *, usable: Bool[np.ndarray, " row"], mirror_twins: bool
) -> Int[np.ndarray, " row"]:
    """Deal the distinct directions, in random order, to `count` folds.

    Raises:
        UserError: There are fewer distinct directions than folds.
    """
    group = direction_groups(raw.take(usable), mirror_twins=mirror_twins)
    num_groups = int(group.max(initial=-1)) + 1
    if num_groups < count:
        raise UserError(f"validate.folds: found {count}; expected at most {num_groups}, the number of directions")
    dealt = np.empty(num_groups, int)
    dealt[np.random.default_rng(seed).permutation(num_groups)] = np.arange(num_groups) % count
    label = np.full(raw.num_samples, NO_FOLD)
    label[usable] = dealt[group]
    return label


def split_by_incidence(raw: RawSamples, *, usable: Bool[np.ndarray, " row"]) -> Int[np.ndarray, " row"]:
    """Label each row by its incident angle, from 0 in increasing order.

    Raises:
        UserError: There are fewer than 3 distinct incident angles.
    """
    theta_i, index = cluster_incidences(raw.theta_i[usable])
    if len(theta_i) < FEWEST_INCIDENCES:
        expected = f"expected at least {FEWEST_INCIDENCES} in {raw.source}"
        raise UserError(f"validate.{LEAVE_ONE_OUT}: found {len(theta_i)} distinct incident angles; {expected}")
    label = np.full(raw.num_samples, NO_FOLD)
    label[usable] = index
    return label


def direction_groups(samples: RawSamples, *, mirror_twins: bool) -> Int[np.ndarray, " sample"]:
    """Number the distinct directions from 0, each angle equal to within 1e-6 rad.

    At theta_o = 0 every azimuth is one direction.

    Args:
        samples: Samples with finite angles.
        mirror_twins: Whether phi_o and 2 pi - phi_o are one direction.
    """
    phi_o = fold_azimuth(samples.phi_o) if mirror_twins else samples.phi_o
    phi_o = np.where(samples.theta_o < SAME_DIRECTION, 0.0, phi_o)
    # cosine and sine, because 0 and 2 pi are one azimuth
    angles = np.stack([samples.theta_i, samples.theta_o, np.cos(phi_o), np.sin(phi_o)], axis=1)
    cells, first, cell = np.unique(
        np.round(angles / SAME_DIRECTION).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    near = KDTree(angles[first]).query_pairs(SAME_DIRECTION, p=np.inf, output_type="ndarray")  # across cell walls
    links = scipy.sparse.coo_array((np.ones(len(near), bool), (near[:, 0], near[:, 1])), shape=(len(cells),) * 2)
    return connected_components(links, directed=False)[1].astype(int)[cell.ravel()]


def read_fold_file(path: str, num_rows: int) -> Int[np.ndarray, " row"]:
    """Read the fold of every row of a measurement.

    Args:
        path: CSV whose header has the columns `row` and `fold`; other columns, empty lines
            and `#` comments are ignored. Rows count from 0 in file order and come in any order.
        num_rows: Rows of the measurement.

    Raises:
        UserError: No such file, a column or a row that is missing, a row twice or out of
            range, text that is no whole number of at least 0, or a single fold.
    """
    if not Path(path).is_file():
        raise UserError(f"validate.fold_file: {path}: found no such file; expected a CSV with the columns row,fold")
    label = np.full(num_rows, NO_FOLD)
    columns, number = None, 0
    for number, text in numbered_lines(Path(path)):
        words = [word.strip() for word in text.split(",")]
        if words == [""] or words[0].startswith("#"):
            continue
        if columns is None:
            columns = _columns(f"{path}:{number}", words)
            continue
        if len(words) <= max(columns):
            raise UserError(f"{path}:{number}: found {len(words)} columns; expected {max(columns) + 1} or more")
        row = _whole_number(f"{path}:{number}: row", words[columns[0]], num_rows - 1)
        fold = _whole_number(f"{path}:{number}: fold", words[columns[1]], LARGEST_LABEL)
        if label[row] != NO_FOLD:
            raise UserError(f"{path}:{number}: row: found {row} again; expected each row once")
        label[row] = fold
    where = f"{path}:{number}"
    if columns is None:
        raise UserError(f"{where}: found no header; expected the columns row,fold")
    missing = np.flatnonzero(label == NO_FOLD)
    if len(missing):
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise UserError(f"{where}: found no row {missing[0]}{more}; expected each of 0 to {num_rows - 1} once")
    if (label == label[0]).all():
        raise UserError(f"{where}: found the single fold {label[0]}; expected {FEWEST_FOLDS} folds or more")
    return label


def _columns(where: str, header: list[str]) -> tuple[int, int]:
    for name in ("row", "fold"):
        if header.count(name) != 1:
            found = shorten(",".join(header))
            raise UserError(f"{where}: header: found {found}; expected one column {name}, as in row,fold")
    return header.index("row"), header.index("fold")


def _whole_number(where: str, word: str, largest: int) -> int:
    digits = word.lstrip("0") or "0"
    if not (word.isascii() and word.isdigit()) or len(digits) > len(str(largest)) or int(digits) > largest:
        raise UserError(f"{where}: found {shorten(word)}; expected a whole number from 0 to {largest}")
    return int(digits)


def _check_rest(raw: RawSamples, report: CleanReport, folds: Folds, key: str) -> None:
    """Refuse a fold without which too few samples, or none that is positive, are left."""
    kept = (report.flag & np.uint16(DROPPED)) == 0
    positive = kept & (np.where(np.isfinite(raw.value), raw.value, 0.0) > 0).any(axis=1)
    for label in folds.labels:
        rest = folds.label != label
        for mask, fewest, what in (
            (kept, MIN_SAMPLES, "usable samples"),
            (positive, 1, "samples with a positive value"),
        ):
            left = int(np.sum(mask & rest))
            if left < fewest:
                raise UserError(f"{key}: found {left} {what} outside fold {label}; expected at least {fewest}")
