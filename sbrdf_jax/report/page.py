"""One self-contained page of one or more results: tables, warnings, embedded figures; offline, light or dark."""

import base64
import html
import os
from collections.abc import Sequence
from pathlib import Path

from sbrdf_jax.cleaning import clean
from sbrdf_jax.config import parse_config
from sbrdf_jax.errors import UserError
from sbrdf_jax.files import whole_file
from sbrdf_jax.formats import read
from sbrdf_jax.records import RawSamples
from sbrdf_jax.report.figures import Drawing, draw
from sbrdf_jax.store import RunResult
from sbrdf_jax.summary import (
    Table,
    cleaning_table,
    done_table,
    error_table,
    input_table,
    status_table,
    time_table,
    validation_table,
)

STYLE = """
:root { color-scheme: light dark; --ink: #1f2328; --muted: #59636e; --line: #d7dbe0; --page: #f6f7f9; --card: #ffffff;
  --accent: #0072B2; --warn: #8a4b00; --warn-page: #fff4e0; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e9ed; --muted: #9aa4b0; --line: #343b44; --page: #14171b;
  --card: #1d2126; --accent: #56B4E9; --warn: #ffcf8a; --warn-page: #33270f; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
main { max-width: 68rem; margin: 0 auto; padding: 1.5rem 1rem 4rem; }
h1 { font-size: 1.7rem; margin: 0 0 .25rem; } h2 { font-size: 1.35rem; margin: 2.5rem 0 .5rem; }
h3 { font-size: 1.05rem; margin: 0 0 .5rem; } p { margin: .25rem 0 .75rem; } a { color: var(--accent); }
.muted, figcaption, .note { color: var(--muted); font-size: .92rem; }
nav { margin: 1rem 0; } nav a { margin-right: 1rem; white-space: nowrap; }
.card, figure { background: var(--card); border: 1px solid var(--line); border-radius: .6rem; padding: 1rem;
  margin: 0 0 1rem; overflow-x: auto; }
.warnings { background: var(--warn-page); color: var(--warn); } .warnings ul { margin: 0; padding-left: 1.2rem; }
.tables { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); gap: 0 1rem; }
.tables .wide { grid-column: 1 / -1; }
table { border-collapse: collapse; width: 100%; font-size: .93rem; }
th, td { text-align: left; vertical-align: top; padding: .25rem .6rem .25rem 0; border-bottom: 1px solid var(--line); }
th { color: var(--muted); font-weight: 600; } tr:last-child td { border-bottom: 0; }
td:first-child { white-space: nowrap; }
.numeric th:not(:first-child), .numeric td:not(:first-child) { text-align: right; font-variant-numeric: tabular-nums; }
figure img { display: block; width: 100%; height: auto; max-width: 60rem; margin: .25rem auto .75rem;
  border-radius: .4rem; background: #ffffff; }
details pre { overflow-x: auto; font-size: .85rem; }
""".strip()


def write_page(
    results: Sequence[tuple[str, RunResult]], folder: str | os.PathLike[str], samples: RawSamples | None = None
) -> Path:
    """Write the figures of one or more results and a page that shows them.

    Args:
        results: Name and result of each.
        folder: Where index.html and the figures go; made if it is absent.
        samples: The cleaned samples of a single result; without them each source is read again where it is unchanged.

    Returns:
        The page.

    Raises:
        UserError: The folder cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made: {error.strerror}, expected a folder for the report") from error
    sections, names = [], unique_names([name for name, _ in results])
    for name, (_, result) in zip(names, results, strict=True):
        shown, missing = (samples, "") if samples is not None and len(results) == 1 else cleaned_samples(result)
        drawings = draw(result, folder, shown, prefix=f"{name}_" if len(results) > 1 else "")
        sections.append(section(name, result, drawings, missing))
    page = folder / "index.html"
    with whole_file(page) as temporary:
        Path(temporary).write_text(document(names, sections), encoding="utf-8")
    return page


def unique_names(names: Sequence[str]) -> list[str]:
    """Names fit for files and links, each once: a second "glass" becomes "glass-2"."""
    found: list[str] = []
    for name in names:
        plain = "".join(c if c.isalnum() or c in "-_." else "-" for c in name) or "result"
        count = 1
        while (candidate := plain if count == 1 else f"{plain}-{count}") in found:
            count += 1
        found.append(candidate)
    return found


def cleaned_samples(result: RunResult) -> tuple[RawSamples | None, str]:
    """Return the cleaned samples behind a result, or None and a sentence that says why there are none."""
    if not result.config:
        return None, "The result holds no config, so its samples are not shown."
    options = parse_config(result.config, name="config of the result")
    try:
        raw = read(options.input.path, options.input)
    except UserError as error:
        return None, f"The samples are not shown, because their source cannot be read: {error}"
    if raw.source_sha256 != result.source_sha256:
        return None, f"The samples are not shown, because {options.input.path} has changed since the result was made."
    return clean(raw, bilateral=options.input.bilateral, method=options.resample.method).samples, ""


def section(name: str, result: RunResult, drawings: Sequence[Drawing], missing: str) -> str:
    """The part of the page that belongs to one result."""
    source = html.escape(str(result.input.get("source", "")))
    made = " · ".join(html.escape(text) for text in (result.created_utc, version_text(result)) if text)
    warnings = [*result.warnings, *(warning for drawing in drawings for warning in drawing.warnings)]
    tables = "".join(table_html(table) for table in (input_table(result), done_table(result)) if table.rows)
    wide = (error_table(result), validation_table(result), cleaning_table(result))
    tables += "".join(table_html(table, wide=True) for table in wide if table.rows)
    tables += "".join(table_html(table) for table in (status_table(result), time_table(result)) if table.rows)
    figures = "".join(figure_html(drawing) for drawing in drawings)
    return (
        f'<section id="{html.escape(name)}"><h2>{html.escape(name)}</h2><p class="muted">{source} · {made}</p>'
        f"{warnings_html(warnings)}"
        f'<div class="tables">{tables}</div>'
        f"{f'<p class=note>{html.escape(missing)}</p>' if missing else ''}{figures}"
        f'<details class="card"><summary>Resolved config</summary><pre>{html.escape(result.config)}</pre></details>'
        "</section>"
    )


def version_text(result: RunResult) -> str:
    """Versions in a line."""
    return ", ".join(f"{name} {version}" for name, version in result.versions.items())


def warnings_html(warnings: Sequence[str]) -> str:
    """A box of warnings, or nothing."""
    if not warnings:
        return ""
    items = "".join(f"<li>{html.escape(warning)}</li>" for warning in warnings)
    return f'<div class="card warnings"><h3>Warnings</h3><ul>{items}</ul></div>'


def table_html(table: Table, *, wide: bool = False) -> str:
    """One table in a card."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in table.header) if any(table.header) else ""
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in table.rows)
    note = f'<p class="note">{html.escape(table.note)}</p>' if table.note else ""
    kinds = " ".join(kind for kind, is_so in (("card", True), ("wide", wide), ("numeric", table.numeric)) if is_so)
    return (
        f'<div class="{kinds}"><h3>{html.escape(table.title)}</h3>'
        f"<table>{f'<thead><tr>{head}</tr></thead>' if head else ''}<tbody>{body}</tbody></table>{note}</div>"
    )


def figure_html(drawing: Drawing) -> str:
    """One figure, embedded, with its caption."""
    data = base64.b64encode(drawing.path.read_bytes()).decode("ascii")
    return (
        f'<figure id="{html.escape(drawing.path.stem)}"><h3>{html.escape(drawing.title)}</h3>'
        f'<img alt="{html.escape(drawing.title)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(drawing.caption)}</figcaption></figure>"
    )


def document(names: Sequence[str], sections: Sequence[str]) -> str:
    """The whole page."""
    links = "".join(f'<a href="#{html.escape(name)}">{html.escape(name)}</a>' for name in names)
    navigation = f"<nav>{links}</nav>" if len(names) > 1 else ""
    title = names[0] if len(names) == 1 else f"{len(names)} results"
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)} · sbrdf_jax</title><style>{STYLE}</style></head>"
        '<body><main><h1>Spectral BRDF report</h1><p class="muted">Angles in degrees, wavelengths in nm, BRDF in 1/sr; '
        f"the mirror direction is at φ = 180°.</p>{navigation}{''.join(sections)}</main></body></html>\n"
    )
