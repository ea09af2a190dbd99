"""What a result says in tables: what came in, what was done, errors per incident angle, seconds per stage.

The same tables are printed at the end of a run and shown on the report's page.
"""

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np

from sbrdf_jax.folds import LEAVE_ONE_OUT
from sbrdf_jax.lobes import LOBE_KINDS
from sbrdf_jax.progress import format_seconds
from sbrdf_jax.records import STATUS_TEXT, CompactBRDF, LobeHarmonics, LobeTensor, Status
from sbrdf_jax.representation.lobe_family import SHAPES
from sbrdf_jax.store import RunResult

ERROR_COLUMNS = (
    ("relative_error", "eta %", 100.0),
    ("relative_error_between", "between %", 100.0),
    ("relative_error_near_mirror", "mirror %", 100.0),
    ("error_spectral", "spectral %", 100.0),
    ("error_background", "background %", 100.0),
    ("error_lobe", "lobe %", 100.0),
    ("median_relative_error", "median %", 100.0),
    ("delta_e_median", "Delta E", 1.0),
)

SCORE_COLUMNS = (
    ("median_rel", "median %", 100.0),
    ("p90_rel", "90th %", 100.0),
    ("calm_l2", "calm L2 %", 100.0),
    ("log_rms", "log RMS", 1.0),
    ("rel_l2", "L2 %", 100.0),
    ("negative_share", "negative %", 100.0),
)


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of text under a title; the first column is a name, the others are right-aligned where `numeric`."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    numeric: bool = False


def summary_text(result: RunResult) -> str:
    """Return the whole summary as plain text."""
    tables = [input_table(result), done_table(result), error_table(result), validation_table(result)]
    tables.append(time_table(result))
    parts = [table_text(table) for table in tables if table.rows]
    if result.warnings:
        parts.append("Warnings\n" + "\n".join(f"  {warning}" for warning in result.warnings))
    return "\n\n".join(parts)


def table_text(table: Table) -> str:
    """Return one table as aligned text."""
    lines = [row for row in (table.header, *table.rows) if any(row)]
    widths = [max(len(row[k]) for row in lines) for k in range(len(table.rows[0]))]
    text = [table.title]
    for row in lines:
        cells = [row[0].ljust(widths[0])]
        for cell, width in zip(row[1:], widths[1:], strict=True):
            cells.append(cell.rjust(width) if table.numeric else cell.ljust(width))
        text.append("  " + "  ".join(cells).rstrip())
    return "\n".join(text + ([f"  {table.note}"] if table.note else []))


def input_table(result: RunResult) -> Table:
    """What came in, and what cleaning made of it."""
    rows = [(name.replace("_", " "), str(result.input[name])) for name in ("source", "format") if name in result.input]
    if "quantity" in result.input:
        unit = "BRDF [1/sr]" if result.input["quantity"] == "brdf" else "proportional to a BRDF"
        rows.append(("values", unit))
    wavelength = np.asarray(result.gridded.wavelength_nm)
    rows.append(("wavelengths", f"{len(wavelength)}, {wavelength[0]:g} to {wavelength[-1]:g} nm"))
    if result.clean is not None:
        rows.append(("samples", f"{result.clean.num_kept} of {result.clean.num_rows} kept"))
        for done, name, count in cleaning_counts(result):
            rows.append((done, str(count) if name == done else f"{count} {name}"))
    rows += [("note", note) for note in result.input.get("notes", ())]
    return Table("What came in", ("", ""), tuple(rows))


def cleaning_counts(result: RunResult) -> list[tuple[str, str, int]]:
    """(what was done, flag, number of samples) of every flag that some sample has."""
    if result.clean is None:
        return []
    return [(entry.action, entry.name, entry.rows) for entry in result.clean.entries if entry.rows]


def cleaning_table(result: RunResult) -> Table:
    """Every reason for which a sample was dropped, clipped, folded or flagged, with its count."""
    entries = () if result.clean is None else [entry for entry in result.clean.entries if entry.rows]
    rows = [(entry.action, entry.name, str(entry.rows), entry.reason) for entry in entries]
    return Table("Cleaning", ("", "flag", "samples", "reason"), tuple(rows))


def done_table(result: RunResult) -> Table:
    """What was done: the grid and its certificate, the encoding, the compact form and its lanes."""
    grid = result.gridded
    sizes = " x ".join(str(n) for n in np.shape(grid.brdf))
    folded = "phi_o folded" if grid.bilateral else "phi_o all round"
    axes = f"{sizes} (theta_i, theta_o, phi_o, wavelength)"
    rows = [("grid", f"{axes}, method {grid.method}, {folded}, window {grid.window}")]
    if not grid.interpolate_theta_i:
        rows.append(("", "theta_i as measured, nothing interpolated over it"))
    residual = np.asarray(grid.kkt_residual, float)
    residual, steps = np.max(residual[np.isfinite(residual)], initial=0.0), int(np.max(np.asarray(grid.num_steps)))
    certificate = f"KKT residual at most {residual:.1e}, at most {steps} steps"
    rows.append(("solver", f"{certificate}; {count_statuses(grid.status)}"))
    rows.append(("nodes", coverage_text(grid.extrapolated)))
    if result.field is not None:
        basis = result.field.basis
        rows.append(("spectra", f"{np.shape(basis.synthesis)[0]} coefficients, basis {basis.kind}"))
    if result.compact is not None:
        rows.append(("compact", compact_text(result.compact)))
        found = result.plan.get("represent", {})
        if "promised" in found:
            rows.append(("target", f"{found['promised']}; measured: {found['measured']}"))
        rows += [("", f"{method}: {text}") for method, text in found.get("tried", {}).items()]
        rows.append(("lanes", count_statuses(result.compact.status)))
    ratios = [(name, text) for name, text in RATIOS if name in result.metrics]
    if ratios:
        rows.append(("size", ", ".join(f"{float(result.metrics[name]):.4g}:1 {text}" for name, text in ratios)))
    if result.compact is not None and "stored_bytes" in result.metrics:
        rows.append(("", storage_text(result)))
    for stage, suffix in (("grid", "_grid"), ("compact", "")):
        if f"negative_share{suffix}" in result.metrics:
            share, depth = (float(result.metrics[f"negative_{what}{suffix}"]) for what in ("share", "depth"))
            rows.append(
                (f"{stage} < 0", f"{100 * share:.2g} % of values off the nodes, deepest {0.0 - depth:.2g} 1/sr")
            )
    return Table("What was done", ("", ""), tuple(rows))


def compact_text(compact: CompactBRDF | LobeHarmonics | LobeTensor) -> str:
    """What a compact form is made of."""
    if isinstance(compact, LobeTensor):
        *ranks, count = np.shape(compact.core)
        sizes = " x ".join(map(str, ranks))
        return f"lobe tensor of ranks {sizes} (theta_i, theta_o, direction), {count} x {compact.basis.kind} spectra"
    if isinstance(compact, LobeHarmonics):
        count = np.shape(compact.degree)[1]
        lobes = lobe_counts(SHAPES[int(kind)] for kind in np.ravel(compact.lobe_kind) if kind)
        degree = int(np.max(compact.degree))
        harmonics = f"even harmonics up to L = {degree}" if degree >= 0 else "no harmonics"
        return f"{harmonics}; lobes: {lobes}; {count} x {compact.basis.kind} spectra"
    lobes = lobe_counts(LOBE_KINDS[int(kind)] for kind in np.ravel(compact.lobe_kind))
    return f"harmonics up to L = {compact.max_degree}; lobes: {lobes}"


def lobe_counts(kinds: Iterable[str]) -> str:
    """How many lobes there are of each kind."""
    return ", ".join(f"{count} {kind}" for kind, count in Counter(kinds).most_common()) or "none"


RATIOS = (
    ("compression_ratio", "with every stored number"),
    ("compression_ratio_paper", "as the paper counts (mirror images and pole copies of the data counted)"),
)


def storage_text(result: RunResult) -> str:
    """How many bytes the compact form takes, and what its storage adds to its error."""
    assert result.compact is not None
    worst = np.nanmax(np.asarray(result.metrics["storage_error"]), initial=0.0)
    rounding = f", whose rounding adds at most {_number(100 * float(worst))} %" if worst > 0 else ""
    return f"{int(result.metrics['stored_bytes'])} bytes as {result.compact.storage}{rounding}"


def coverage_text(extrapolated) -> str:
    """Shares of nodes by what stands behind them."""
    flags = np.asarray(extrapolated)
    names = ("measured nearby", "interpolated", "beyond the measured range")
    return ", ".join(f"{100 * (flags == k).mean():.3g} % {name}" for k, name in enumerate(names))


def count_statuses(status) -> str:
    """Count lanes by how they ended: "212 ok, 35 no_lobe"."""
    counts = Counter(Status(int(value)).name.lower() for value in np.ravel(np.asarray(status)))
    return ", ".join(f"{count} {name}" for name, count in counts.most_common())


def error_table(result: RunResult) -> Table:
    """Errors of the compact form for every incident angle, however bad."""
    columns = [column for column in ERROR_COLUMNS if column[0] in result.metrics]
    flags = np.asarray(result.gridded.extrapolated)
    rows = []
    for index, angle in enumerate(np.degrees(result.gridded.theta_i)) if columns else ():
        star = " *" if (flags[index] == 2).all() else ""
        values = [_number(scale * float(result.metrics[name][index])) for name, _, scale in columns]
        rows.append((f"{angle:.4g}{star}", *values))
    overall = [result.metrics.get(f"{name}_overall") for name, _, _ in columns]
    if any(value is not None for value in overall):
        texts = [
            "" if value is None else _number(scale * float(value))
            for value, (_, _, scale) in zip(overall, columns, strict=True)
        ]
        rows.append(("all", *texts))
    note = "* no sample at this incident angle: extrapolated" if any("*" in row[0] for row in rows) else ""
    header = ("theta_i [deg]", *(title for _, title, _ in columns))
    return Table("Errors of the compact form against the grid, per incident angle", header, tuple(rows), note, True)


def validation_table(result: RunResult) -> Table:
    """Scores of held-out predictions, over everything and by half angle, for each way of holding out."""
    rows, covered = [], []
    for group, name in (("", "folds, {} fits"), (f"{LEAVE_ONE_OUT}/", "one theta_i out, {} fits")):
        if f"{group}scores/count" not in result.validation:
            continue
        num_fits = len(result.validation[f"{group}status"])
        rows.append((name.format(num_fits), *_score_cells(result.validation, f"{group}scores")))
        lower, upper = (result.validation[f"{group}half_angle/{edge}_deg"] for edge in ("lower", "upper"))
        for k in range(len(lower)):
            cells = _score_cells(result.validation, f"{group}half_angle", k)
            rows.append((f"  half angle {lower[k]:g} to {upper[k]:g} deg", *cells))
        if f"{group}scores/coverage" in result.validation:
            share = 100 * float(result.validation[f"{group}scores/coverage"])
            covered.append(f"{share:.1f} % of {name.format(num_fits)}")
    header = ("held out", "samples", *(title for _, title, _ in SCORE_COLUMNS))
    note = "median and 90th: of |error| / value above 1e-3; calm L2: without the 5 % of rows of most energy"
    if covered:
        note += f"; within one expected error (68 % is honest): {', '.join(covered)}"
    return Table("Held-out predictions", header, tuple(rows), note, True)


def _score_cells(validation: Mapping[str, np.ndarray], group: str, index: int | tuple = ()) -> list[str]:
    values = [(float(np.asarray(validation[f"{group}/{name}"])[index]), scale) for name, _, scale in SCORE_COLUMNS]
    return [str(int(validation[f"{group}/count"][index])), *(_number(scale * value) for value, scale in values)]


def status_table(result: RunResult) -> Table:
    """How every lane ended, with what it means."""
    rows = []
    lanes = {"wavelengths of the grid": result.gridded.status}
    if result.compact is not None:
        lanes["lanes of the compact form"] = result.compact.status
    for name, status in lanes.items():
        values, counts = np.unique(np.asarray(status), return_counts=True)
        for value, count in zip(values, counts, strict=True):
            known = Status(int(value))
            rows.append((f"{count} {name}", known.name.lower(), STATUS_TEXT[known]))
    return Table("Statuses", ("", "status", "meaning"), tuple(rows))


def time_table(result: RunResult) -> Table:
    """Seconds per stage, compilation apart."""
    stages = {name: value for name, value in result.timing.items() if isinstance(value, Mapping) and "total" in value}
    columns = ("total", "compile", "run")
    rows = [(name.replace("_", " "), *(_seconds(stage.get(c)) for c in columns)) for name, stage in stages.items()]
    if rows:
        rows.append(("all", *(_seconds(_total(stages.values(), column)) for column in columns)))
    return Table("Time", ("stage", *columns), tuple(rows), numeric=True)


def _total(stages: Iterable[Mapping], column: str) -> float:
    return sum(float(stage.get(column, 0.0)) for stage in stages)


def _seconds(value) -> str:
    return "" if value is None else format_seconds(float(value))


def _number(value: float) -> str:
    if not np.isfinite(value):
        return "-" if np.isnan(value) else "inf"
    return f"{value:.3g}" if abs(value) >= 1e-3 or value == 0 else f"{value:.1e}"
