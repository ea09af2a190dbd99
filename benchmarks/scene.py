"""Seconds of scenes against their share of the work: python -m benchmarks.scene [FILE] [--plot FILE.png].

Without a file, the embedded sample. Every time is of compiled code, reading, cleaning and measuring
included: "first" where nothing is kept, "next" where the estimates of the whole measurement are, as for a
second scene of a material. "resample" is that stage of it, "solve" the least squares within, without the look at what
is held, the reading of nodes and their flags. Footprints need Mitsuba and are left out without it.
"""

import argparse
import contextlib
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

SCENES = Path(__file__).parent.parent / "configs" / "scenes"
SECONDS = ("first s", "next s", "of next", "of first", "resample s", "of it", "solve s", "of solve")
COLUMNS = ("scene", "share", *SECONDS, "difference", "eta %")


def scenes(folder: Path, wavelength_nm: np.ndarray) -> dict[str, str]:
    """Return the scenes by name, as YAML."""
    from sbrdf_jax.errors import UserError
    from sbrdf_jax.footprints import find_footprint
    from sbrdf_jax.masks import write_footprint

    found = {"everything": "null"}
    for name in ("flat_patch", "cylinder"):
        try:
            footprint = find_footprint(SCENES / f"{name}.xml")
        except UserError as error:
            print(f"{name} is left out: {error}")
            continue
        write_footprint(folder / f"{name}.h5", footprint.axes, footprint.counts)
        found[name] = f"{{footprint: {folder / name}.h5}}"
    middle = len(wavelength_nm) // 2
    found["one wavelength"] = f"{{wavelength_nm: [{wavelength_nm[middle]}]}}"
    for part in (8, 4, 2):
        last = wavelength_nm[len(wavelength_nm) // part]
        found[f"1/{part} of the wavelengths"] = f"{{wavelength_nm: {{min: {wavelength_nm[0]}, max: {last}}}}}"
    found["three incident angles"] = "{theta_i_deg: [0, 30, 60]}"
    found["colour only"] = "{colour: {}}"
    return found


@contextlib.contextmanager
def clocked(module: Any, name: str) -> Iterator[list[float]]:
    """Yield a list to which every call of a module's function adds its seconds."""
    seconds, function = [], getattr(module, name)

    def call(*args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*args, **kwargs)
        finally:
            seconds.append(time.perf_counter() - start)

    with mock.patch.object(module, name, call):
        yield seconds


def measure(file: str, repeats: int) -> list[dict[str, Any]]:
    """Return a row for each scene."""
    from sbrdf_jax import colour
    from sbrdf_jax.config import parse_config, resolve
    from sbrdf_jax.formats import read
    from sbrdf_jax.pipeline import prepare, process
    from sbrdf_jax.progress import Progress
    from sbrdf_jax.resampling import guided
    from sbrdf_jax.resampling.kept import Kept

    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def run(scene: str, kept: Kept):
            options = resolve(parse_config(f"input: {{path: '{file}'}}", [f"scene={scene}"]))
            start = time.perf_counter()
            raw = read(options.input.path, options.input)
            with Progress(folder / "log", quiet=True) as progress:
                result = process(raw, prepare(raw, options, kept), options, progress, kept)
            return result, time.perf_counter() - start

        options = resolve(parse_config(f"input: {{path: '{file}'}}"))
        wavelength_nm = read(options.input.path, options.input).wavelength_nm
        full: Any = None
        for name, scene in scenes(folder, wavelength_nm).items():
            kept = Kept()
            run(scene, kept)  # compiles
            result, first = run(scene, Kept())
            with clocked(guided, "solve_field") as solves:
                again = [run(scene, kept) for _ in range(repeats)]
            seconds = min(each for _, each in again)
            stage = min(each.timing["resample"]["run"] for each, _ in again)
            full = full or result
            got, wanted = result.gridded, full.gridded
            place = [int(np.argmin(np.abs(wanted.theta_i - angle))) for angle in np.asarray(got.theta_i)]
            lanes = np.isin(wanted.wavelength_nm, got.wavelength_nm)
            same = np.asarray(wanted.brdf)[place][..., lanes]
            needed = np.isfinite(np.asarray(got.brdf))
            note = ""
            if result.quadrature is not None:
                matching = colour.colour_matching(np.asarray(wanted.wavelength_nm))
                labs = [
                    colour.xyz_to_lab(colour.brdf_to_xyz(np.asarray(g.brdf), m), m)
                    for g, m in ((got, result.quadrature.matching), (wanted, matching))
                ]
                difference = colour.lab_difference(*labs)
                note = f"{lanes.sum()} wavelengths; Delta E of the nodes median {np.median(difference):.2f}"
                note += f", 95th {np.quantile(difference, 0.95):.2f} (limit {result.quadrature.limit:g})"
            error = np.asarray(result.metrics["relative_error"])
            rows.append(
                {
                    "name": name,
                    "share": needed.sum() / np.size(wanted.brdf),
                    "first": first,
                    "next": seconds,
                    "resample": stage,
                    "solve": min(solves),
                    "difference": float(np.abs(np.asarray(got.brdf) - same)[needed].max() / np.nanmax(same)),
                    "eta": 100 * float(np.nanmedian(error)),
                    "note": note,
                }
            )
            _print(rows[-1], rows[0])
    return rows


def _print(row: dict[str, Any], full: dict[str, Any]) -> None:
    cells = (f"{row['share']:.3f}", f"{row['first']:.2f}", f"{row['next']:.2f}", f"{row['next'] / full['next']:.2f}")
    more = [f"{row['next'] / full['first']:.2f}"]
    for part in ("resample", "solve"):
        more += [f"{row[part]:.4f}", f"{row[part] / full[part]:.3f}"]
    last = (f"{row['difference']:.1e}", f"{row['eta']:.2f}")
    print(f"{row['name']:<24}" + "".join(f"{cell:>11}" for cell in (*cells, *more, *last)), row["note"], flush=True)


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw time against share."""
    from sbrdf_jax.report.style import BLUE, MUTED, new_figure, save_figure, style_context

    with style_context():
        figure = new_figure()
        axes = figure.subplots()
        share, seconds = np.array([row["share"] for row in rows]), np.array([row["next"] for row in rows])
        line = np.geomspace(share.min(), 1, 50)
        axes.plot(line, line * rows[0]["next"], color=MUTED, linewidth=1, label="in proportion")
        axes.plot(share, seconds, "o", color=BLUE, label="next scene of a material, compiled")
        axes.set_xlabel("share of the nodes x wavelengths that the scene needs")
        axes.set_ylabel("seconds, reading to measuring")
        axes.set(xscale="log", yscale="log", xlim=(0.7 * share.min(), 3), ylim=(0.3 * seconds.min(), 2 * seconds.max()))
        axes.legend(loc="upper left")
        axes.set_title("What a scene costs")
        _label(axes, rows)
        save_figure(figure, path)


def _label(axes, rows: list[dict[str, Any]]) -> None:
    """Write the names beside their points, each at the first place where it covers no other and no point."""
    axes.figure.canvas.draw()
    points = axes.transData.transform([(row["share"], row["next"]) for row in rows])
    taken: list[Any] = []
    places = [((6, height), "left") for height in (3, -9, 12, -16, -26, 22)] + [
        ((-6, height), "right") for height in (3, -9)
    ]
    for row in sorted(rows, key=lambda row: row["share"]):
        for offset, side in places:
            style = {"textcoords": "offset points", "fontsize": 8, "ha": side}
            text = axes.annotate(row["name"], (row["share"], row["next"]), offset, **style)
            box = text.get_window_extent()
            if box.x0 > axes.bbox.x0 and not any(map(box.overlaps, taken)) and not box.count_contains(points):
                break
            text.remove()
        else:
            text = axes.annotate(row["name"], (row["share"], row["next"]), (6, 3), **style)
        taken.append(text.get_window_extent())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", nargs="?", default="builtin:amber_glass")
    parser.add_argument("--plot", type=Path, metavar="FILE.png")
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    print(f"{COLUMNS[0]:<24}" + "".join(f"{name:>11}" for name in COLUMNS[1:]))
    rows = measure(args.file, args.repeats)
    if args.plot:
        plot(rows, args.plot)


if __name__ == "__main__":
    main()
