"""Tables of records, a group each."""

from collections.abc import Iterable

import numpy as np

from benchmarks.records import Record

EXPONENT_FROM = 3  # points of a sweep
USUAL = "usual size"  # the setting that all sweeps of a problem share


def print_tables(records: list[Record]) -> None:
    """Print a table for every group and problem, and the exponents of the sweeps."""
    for group in unique(record.group for record in records):
        for problem in unique(record.problem for record in records if record.group == group):
            some = [record for record in records if (record.group, record.problem) == (group, problem)]
            sizes = ", ".join(f"{count} {what}" for what, count in some[0].size.items())
            print(f"\n{group}: {problem} ({sizes}); error: {some[0].error_kind}")
            print(HEAD)
            for record in some:
                print(row(record))
            for line in exponents(some):
                print(line)


HEAD = (
    f"{'method':<30} {'setting':>12} {'precision':>9} {'set-up s':>9} {'compile s':>9} {'warm s':>9} {'median s':>9} "
    f"{'spread s':>9} {'MiB':>6} {'KKT':>8} {'error':>9}"
)


def row(record: Record) -> str:
    """One line of a table."""
    residual = "" if record.kkt_residual is None else f"{record.kkt_residual:.1e}"
    more = "  ".join(f"{name} {value:.4g}" for name, value in record.more.items())
    return (
        f"{record.method:<30} {record.setting:>12} {record.precision:>9} {record.set_up_seconds:>9.3f} "
        f"{record.compile_seconds:>9.2f} {record.seconds_min:>9.4f} {record.seconds_median:>9.4f} "
        f"{record.seconds_spread:>9.4f} {record.peak_bytes / 2**20:>6.0f} {residual:>8} {record.error:>9.3g}  {more}"
    )


def exponents(records: list[Record]) -> Iterable[str]:
    """Lines with the fitted exponents of time and memory over every size that a method's records sweep.

    A sweep is the records whose setting names the size, and the usual one. Its largest few count.
    """
    for method in unique(record.method for record in records):
        some = [record for record in records if record.method == method]
        for what in some[0].size:
            swept = [record for record in some if record.setting == USUAL or record.setting.startswith(what)]
            swept = sorted(swept, key=lambda record: record.size[what])[-EXPONENT_FROM:]
            if len({record.size[what] for record in swept}) >= EXPONENT_FROM:
                size = np.log([record.size[what] for record in swept])
                time, memory = (
                    np.polyfit(size, np.log([getattr(record, name) for record in swept]), 1)[0]
                    for name in ("seconds_min", "peak_bytes")
                )
                yield f"{method}: over {what}, exponent of the warm time {time:.2f}, of the peak memory {memory:.2f}"


def unique(names: Iterable[str]) -> list[str]:
    """Names in their order, once each."""
    return list(dict.fromkeys(names))
