"""Held-out scores of a resampling method beside other methods' on the same folds: python -m benchmarks.held_out.

The measurements and the folds lie in ../shared beside the project; what is absent is listed and
left out. The other methods' scores are those of ../shared/cv/baselines.csv: the best of each
column, whichever method reached it.
"""

import argparse
import csv
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

from sbrdf_jax.cleaning import clean  # noqa: E402
from sbrdf_jax.config import parse_config, resolve  # noqa: E402
from sbrdf_jax.folds import K_FOLD, LEAVE_ONE_OUT, make_folds  # noqa: E402
from sbrdf_jax.formats import read  # noqa: E402
from sbrdf_jax.grid import make_grid  # noqa: E402
from sbrdf_jax.validation import predict_held_out, score  # noqa: E402

SHARED = Path(__file__).resolve().parents[2] / "shared"
CORNELL = ("acryl_blue", "cayman", "garnet_red")
SCHEMES = {"kfold5": K_FOLD, "loti": LEAVE_ONE_OUT}
COLUMNS = ("median_rel", "p90_rel", "calm_l2", "log_rms", "negative_share", "coverage")


def main() -> None:
    """Print one line for each measurement and scheme."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", default="guided", choices=("guided", "paper"))
    parser.add_argument("--only", nargs="*", help="names of measurements")
    args = parser.parse_args()
    best = read_baselines()
    print(f"{'measurement':<12} {'scheme':<8}" + "".join(f"{name:>15}" for name in COLUMNS) + f"{'seconds':>10}")
    for name in (*CORNELL, "ptfe"):
        if args.only and name not in args.only:
            continue
        is_cornell = name in CORNELL
        file = SHARED / (f"data/cornell/{name}.brdf" if is_cornell else "data/nist-ptfe/PTFE.data.csv")
        folds = SHARED / ("cv/folds.csv" if is_cornell else "cv/folds-ptfe.csv")
        if not (file.exists() and folds.exists()):
            print(f"{name:<12} absent: {file} or {folds}")
            continue
        for scheme, found, seconds in scores_of(file, folds, args.method, leave_one_out=is_cornell):
            values = "".join(f"{float(found.get(f'scores/{column}', float('nan'))):>15.4f}" for column in COLUMNS)
            print(f"{name:<12} {scheme:<8}{values}{seconds:>10.1f}", flush=True)
            for split in ("theta_i", "decade"):
                if f"coverage_by_{split}/share" in found:
                    label, share = (found[f"coverage_by_{split}/{part}"] for part in ("label", "share"))
                    pairs = "  ".join(f"{a:.3g}: {b:.2f}" for a, b in zip(label, share, strict=True))
                    print(f"{'':<12} coverage by {split}: {pairs}")
            row = best.get((scheme, name), {})
            print(f"{'':<12} {'others':<8}" + "".join(f"{row[c]:>15.4f}" if c in row else f"{'':>15}" for c in COLUMNS))


def scores_of(file: Path, fold_file: Path, method: str, *, leave_one_out: bool):
    """Yield (scheme, scores, seconds) of one measurement."""
    lines = [
        f"input: {{path: {file}}}",
        f"resample: {{method: {method}}}",
        f"validate: {{fold_file: {fold_file}, leave_one_theta_i_out: {str(leave_one_out).lower()}}}",
    ]
    options = resolve(parse_config("\n".join(lines)))
    raw = read(file, options.input)
    cleaned = clean(raw, bilateral=options.input.bilateral, method=method)
    grid = make_grid(cleaned.samples, options.grid, bilateral=cleaned.report.bilateral)
    schemes = make_folds(raw, cleaned.report, options.validate)
    for scheme, key in SCHEMES.items():
        if key in schemes:
            start = time.perf_counter()
            held_out = predict_held_out(raw, schemes[key], grid, options.resample, bilateral=cleaned.report.bilateral)
            yield scheme, score(held_out, raw, cleaned.report), time.perf_counter() - start


def read_baselines() -> dict[tuple[str, str], dict[str, float]]:
    """Return the best of each column by (scheme, measurement)."""
    path = SHARED / "cv/baselines.csv"
    if not path.exists():
        return {}
    best: dict[tuple[str, str], dict[str, float]] = {}
    with path.open() as file:
        for row in csv.DictReader(line for line in file if not line.startswith("#")):
            place = best.setdefault((row["scheme"], row["material"]), {})
            for column in ("median_rel", "p90_rel", "calm_l2", "log_rms"):
                place[column] = min(place.get(column, float("inf")), float(row[column]))
    return best


if __name__ == "__main__":
    main()
