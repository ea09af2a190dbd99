"""`sbrdf evaluate`: values of a result at given directions, CSV in and CSV out."""

import argparse
from pathlib import Path

from sbrdf_jax.direction_file import COLUMNS, read_directions

SUMMARY = "values of a result [1/sr] at the directions of a CSV file"
EXAMPLE = """\
example:
  sbrdf evaluate results/quickstart.h5 --at directions.csv --stage compact --output values.csv

directions.csv:
  theta_i_deg,theta_o_deg,phi_o_deg
  30,30,180
"""

ROWS_AT_A_TIME = 8192


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("result", metavar="RESULT.h5", help="a result of sbrdf run")
    parser.add_argument("--at", required=True, metavar="DIRECTIONS.csv", help=f"directions, header {','.join(COLUMNS)}")
    parser.add_argument("--stage", required=True, choices=("grid", "compact"), help="which form of the result")
    parser.add_argument("--output", required=True, metavar="VALUES.csv", help="the file to write")
    parser.add_argument("--wavelengths", metavar="NM,NM,...", help="in the measured range; if absent, those measured")
    parser.add_argument("--uncertainty", action="store_true", help="add a standard error beside each value")


def run(args: argparse.Namespace) -> int:
    """Write the values; exit code 0."""
    from sbrdf_jax.errors import UserError
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    import numpy as np

    from sbrdf_jax.evaluation import evaluate_in_chunks, evaluate_standard_error, measured_wavelengths
    from sbrdf_jax.files import whole_file
    from sbrdf_jax.store import load_stage

    wanted = None if args.wavelengths is None else parse_wavelengths(args.wavelengths)
    stage = load_stage(args.result, args.stage, wanted)
    if args.uncertainty and getattr(stage, "field", None) is None:
        raise UserError(f"--uncertainty: the {args.stage} stage of {args.result} has no standard errors")
    texts, angles = read_directions(Path(args.at))
    output = Path(args.output)
    for source in (args.at, args.result):
        if output.exists() and output.samefile(source):
            raise UserError(f"--output: {args.output} is also read, expected another file")

    names = wavelength_names(np.asarray(measured_wavelengths(stage)) if wanted is None else wanted)
    columns = [f"{name}{end}" for name in names for end in (("", "_se") if args.uncertainty else ("",))]
    radians = np.deg2rad(np.asarray(angles, float).reshape(-1, 3))
    with whole_file(output) as temporary, open(temporary, "w", encoding="utf-8", newline="") as file:
        file.write(",".join([*COLUMNS, *columns]) + "\n")
        for start in range(0, len(texts), ROWS_AT_A_TIME):
            theta_i, theta_o, phi_o = radians[start : start + ROWS_AT_A_TIME].T
            value = evaluate_in_chunks(stage, theta_i, theta_o, phi_o, wanted)
            if args.uncertainty:
                error, _ = evaluate_standard_error(stage, theta_i, theta_o, phi_o, wanted)
                value = np.stack([value, error], axis=-1).reshape(len(value), -1)
            for text, row in zip(texts[start : start + ROWS_AT_A_TIME], value.tolist(), strict=True):
                file.write(",".join([*text, *map(repr, row)]) + "\n")
    print(f"{output}: {len(texts)} directions x {len(names)} wavelengths, {args.stage} stage")
    return 0


def parse_wavelengths(text: str) -> list[float]:
    """Parse `--wavelengths` [nm].

    Raises:
        UserError: not numbers.
    """
    from sbrdf_jax.errors import UserError

    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise UserError(f"--wavelengths: found {text!r}, expected numbers [nm] parted by commas") from None


def wavelength_names(wavelength_nm) -> list[str]:
    """Column names, `552nm`; in full where six digits do not tell two wavelengths apart."""
    short = [f"{w:g}nm" for w in wavelength_nm]
    return short if len(set(short)) == len(short) else [f"{float(w)!r}nm" for w in wavelength_nm]
