"""Fits of one lobe to many lanes: the bank of widths, optimistix in a batch, and SciPy in a loop."""

from collections.abc import Iterator

import numpy as np

from benchmarks.records import Record, record_of, timed

PEAK_DEG = 30.0
NOISE = 1e-3  # of the height
CONVERGED = 0.01  # relative error of the width


def records(lanes: int, *, loop_lanes: int, repeats: int = 3) -> Iterator[Record]:
    """Yield a record for each method: planted lobes of eq. (14) on the paper's grid, with a little noise."""
    import jax
    import jax.numpy as jnp
    import scipy.optimize

    from sbrdf_jax.angles import angle_between
    from sbrdf_jax.lobes import LOBE_KINDS, lobe_exponents
    from sbrdf_jax.representation.lobe_bank import fit_lobe_bank
    from sbrdf_jax.representation.lobe_fit import fit_lobe, width_bank

    theta_o, phi_o = (
        a.ravel() for a in np.meshgrid(np.radians(np.arange(0, 90.1, 7.5)), np.radians(np.arange(0, 181, 7.5)))
    )
    peak = np.full_like(theta_o, np.radians(PEAK_DEG))
    alpha = angle_between(jnp.asarray(theta_o), jnp.asarray(phi_o), jnp.asarray(peak), jnp.full_like(peak, np.pi))
    exponent = lobe_exponents(alpha)[LOBE_KINDS.index("angle_squared")]
    rng = np.random.default_rng(3)
    height, width = rng.uniform(0.1, 2.0, lanes), np.exp(rng.uniform(np.log(0.02), np.log(0.5), lanes))
    target = height[:, None] * np.exp(-np.asarray(exponent) / width[:, None])
    target = jnp.asarray(target + NOISE * height[:, None] * rng.standard_normal(target.shape))
    weight, inside = jnp.ones_like(exponent), jnp.ones(exponent.shape, bool)
    bank = width_bank(np.radians(7.5) ** 2)
    limits = jnp.asarray(bank[[0, -1]])

    columns = jnp.exp(-exponent[None] / bank[:, None])
    size = jnp.sum(columns**2, axis=1)

    def best_start(lane):
        along = columns @ lane
        best = jnp.argmax(along**2 / size)
        return along[best] / size[best], jnp.asarray(bank)[best]

    def one(lane):
        return fit_lobe(lane, inside, exponent, weight, best_start(lane), limits)

    whole = target[None], jnp.ones_like(target)[None], exponent[None], jnp.asarray(bank)[None]
    found, timing = timed(lambda: fit_lobe_bank(*whole), repeats)
    yield _record("own, bank of widths", timing, np.asarray(found.width)[0], width, "")

    batch = jax.jit(jax.vmap(one))
    found, timing = timed(lambda: batch(target), repeats)
    yield _record("optimistix, batched", timing, np.asarray(found.width), width, "")

    starts = jax.jit(jax.vmap(best_start))(target[:loop_lanes])

    def loop():
        widths = []
        for lane, *start in zip(np.asarray(target[:loop_lanes]), *map(np.asarray, starts), strict=True):

            def residual(x, lane=lane):
                return x[0] * np.exp(-np.asarray(exponent) * np.exp(-x[1])) - lane

            widths.append(
                np.exp(scipy.optimize.least_squares(residual, [start[0], np.log(start[1])], method="lm").x[1])
            )
        return np.array(widths)

    widths, timing = timed(loop, 0)
    yield _record("scipy least_squares, a loop", timing, widths, width[:loop_lanes], "same starts")


def _record(method: str, timing, found: np.ndarray, truth: np.ndarray, setting: str) -> Record:
    error = np.abs(found / truth - 1)
    lanes = len(truth)
    return record_of(
        timing,
        group="lobes",
        problem="planted lobes, eq. 14",
        method=method,
        setting=setting or f"{lanes} lanes",
        size={"lanes": lanes},
        error=float(np.median(error)),
        error_kind="median relative error of the width",
        more={"lanes per second": lanes / min(timing.runs), "share converged": float(np.mean(error < CONVERGED))},
    )
