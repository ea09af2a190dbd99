"""Held-out samples of a measurement, predicted by the own methods and by interpolators of other packages.

The peers interpolate the logarithm of the values over (theta_i, x, y), x and y being the outgoing direction's
tangential part with |phi_o| folded: coordinates in which they do best.
"""

from collections.abc import Iterator

import numpy as np

from benchmarks.peers import gaussian_process
from benchmarks.records import Record, Timing, record_of, timed
from benchmarks.solver import load, thinned

FOLDS = 5
SMALLEST = 1e-3  # 1/sr; relative errors are taken of larger values only
NEIGHBOURS = 60  # of the radial basis functions


def records(name: str, *, samples: int, wavelengths: int, folds: int, step_deg: float = 7.5) -> Iterator[Record]:
    """Yield a record for each method, over the first folds of five; none where the file is absent."""
    case = load(name, step_deg)
    if case is None:
        return
    rows = np.linspace(0, case[0].num_samples - 1, min(samples, case[0].num_samples)).round().astype(int)
    raw = thinned(case[0].take(rows), wavelengths)
    fold = np.random.default_rng(0).permutation(raw.num_samples) % FOLDS
    own = _own(case[1])
    for method, predict in (own | _peers()).items():
        error, timings = [], []
        for number in range(folds):
            train, test = raw.take(fold != number), raw.take(fold == number)
            repeats = 1 if method in own else 0  # the others compile nothing
            found, timing = timed(lambda train=train, test=test, p=predict: p(train, test), repeats)
            timings.append(timing)
            error.append((found - test.value, test.value))
        difference, value = (np.concatenate(part) for part in zip(*error, strict=True))
        big = value > SMALLEST
        seconds = tuple(s for t in timings for s in t.runs)
        first = timings[0].first if method in own else min(seconds)
        yield record_of(
            Timing(first, seconds, max(t.peak_bytes for t in timings)),
            group="interpolation",
            problem=name,
            method=method,
            setting=f"{folds} folds",
            size={"samples": raw.num_samples, "wavelengths": wavelengths},
            error=float(np.median(np.abs(difference[big]) / value[big])),
            error_kind="median relative error of held-out samples",
            more={
                "90th": float(np.quantile(np.abs(difference[big]) / value[big], 0.9)),
                "L2": float(np.linalg.norm(difference) / np.linalg.norm(value)),
            },
        )


def _own(grid):
    """The own methods: (train, test) -> values."""
    from sbrdf_jax.evaluation import evaluate_in_chunks
    from sbrdf_jax.options import ResampleOptions
    from sbrdf_jax.resampling import resample

    def by(options):
        return lambda train, test: evaluate_in_chunks(
            resample(train, grid, options), test.theta_i, test.theta_o, test.phi_o
        )

    return {
        "own, guided": by(ResampleOptions("guided", "data", tolerance=1e-6)),
        "own, paper": by(ResampleOptions("paper", 1.0, tolerance=1e-8)),
    }


def _peers():
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator, RBFInterpolator

    def linear(points, values, queries):
        """What `griddata` does, with the nearest sample outside the hull."""
        found = LinearNDInterpolator(points, values)(queries)
        return np.where(np.isfinite(found), found, NearestNDInterpolator(points, values)(queries))

    def radial(points, values, queries):
        """Thin plates."""
        return RBFInterpolator(points, values, neighbors=NEIGHBOURS, smoothing=1e-3)(queries)

    peers = {"scipy griddata, linear": linear, "scipy RBFInterpolator": radial}
    if process := gaussian_process():
        peers["scikit-learn Gaussian process"] = process
    return {name: _in_log(predict) for name, predict in peers.items()}


def _in_log(predict):
    def of_samples(train, test):
        floor = 1e-3 * np.median(train.value)
        return np.exp(predict(_places(train), np.log(np.maximum(train.value, floor)), _places(test)))

    return of_samples


def _places(samples) -> np.ndarray:
    radius = np.sin(samples.theta_o)
    return np.stack([samples.theta_i, radius * np.cos(samples.phi_o), radius * np.abs(np.sin(samples.phi_o))], axis=1)
