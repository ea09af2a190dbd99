"""The documentation's page of benchmarks: python -m benchmarks.pages FILE.jsonl ... [--output docs/benchmarks.md].

FILE: what `python -m benchmarks --output`, `python -m benchmarks.stability --output` and the fuzzing of
`scripts/nightly.sh --fuzz-records` have written, on one machine or on several. Of several runs on one device, the
last file that has a group gives it; where two devices have it, a table sets them side by side. Pictures go into
the folder `images` beside the page; the README's table, between its two marks, is the quick suite's.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.page_texts import INTRODUCTION, SECTIONS
from benchmarks.plots import draw
from benchmarks.records import Record, read_runs
from benchmarks.tables import exponents, unique

MARKS = ("<!-- quick suite: begin, made by python -m benchmarks.pages -->", "<!-- quick suite: end -->")
SECONDS_HEAD = ("set-up s", "compile s", "warm s", "median s", "spread s")
HEAD = ("method", "setting", "precision", *SECONDS_HEAD, "MiB", "KKT", "error")
README_HEAD = ("what", "method", "setting", "precision", "warm s", "MiB", "KKT", "error")

Run = dict[str, Any]
Found = list[tuple[Record, Run]]


def read(paths: list[Path]) -> tuple[Found, dict[str, list[Run]]]:
    """Read records, each with its run, and the lines of other tables by name."""
    found: Found = []
    tables: dict[str, list[Run]] = {}
    for path in paths:
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        if lines and "table" in lines[0]:
            tables[lines[0]["table"]] = lines
        else:
            found += read_runs(path)
    return found, tables


def newest(found: Found) -> Found:
    """Of every group and device, the records of the last run that has some."""
    last = {(record.group, run["device"]): run["created_utc"] for record, run in found}
    return [(record, run) for record, run in found if last[record.group, run["device"]] == run["created_utc"]]


def page(found: Found, tables: dict[str, list[Run]], pictures: dict[str, Path]) -> Iterator[str]:
    """Yield the page's parts."""
    yield "# Benchmarks"
    yield INTRODUCTION
    runs = {run["created_utc"]: run for _, run in found}
    yield "\n".join(f"- {described(run, found)}" for run in runs.values())
    for group in [name for name in SECTIONS if any(record.group == name for record, _ in found)]:
        yield from section(group)
        if group in pictures:
            yield f"![{SECTIONS[group][0]}](images/{pictures[group].name})"
        for device in unique(run["device"] for record, run in found if record.group == group):
            yield from tables_of([r for r, run in found if (r.group, run["device"]) == (group, device)], device)
        yield from compared([(record, run) for record, run in found if record.group == group])
    yield from stability(tables.get("stability", []))
    yield from fuzzing(tables.get("fuzzing", []))


def section(name: str) -> tuple[str, str]:
    """Title and text of a section."""
    title, text = SECTIONS[name]
    return f"## {title}", text


def described(run: Run, found: Found) -> str:
    """One line on a run: what, where, by which versions."""
    groups = ", ".join(unique(record.group for record, its in found if its["created_utc"] == run["created_utc"]))
    versions = ", ".join(f"{name} {version}" for name, version in run["versions"].items())
    where = f"{run['cpu']}, {run['threads']} threads, JAX on {run['device']}, load {run['load']} at the start"
    return f"{groups}: suite {run['suite']}, commit {run['commit']}, {where}; Python {run['python']}, {versions}"


def tables_of(records: list[Record], device: str) -> Iterator[str]:
    """Yield a table for each problem of a group, and its exponents."""
    for problem in unique(record.problem for record in records):
        some = [record for record in records if record.problem == problem]
        swept = [name for name in some[0].size if len({record.size.get(name) for record in some}) > 1]
        fixed = [f"{count} {name}" for name, count in some[0].size.items() if name not in swept]
        extra = unique(name for record in some for name in record.more)
        yield f"**{problem}**, on {device}{''.join(f', {text}' for text in fixed)}; error: {some[0].error_kind}"
        rows = []
        for record in some:
            sizes = (record.size.get(name, "") for name in swept)
            rows.append((*cells(record), *sizes, *(number(record.more.get(name)) for name in extra)))
        yield table((*HEAD, *swept, *extra), rows)
        if lines := list(exponents(some)):
            yield "\n".join(f"- {line}" for line in lines)
        if lines := list(threads(some)):
            yield "\n".join(f"- {line}" for line in lines)


def cells(record: Record) -> tuple[str, ...]:
    """What every record holds."""
    seconds = (record.set_up_seconds, record.compile_seconds, record.seconds_min)
    seconds = (*seconds, record.seconds_median, record.seconds_spread)
    memory = f"{record.peak_bytes / 2**20:.0f}"
    last = (memory, number(record.kkt_residual), number(record.error))
    return (record.method, record.setting, record.precision, *map(number, seconds), *last)


def threads(records: list[Record]) -> Iterator[str]:
    """Lines on processes of other numbers of threads beside that of one, of the same size."""
    for record in records:
        method, _, count = record.method.partition(", ")
        alone = [other for other in records if (other.method, other.size) == (f"{method}, 1 thread", record.size)]
        if record.setting.startswith("threads") and alone:
            yield f"{method}: {count} {alone[0].seconds_min / record.seconds_min:.2f} times as fast as 1"


def compared(found: Found) -> Iterator[str]:
    """Yield a table of the same work on two devices: seconds of each, and the multiple."""
    devices = unique(run["device"] for _, run in found)
    if len(devices) < 2:
        return
    seconds: dict[tuple[str, ...], dict[str, float]] = {}
    for record, run in found:
        key = (record.problem, record.method, record.setting, record.precision)
        seconds.setdefault(key, {})[run["device"]] = record.seconds_min
    rows = []
    for key, by_device in seconds.items():
        if devices[0] in by_device and len(by_device) > 1:
            times = [by_device.get(device) for device in devices]
            ratios = [times[0] / other if other else None for other in times[1:]]
            rows.append((*key, *map(number, times), *map(number, ratios)))
    yield f"The same on {' and '.join(devices)}: warm seconds, and how many times as fast as the first."
    ratio_head = (f"{device}, times as fast" for device in devices[1:])
    yield table(("problem", "method", "setting", "precision", *devices, *ratio_head), rows)


def stability(lines: list[Run]) -> Iterator[str]:
    """Yield the section on hostile measurements."""
    if not lines:
        return
    yield from section("stability")
    head = ("problem", "method", "condition", "KKT", "error", "median error", "limit", "status", "honest")
    yield table(head, [tuple(_plain(line.get(name)) for name in head) for line in lines])


def fuzzing(lines: list[Run]) -> Iterator[str]:
    """Yield the section on damaged files."""
    if not lines:
        return
    yield from section("fuzzing")
    head = ("reader", "inputs", "wrong", "seconds")
    yield table(head, [tuple(_plain(line[name]) for name in head) for line in lines])


def quick_table(found: Found) -> str:
    """The README's table: the quick suite, fewer columns."""
    rows = []
    for record, _ in found:
        method, setting, precision, *_ = cells(record)
        last = (number(record.seconds_min), *cells(record)[-3:])
        rows.append((f"{record.group}: {record.problem}", method, setting, precision, *last))
    kinds = unique((record.group, record.error_kind) for record, _ in found)
    errors = "; ".join(f"{group}: {kind}" for group, kind in kinds)
    _, run = found[0]
    where = f"{run['cpu']}, {run['threads']} threads, load {run['load']} at the start, commit {run['commit']}"
    return f"{table(README_HEAD, rows)}\n\nErrors are, in {errors}. Measured on {where}."


def with_quick_table(readme: str, found: Found) -> str:
    """Put the quick suite's table between its marks.

    Raises:
        ValueError: The marks are not there, once each and in order.
    """
    begin, end = MARKS
    before, found_begin, rest = readme.partition(begin)
    _, found_end, after = rest.partition(end)
    if not (found_begin and found_end):
        raise ValueError(f"README: found no marks, expected {begin} and {end}")
    return f"{before}{begin}\n\n{quick_table(found)}\n\n{end}{after}"


def table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    """A table in Markdown, without the columns that are empty throughout."""
    kept = [k for k in range(len(head)) if any(str(row[k]) for row in rows)]
    lines = [[head[k] for k in kept], ["---"] * len(kept), *([str(row[k]) for k in kept] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number(value: float | None) -> str:
    """Three digits, or nothing."""
    if value is None:
        return ""
    return f"{value:.1e}" if value and not 1e-3 <= abs(value) < 1e5 else f"{value:.3g}"


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return number(value) if isinstance(value, float) else "" if value is None else str(value)


def main() -> None:
    """Write the page, its pictures and the README's table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, help="JSON lines")
    parser.add_argument("--output", type=Path, default=Path("docs/benchmarks.md"), help="the page")
    parser.add_argument("--readme", type=Path, help="a README whose marked table is made anew")
    args = parser.parse_args()
    found, tables = read(args.files)
    quick = newest([(record, run) for record, run in found if run["suite"] == "quick"])
    if args.readme and quick:
        args.readme.write_text(with_quick_table(args.readme.read_text(), quick))
        print(args.readme)
    found = newest(found)
    first = found[0][1]["device"] if found else ""
    pictures = draw([record for record, run in found if run["device"] == first], args.output.parent / "images")
    args.output.write_text("\n\n".join(page(found, tables, pictures)) + "\n")
    print(*pictures.values(), args.output, sep="\n")


if __name__ == "__main__":
    main()
