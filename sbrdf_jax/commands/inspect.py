"""`sbrdf inspect`: what a measurement or a result is, what it covers, what is doubtful in it."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sbrdf_jax.records import RawSamples

SUMMARY = "what a measurement or a result is: coverage and quality flags, or shapes, statuses and errors"
EXAMPLE = """\
examples:
  sbrdf inspect my_material.brdf
  sbrdf inspect results/quickstart.h5
  sbrdf inspect builtin:amber_glass
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("file", metavar="FILE", help="a raw measurement or a result")


def run(args: argparse.Namespace) -> int:
    """Print what the file is; exit code 0."""
    from sbrdf_jax.formats import is_result, read
    from sbrdf_jax.options import InputOptions

    if is_result(Path(args.file)):
        from sbrdf_jax.store import describe

        print("\n".join(describe(args.file)))
        return 0
    print("\n".join(describe_measurement(read(args.file, InputOptions(path=args.file)))))
    return 0


def describe_measurement(raw: "RawSamples") -> list[str]:
    """Return the lines that say what a measurement is, covers, lacks, and what is doubtful in it."""
    import numpy as np

    from sbrdf_jax.cleaning import clean

    result = clean(raw)
    report, coverage = result.report, result.report.coverage
    value = result.samples.value[np.isfinite(result.samples.value)]
    unit = "BRDF [1/sr]" if raw.quantity == "brdf" else "values proportional to BRDF"
    folds = "on" if report.bilateral else "off for method paper (both half-planes are measured), on for the others"
    lines = [
        f"{raw.source}: a measurement, format {raw.source_format}, {unit}",
        f"  {raw.num_samples} samples x {_wavelengths(raw.wavelength_nm)}",
        f"  values {value.min():.3g} to {value.max():.3g}, median {np.median(value):.3g}",
        *(f"  {line}" for line in coverage.covered),
        f"  folding of |phi_o| (input.bilateral: auto): {folds}",
        *(f"  note: {note}" for note in raw.notes),
        "not covered (the grid is extrapolated there, and says so):" if coverage.missing else "nothing is missing",
        *(f"  {line}" for line in coverage.missing),
        "quality:",
        *(f"  {line}" for line in report.lines()),
    ]
    if not any(entry.rows for entry in report.entries if entry.action != "folded"):
        lines.append("  nothing was dropped, clipped or flagged")
    return lines


def _wavelengths(wavelength_nm) -> str:
    """Count, range and step of the wavelengths."""
    import numpy as np

    count, step = len(wavelength_nm), np.diff(wavelength_nm)
    if count == 1:
        return f"1 wavelength, {wavelength_nm[0]:g} nm"
    uniform = np.ptp(step) <= 1e-6 * step.mean()
    by = f"by {step.mean():g} nm" if uniform else "unevenly spaced"
    return f"{count} wavelengths, {wavelength_nm[0]:g} to {wavelength_nm[-1]:g} nm {by}"
