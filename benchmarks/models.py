"""Analytic models against a measurement over its spectrum: python -m benchmarks.models [--plot PNG] [MEASUREMENT ...].

Each model is fitted to the cleaned samples themselves, each wavelength alone and jointly (one
shape, amplitudes by wavelength); every incident angle counts alike. Beside them the resampled
field and its compact form at 125:1, evaluated at the same samples. eta is the relative error of
eq. (18) over the samples, log RMS that of the natural logarithm where a value is above 1e-3 of
the largest. A measurement is a file or an embedded sample; without any, amber_glass.
"""

import argparse
import time
from pathlib import Path

import numpy as np

SMALLEST = 1e-3  # of the largest value of a wavelength: logarithms of less are not taken


def main(arguments: list[str] | None = None) -> None:
    """Print a table for each measurement; draw error against wavelength."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=["amber_glass"])
    parser.add_argument("--plot", help="write error against wavelength to this picture")
    args = parser.parse_args(arguments)
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    curves = {Path(name).stem: measure(name) for name in args.names}
    if args.plot:
        draw(curves, args.plot)


def measure(name: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Print the table of one measurement; return its wavelengths [nm] and eta [%] by wavelength of each method."""
    from sbrdf_jax.config import parse_config, resolve
    from sbrdf_jax.encoding import encode_field
    from sbrdf_jax.evaluation import evaluate_in_chunks
    from sbrdf_jax.formats import read
    from sbrdf_jax.models import MODELS
    from sbrdf_jax.models.fitting import Samples, equal_weights, fit_each_wavelength, fit_jointly, predict
    from sbrdf_jax.pipeline import finite_part, prepare, spectral_basis
    from sbrdf_jax.records import Status
    from sbrdf_jax.representation import represent
    from sbrdf_jax.resampling import resample

    path = name if Path(name).exists() else f"builtin:{name}"
    options = resolve(parse_config(f"input: {{path: '{path}'}}"))
    ready = prepare(read(options.input.path, options.input), options)
    raw = ready.cleaned.samples
    angles = raw.theta_i, raw.theta_o, raw.phi_o
    samples = Samples(*angles, raw.value, equal_weights(raw.theta_i, raw.value))
    print(f"\n{Path(name).name}: {raw.num_samples} samples, {len(raw.wavelength_nm)} wavelengths")
    print(
        f"{'method':<34} {'numbers':>8} {'eta %':>8} {'worst %':>8} {'at nm':>6} {'log RMS':>8} {'not ok':>7} {'s':>7}"
    )
    curves: dict[str, np.ndarray] = {}

    def report(method, found, numbers, failed, seconds):
        weight = samples.weight[:, None]
        error, energy = (weight * (found - raw.value) ** 2).sum(axis=0), (weight * raw.value**2).sum(axis=0)
        curves[method] = 100 * np.sqrt(error / energy)
        total, worst = 100 * np.sqrt(error.sum() / energy.sum()), int(curves[method].argmax())
        floor = SMALLEST * raw.value.max(axis=0)
        big = raw.value > floor
        log_rms = np.sqrt(np.mean(np.log(np.maximum(found, floor) / np.where(big, raw.value, 1.0))[big] ** 2))
        at = f"{curves[method][worst]:>8.2f} {raw.wavelength_nm[worst]:>6.0f}"
        print(f"{method:<34} {numbers:>8} {total:>8.2f} {at} {log_rms:>8.3f} {failed:>7} {seconds:>7.1f}", flush=True)

    for model in MODELS.values():
        for how, fit_model in (("each wavelength", fit_each_wavelength), ("jointly", fit_jointly)):
            start = time.perf_counter()
            fit = fit_model(model, samples)
            seconds = time.perf_counter() - start
            numbers = fit.amplitude.size + (fit.parameters.size if how != "jointly" else fit.parameters.shape[1])
            failed = int((fit.status != Status.OK).sum())
            report(f"{model.name}, {how}", predict(model, fit, *angles), numbers, failed, seconds)
    start = time.perf_counter()
    gridded = finite_part(resample(raw, ready.grid, options.resample))
    seconds = time.perf_counter() - start
    report("resampled field", evaluate_in_chunks(gridded, *angles), np.asarray(gridded.brdf).size, 0, seconds)
    start = time.perf_counter()
    field = encode_field(gridded, spectral_basis(gridded, options.encode))
    compact = represent(field, options.represent, gridded)
    seconds = time.perf_counter() - start
    from sbrdf_jax.metrics import stored_numbers

    report("compact form", evaluate_in_chunks(compact, *angles), stored_numbers(compact), 0, seconds)
    return np.asarray(raw.wavelength_nm), curves


def draw(measurements, path: str) -> None:
    """Draw eta against wavelength, a panel for each measurement; fits of each wavelength solid, joint ones dotted."""
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, len(measurements), figsize=(6 * len(measurements), 4), squeeze=False)
    for axes, (name, (wavelength_nm, curves)) in zip(panels[0], measurements.items(), strict=True):
        names = list(dict.fromkeys(method.split(",")[0] for method in curves))
        for method, curve in curves.items():
            color = f"C{names.index(method.split(',')[0])}"
            is_joint = method.endswith("jointly")
            label = None if is_joint else method.split(",")[0]
            axes.semilogy(wavelength_nm, curve, color=color, linestyle=":" if is_joint else "-", label=label)
        axes.set_title(name)
        axes.set_xlabel("wavelength [nm]")
        axes.set_ylabel("relative error at the samples [%]")
    panels[0, 0].legend(fontsize=7, ncols=2)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
