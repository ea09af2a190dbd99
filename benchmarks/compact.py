"""Error against bytes of the compact forms beside plain ones: python -m benchmarks.compact [--plot PNG] [NAME ...].

Eta of eq. (18) in percent, median and worst over the incident angles with data, of the guided
field of each measurement: a file, or a name like amber_glass for an embedded sample; true:NAME is
its truth on the paper's grid. Without names: amber_glass, and the Cornell files garnet_red and
cayman of ../shared where they are. Numbers are stored ones for each incident angle of 13, everything
counted. Bytes are those of the whole field: of a form as its storage lies on disk, of plain ones 8 a
number and 4 an index.
"""

import argparse
import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.compact_baselines import BASELINES
from benchmarks.records import Record, record_of, timed
from benchmarks.solver import CORNELL

GLASSES = ("amber_glass", "amber_glass_sharp", "amber_glass_broad")
DEFAULT = ("amber_glass", "garnet_red", "cayman")
SIZES = (64, 107, 214, 513)
FORMS = {  # numbers, then errors, then colour differences
    "lobe_tensor": (SIZES, (0.045, 0.01), (1.0, 0.5)),
    "lobe_harmonics": ((107, 214, 320, 513), (0.045,), (1.0, 0.5)),
}
RANDOM_DIRECTIONS = 1_000_000
STORED = ("float64", "float16", "quantised")
DRAWN = {  # in the picture: label, colour, line
    "lobe_tensor, quantised": ("lobe_tensor, quantised", "C0", "-"),
    "lobe_tensor, float64": ("lobe_tensor, float64", "C0", "--"),
    "lobe_harmonics, quantised": ("lobe_harmonics, quantised", "C1", "-"),
    "lobe_harmonics, float64": ("lobe_harmonics, float64", "C1", "--"),
    "tucker": ("Tucker without lobe", "C2", "-"),
    "svd": ("truncated SVD", "C3", "-"),
    "harmonics": ("harmonics alone", "C4", "-"),
    "dct": ("4-D DCT, with indices", "C5", "-"),
    "paper, float64": ("paper", "k", ""),
}
FEWEST = 20  # directions of an embedded sample, for its wavelengths alone


def main(arguments: list[str] | None = None) -> None:
    """Print a table for each material; draw all curves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--plot", help="write the curves to this picture")
    parser.add_argument("--paper", action="store_true", help="the paper's method too (half a minute each)")
    args = parser.parse_args(arguments)
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    files = {path.stem: str(path) for path in CORNELL.glob("*.brdf")}
    names = args.names or [files.get(name, name) for name in DEFAULT if name in files or name.startswith("amber")]
    curves = {Path(name).stem: measure(name, with_paper=args.paper) for name in names}
    if args.plot:
        draw(curves, args.plot)


def gridded_field(name: str):
    """Return the grid stage of a measurement, or the truth of an embedded sample on the paper's grid."""
    from sbrdf_jax.config import parse_config, resolve
    from sbrdf_jax.formats import read
    from sbrdf_jax.pipeline import prepare
    from sbrdf_jax.resampling import resample

    if name.startswith("true:"):
        return true_grid(name.removeprefix("true:"))
    path = name if Path(name).exists() else f"builtin:{name}"
    options = resolve(parse_config(f"input: {{path: '{path}'}}"))
    ready = prepare(read(options.input.path, options.input), options)
    return resample(ready.cleaned.samples, ready.grid, options.resample)


def true_grid(material: str, step_deg: float = 7.5):
    """Return the truth of an embedded sample on a grid, as if all of it had been measured."""
    from sbrdf_jax.builtin import measure as measure_builtin
    from sbrdf_jax.builtin import true_brdf
    from sbrdf_jax.records import GriddedBRDF

    wavelength_nm = measure_builtin(material, count=FEWEST).wavelength_nm
    axes = [np.deg2rad(np.linspace(0.0, stop, round(stop / step_deg) + 1)) for stop in (90.0, 90.0, 360.0)]
    brdf = np.asarray(true_brdf(material, *np.meshgrid(*axes, indexing="ij"), wavelength_nm))
    lanes = np.zeros(len(wavelength_nm))
    return GriddedBRDF(*axes, wavelength_nm, brdf, np.zeros(brdf.shape[:3], int), lanes, lanes, lanes)


def records(
    material: str, *, sizes: tuple[int, ...] = SIZES, step_deg: float = 7.5, repeats: int = 2, with_paper: bool = True
) -> Iterator[Record]:
    """Yield a record for each form and size: the worst eta of eq. (18) over the incident angles of the truth."""
    from sbrdf_jax.encoding import data_basis, encode_field, make_basis
    from sbrdf_jax.evaluation import evaluate_on_axes
    from sbrdf_jax.metrics import stored_numbers
    from sbrdf_jax.options import RepresentOptions, TargetOptions
    from sbrdf_jax.representation import represent

    gridded = true_grid(material, step_deg)
    brdf, wavelength_nm = np.asarray(gridded.brdf), np.asarray(gridded.wavelength_nm)
    known, per_angle = np.ones(len(brdf), bool), len(brdf)
    axes = gridded.theta_i, gridded.theta_o, gridded.phi_o
    field = encode_field(gridded, data_basis(wavelength_nm, brdf, 12))

    def record(method, size, numbers, found, timing):
        eta = np.sqrt(((found - brdf) ** 2).sum(axis=(1, 2, 3)) / (brdf**2).sum(axis=(1, 2, 3)))
        return record_of(
            timing,
            group="representation",
            problem=f"true {material}, {step_deg:g} degrees",
            method=method,
            setting=size,
            size={"incident angles": per_angle, "wavelengths": len(wavelength_nm)},
            error=float(eta.max()),
            error_kind="eta of eq. 18, worst incident angle",
            more={"bytes per incident angle": 8 * numbers / per_angle, "median eta": float(np.median(eta))},
        )

    for size in sizes:
        for method in [form for form, (allowed, *_) in FORMS.items() if size in allowed]:
            options = RepresentOptions(method, TargetOptions(numbers=size))
            compact, timing = timed(lambda options=options: represent(field, options, gridded), repeats)
            found = evaluate_on_axes(compact, *axes)
            yield record(method, f"{size} numbers", stored_numbers(compact), found, timing)
        for method, baseline in BASELINES.items():
            (numbers, found), timing = timed(lambda b=baseline, size=size: b(brdf, known, size * per_angle), 0)
            if found is not None:
                yield record(method, f"{size} numbers", numbers, found, timing)
    if with_paper:
        series = encode_field(gridded, make_basis(wavelength_nm, "fourier", 19))
        compact, timing = timed(lambda: represent(series, RepresentOptions("paper")), repeats)
        yield record("paper", "L = 4", stored_numbers(compact), evaluate_on_axes(compact, *axes), timing)


def measure(name: str, *, with_paper: bool) -> dict[str, list[tuple[float, float, float]]]:
    """Print the table of one material and return (bytes, median, worst) of each method and storage."""
    from sbrdf_jax.colour import colour_matching
    from sbrdf_jax.compact_layout import stored_bytes
    from sbrdf_jax.encoding import data_basis, encode_field, make_basis
    from sbrdf_jax.grid import has_data
    from sbrdf_jax.metrics import error_at_nodes, error_between, stored_numbers
    from sbrdf_jax.options import RepresentOptions, TargetOptions
    from sbrdf_jax.representation import represent
    from sbrdf_jax.representation.storage_choice import store
    from sbrdf_jax.representation.target import make_target

    start = time.perf_counter()
    gridded = gridded_field(name)
    wavelength_nm, brdf = np.asarray(gridded.wavelength_nm), np.asarray(gridded.brdf)
    known = has_data(gridded)
    matching = colour_matching(wavelength_nm)
    field = encode_field(gridded, data_basis(wavelength_nm, brdf[known], 12))
    per_angle = len(known)
    curves: dict[str, list[tuple[float, float, float]]] = {}

    def report(method, numbers, size, eta, more="", *, is_drawn=True):
        found = size, 100 * np.median(eta[known]), 100 * eta[known].max()
        if is_drawn:
            curves.setdefault(method, []).append(found)
        print(
            f"{method:<26} {numbers / per_angle:>8.1f} {size:>8} {found[1]:>9.3f} {found[2]:>9.3f} {more}", flush=True
        )

    def report_stored(method, compact, part, promises=(), asked=""):
        for storage in STORED:
            form = compact if storage == "float64" else store(compact, storage, part, gridded, promises, None).compact
            at_nodes, more = error_at_nodes(form, gridded, matching), asked
            if storage == "float64":
                truth = name.removeprefix("true:") if name.startswith("true:") else None
                between = error_between(form, gridded) if truth is None else error_between_truth(form, gridded, truth)
                off = [100 * np.nanmedian(value[mask]) for value, mask in (
                    (between["relative_error_between"], known),
                    (between["relative_error_between_theta_i"], known[:-1] & known[1:]),
                )]  # fmt: skip
                colour = np.median(at_nodes["delta_e_median"][known])
                more += f"between {off[0]:.2f}, between theta_i {off[1]:.2f}, "
                if gridded.field is not None:
                    more += f"near mirror {100 * error_near_mirror(form, gridded, known):.2f}, "
                more += f"Delta E {colour:.2f}"
            label = f"{method}, {storage}" if form.storage == storage else f"{method}, {storage} ({form.storage})"
            is_drawn = not asked.startswith("Delta E")  # another kind of error
            report(label, stored_numbers(form), stored_bytes(form), at_nodes["relative_error"], more, is_drawn=is_drawn)

    print(f"\n{Path(name).name}: {known.sum()} of {per_angle} incident angles have data, {brdf.nbytes} bytes of grid")
    print(f"{'method':<26} {'numbers':>8} {'bytes':>8} {'median %':>9} {'worst %':>9}")
    for method, (sizes, errors, differences) in FORMS.items():
        targets = [TargetOptions(numbers=size) for size in sizes] + [TargetOptions(error=e) for e in errors]
        for target in targets + [TargetOptions(delta_e=difference) for difference in differences]:
            options = RepresentOptions(method=method, target=target)
            promises = make_target(target, per_angle, len(wavelength_nm)).stops
            asked = f"{100 * target.error:g} % everywhere; " if target.error else ""
            asked += f"Delta E {target.delta_e:g} everywhere; " if target.delta_e else ""
            compact = represent(field, options, gridded)
            report_stored(method, compact, field, promises, asked)
            if target.numbers == 214:
                print(f"  least of {RANDOM_DIRECTIONS} random directions: {least_value(compact):.3g} 1/sr")
    if gridded.field is not None:
        interpolate_nodes(gridded, known)
    for method, baseline in BASELINES.items():
        for size in SIZES:
            numbers, found = baseline(brdf, known, size * per_angle)
            if found is not None:
                error = ((found - brdf) ** 2).sum(axis=(1, 2, 3)) / (brdf**2).sum(axis=(1, 2, 3))
                indices = (numbers - known.sum()) // 2 if method == "dct" else 0
                report(method, numbers, 8 * (numbers - indices) + 4 * indices, np.sqrt(error))
    if with_paper:
        series = encode_field(gridded, make_basis(wavelength_nm, "fourier", 19))
        report_stored("paper", represent(series, RepresentOptions("paper")), series)
    leave_out(gridded, field, known)
    print(f"{time.perf_counter() - start:.0f} s", flush=True)
    return curves


def least_value(compact) -> float:
    """Return the least value in random directions."""
    from sbrdf_jax.evaluation import evaluate_in_chunks

    angles = np.random.default_rng(0).uniform(0, 1, (3, RANDOM_DIRECTIONS))
    theta_i, theta_o, phi_o = angles * np.array([[np.pi / 2], [np.pi / 2], [2 * np.pi]])
    parts = np.array_split(np.arange(RANDOM_DIRECTIONS), 20)
    return min(float(evaluate_in_chunks(compact, theta_i[p], theta_o[p], phi_o[p]).min()) for p in parts)


def interpolate_nodes(gridded, known) -> None:
    """Print the error of interpolating all nodes, uncompressed, at the midpoints of theta_o and phi_o."""
    from scipy.interpolate import CubicSpline

    from sbrdf_jax.grid import midpoints
    from sbrdf_jax.metrics import on_axes

    theta_i, theta_o, phi_o = (np.asarray(axis) for axis in (gridded.theta_i, gridded.theta_o, gridded.phi_o))
    nodes = dataclasses.replace(gridded, field=None)
    middle = midpoints(theta_o), midpoints(phi_o)
    logarithm = CubicSpline(theta_o, np.log(np.maximum(np.asarray(gridded.brdf)[known], 1e-9)), axis=1)(middle[0])
    cubic = np.exp(CubicSpline(phi_o, logarithm, axis=2)(middle[1]))
    for method, found in (
        ("windowed sinc", [on_axes(nodes, angle, *middle) for angle in theta_i[known]]),
        ("log-cubic", cubic),
    ):
        wanted = [on_axes(gridded, angle, *middle) for angle in theta_i[known]]
        eta = [np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in zip(found, wanted, strict=True)]
        print(f"nodes, {method:<19} {'':>8} {'':>8} {'':>9} {'':>9} between {100 * np.median(eta):.2f}", flush=True)


def error_near_mirror(compact, gridded, known, count: int = 5000) -> float:
    """Median relative error over random directions some 2 degrees around the mirror's, against the field."""
    from sbrdf_jax.evaluation import evaluate_in_chunks

    rng = np.random.default_rng(0)
    theta_i = rng.uniform(*np.asarray(gridded.theta_i)[np.flatnonzero(known)[[0, -1]]], count)
    theta_o = np.clip(theta_i + rng.normal(0, np.radians(2), count), 0, np.radians(85))
    phi_o = np.pi + rng.normal(0, np.radians(2), count) / np.maximum(np.sin(theta_i), np.radians(2))
    found, field = (evaluate_in_chunks(form, theta_i, theta_o, phi_o) for form in (compact, gridded))
    return float(np.median(np.linalg.norm(found - field, axis=1) / np.linalg.norm(field, axis=1)))


def error_between_truth(compact, gridded, material: str) -> dict[str, np.ndarray]:
    """Eq. (18) at the midpoints where the truth is known, as `error_between` names it."""
    from sbrdf_jax.builtin import true_brdf
    from sbrdf_jax.metrics import midpoints, on_axes

    def at(theta_i):
        axes = theta_i, midpoints(gridded.theta_o), midpoints(gridded.phi_o)
        mesh = np.meshgrid(*axes, indexing="ij")
        truth = np.asarray(true_brdf(material, *mesh, np.asarray(gridded.wavelength_nm)))[0]
        return np.linalg.norm(on_axes(compact, *axes) - truth) / np.linalg.norm(truth)

    angles = {"": np.asarray(gridded.theta_i), "_theta_i": midpoints(gridded.theta_i)}
    return {f"relative_error_between{key}": np.array([at(t) for t in value]) for key, value in angles.items()}


def leave_out(gridded, field, known) -> None:
    """Print the error at every second incident angle, left out: lobe tensor beside interpolations of the grid."""
    from scipy.interpolate import CubicSpline, PchipInterpolator

    from sbrdf_jax.evaluation import evaluate_on_axes
    from sbrdf_jax.metrics import on_axes
    from sbrdf_jax.options import RepresentOptions, TargetOptions
    from sbrdf_jax.representation import represent

    place = np.flatnonzero(known)
    kept, left = place[::2], place[1::2]
    left = left[left < kept[-1]]
    theta_i, brdf = np.asarray(gridded.theta_i), np.asarray(gridded.brdf)
    part = dataclasses.replace(
        gridded, theta_i=theta_i[kept], brdf=brdf[kept], extrapolated=np.asarray(gridded.extrapolated)[kept], field=None
    )
    spectra = dataclasses.replace(field, theta_i=theta_i[kept], coefficient=np.asarray(field.coefficient)[kept])
    size = 214 * len(theta_i) / len(kept)  # in all, what 214 numbers are for each angle of the whole grid
    compact = represent(spectra, RepresentOptions("lobe_tensor", TargetOptions(numbers=size)), part)
    logarithm = np.log(np.maximum(brdf[kept], 1e-9))
    found = {
        "lobe_tensor": np.stack([on_axes(compact, t, gridded.theta_o, gridded.phi_o) for t in theta_i[left]]),
        "windowed sinc": evaluate_on_axes(part, theta_i[left], gridded.theta_o, gridded.phi_o),
        "PCHIP": PchipInterpolator(theta_i[kept], brdf[kept])(theta_i[left]),
        "log-cubic": np.exp(CubicSpline(theta_i[kept], logarithm)(theta_i[left])),
    }
    print("left out " + " ".join(f"{a:>8.4g}" for a in np.degrees(theta_i[left])))
    for method, value in found.items():
        error = ((value - brdf[left]) ** 2).sum(axis=(1, 2, 3)) / (brdf[left] ** 2).sum(axis=(1, 2, 3))
        print(f"  {method:<14}" + " ".join(f"{100 * e:>8.3f}" for e in np.sqrt(error)), flush=True)


def draw(curves, path: str) -> None:
    """Draw the worst incident angle's error against bytes, a panel for each material, one legend below all."""
    import matplotlib.pyplot as plt

    columns = min(3, len(curves))
    rows = -(-len(curves) // columns)
    size = (4.2 * columns, 3.6 * rows + 0.9)
    shared = {"squeeze": False, "sharex": True, "sharey": True, "layout": "constrained"}
    figure, panels = plt.subplots(rows, columns, figsize=size, **shared)
    lines = {}
    for axes, (name, methods) in zip(panels.ravel(), curves.items(), strict=False):
        for method, (label, color, style) in DRAWN.items():
            if method in methods:
                stored, _, worst = np.array(sorted(methods[method])).T
                marker = "*" if method.startswith("paper") else "o"
                (lines[label],) = axes.loglog(stored, worst, color=color, linestyle=style, marker=marker, markersize=4)
        axes.set_title(name)
        axes.set_xlabel("stored bytes of the whole field")
        axes.grid(True, which="major", alpha=0.3)
    for axes in panels.ravel()[len(curves) :]:
        axes.set_axis_off()
    panels[0, 0].xaxis.set_minor_formatter("")
    for axes in panels[:, 0]:
        axes.set_ylabel("eta of eq. (18) at the worst incident angle [%]")
    layout = {"loc": "outside lower center", "ncols": 4 if columns > 1 else 2, "fontsize": 8, "frameon": False}
    figure.legend(list(lines.values()), list(lines), **layout)
    figure.savefig(path, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    main()
