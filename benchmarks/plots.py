"""Pictures of records: error against time, the pipeline over its sizes, the roofline of the solver's step.

`python -m benchmarks.pages` draws them for the documentation.
"""

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.records import Record
from benchmarks.tables import USUAL, unique

MARKERS = "os^Dv*Pxph"
LEAST_SPAN = 12.0  # of a logarithmic axis, highest over lowest
DPI = 110  # many panels: below 150 kB
TITLE_SIZE = 9.5  # problems have long names
COLUMNS = 3  # panels side by side
NOT_DRAWN = ("cold start",)  # three numbers


def draw(records: list[Record], folder: str | Path) -> dict[str, Path]:
    """Draw a picture for every group that has something to draw; return the pictures by group."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    drawers = {"pipeline": draw_sizes, "roofline": draw_roofline}
    pictures = {}
    for group in unique(record.group for record in records if record.group not in NOT_DRAWN):
        some = [record for record in records if record.group == group]
        path = folder / f"benchmark_{group.replace(' ', '_')}.png"
        if drawers.get(group, draw_error_time)(some, path):
            pictures[group] = path
    return pictures


def draw_error_time(records: list[Record], path: Path) -> bool:
    """Draw error, or a solver's residual, against warm time: a panel for each problem, a line for each method."""
    from sbrdf_jax.report.style import style_context

    problems = unique(record.problem for record in records)
    is_solver = records[0].kkt_residual is not None
    with style_context():
        figure, panels = _panels(len(problems) * (1 + is_solver), columns=min(len(problems), COLUMNS))
        heights = ("kkt_residual", "error") if is_solver else ("error",)
        cells = [(height, problem) for height in heights for problem in problems]
        methods = unique(record.method for record in records)
        for axes, (height, problem) in zip(panels, cells, strict=True):
            some = [record for record in records if record.problem == problem]
            for method in methods:
                line = [(r.seconds_min, getattr(r, height)) for r in some if r.method == method]  # as the setting goes
                at = zip(*line, strict=True) if line else ((), ())
                axes.loglog(*at, **_look(methods.index(method)), label=method)
            axes.set(xlabel="seconds, warm")
            axes.set_title(problem, fontsize=TITLE_SIZE)
            axes.set_ylabel("relative KKT residual" if height == "kkt_residual" else _wrapped(some[0].error_kind))
            _few_ticks(axes)
        _save(figure, panels[0], path)
    return True


def draw_sizes(records: list[Record], path: Path) -> bool:
    """Draw warm time and peak memory against every size that is swept, log-log."""
    from sbrdf_jax.report.style import style_context

    methods = unique(record.method for record in records)
    sweeps = {what: {m: _sweep(records, m, what) for m in methods} for what in records[0].size}
    sweeps = {what: lines for what, lines in sweeps.items() if any(len(line) > 1 for line in lines.values())}
    if not sweeps:
        return False
    methods = [method for method in methods if any(len(lines[method]) > 1 for lines in sweeps.values())]
    with style_context():
        figure, panels = _panels(2 * len(sweeps), columns=len(sweeps), width=2.8)
        rows = (("seconds_min", 1, "seconds, warm"), ("peak_bytes", 2**30, "peak memory [GiB]"))
        cells = [(row, what) for row in rows for what in sweeps]
        for axes, ((name, unit, label), what) in zip(panels, cells, strict=True):
            for number, method in enumerate(methods):
                line = [(r.size[what], getattr(r, name) / unit) for r in sweeps[what][method]]
                axes.loglog(*(zip(*line, strict=True) if line else ((), ())), **_look(number), label=method)
            axes.set(xlabel=what, ylabel=label)
            _few_ticks(axes)
        _save(figure, panels[0], path)
    return True


def draw_roofline(records: list[Record], path: Path) -> bool:
    """Draw operations a second against operations for each byte: steps as points, below the roofs of the machine."""
    from sbrdf_jax.report.style import MUTED, style_context

    problems = unique(record.problem for record in records if record.method == "solver step")
    precisions = unique(record.precision for record in records)
    with style_context():
        figure, panels = _panels(len(problems), columns=COLUMNS, width=4.6)
        for axes, problem in zip(panels, problems, strict=True):
            for number, precision in enumerate(precisions):
                some = [record for record in records if record.precision == precision]
                (product,) = (r for r in some if r.method == "matrix product")
                copies = [r for r in some if r.method == "copy" and r.problem in (problem, product.problem)]
                look = _look(number)
                for copy, line in zip(copies, (":", "-"), strict=True):
                    at = np.geomspace(0.1, 100, 200)
                    roof = np.minimum(product.more["GFLOP/s"], at * copy.more["GB/s"])
                    label = f"roof, {precision}, copy of {copy.setting}"
                    axes.loglog(at, roof, color=look["color"], linestyle=line, linewidth=1.2, label=label)
                steps = [r for r in some if r.method == "solver step" and r.problem == problem]
                places = [(r.more["operations of a byte"], r.more["GFLOP/s"]) for r in steps]
                axes.loglog(*zip(*places, strict=True), **(look | {"linestyle": "none"}), label=f"step, {precision}")
                for record, place in zip(steps, places, strict=True):
                    where = {"xytext": (0, -11), "textcoords": "offset points", "ha": "center"}
                    axes.annotate(record.setting.split()[0], place, **where, fontsize=8, color=MUTED)
            axes.set(xlabel="operations for each byte")
            axes.set_title(f"{problem}; numbers: lanes", fontsize=TITLE_SIZE)
            axes.set_ylabel("1e9 operations a second")
        for axes in panels:
            axes.legend(fontsize=7.5, loc="lower right")
        _save(figure, None, path)
    return True


def _sweep(records: list[Record], method: str, what: str) -> list[Record]:
    """The records of a method over one size, in its order."""
    some = [r for r in records if r.method == method and (r.setting == USUAL or r.setting.startswith(what))]
    return sorted(some, key=lambda record: record.size[what])


def _panels(count: int, *, columns: int, width: float = 3.7) -> tuple[Any, list[Any]]:
    """A figure of so many panels, and these in reading order."""
    from sbrdf_jax.report.style import new_figure

    columns = min(columns, count)
    rows = -(-count // columns)
    figure = new_figure(max(width * columns, 6.0), 3.0 * rows + 0.9)
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for unused in panels[count:]:
        unused.remove()
    return figure, panels[:count]


def _look(number: int) -> dict[str, Any]:
    from sbrdf_jax.report.style import LINES, SERIES

    look = {"color": SERIES[number % len(SERIES)], "linestyle": LINES[number // len(SERIES) % len(LINES)]}
    return look | {"marker": MARKERS[number % len(MARKERS)], "markersize": 4.5, "linewidth": 1.2}


def _few_ticks(axes: Any) -> None:
    """Let an axis span a decade at least, and label 1, 2 and 5 where it spans little more.

    Less makes much of small differences, and labels at every digit overlap.
    """
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    limits = (axes.xaxis, axes.get_xlim(), axes.set_xlim), (axes.yaxis, axes.get_ylim(), axes.set_ylim)
    for axis, (low, high), set_limits in limits:
        margin = max((LEAST_SPAN * low / high) ** 0.5, 1.0)
        set_limits(low / margin, high * margin)
        if margin**2 * high / low < 30:
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(NullFormatter())


def _wrapped(text: str, width: int = 34) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, width))


def _save(figure: Any, legend_of: Any, path: Path) -> None:
    """Write a figure, with one legend for all panels below them where one panel is named that holds all labels."""
    from matplotlib import rc_context

    from sbrdf_jax.report.style import save_figure

    if legend_of is not None:
        figure.legend(*legend_of.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    with rc_context({"savefig.dpi": DPI}):
        save_figure(figure, path)
