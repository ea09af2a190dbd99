"""Many lobe lanes at once: python -m benchmarks.lobe_bank. The bank beside optimistix in a batch, and SciPy.

11,856 lanes of the paper's size (39 incident angles and kinds, 304 lanes each, 301 directions):
two lobes and noise. Prints processor seconds of a warm run and the error left, beside SciPy on a sample.
"""

import time

import numpy as np

GROUPS, LANES, DIRECTIONS = 39, 304, 301
SCIPY_LANES = 50


def main() -> None:
    """Print a line for each way."""
    from sbrdf_jax.runtime import set_up_jax

    set_up_jax()
    import jax
    import jax.numpy as jnp
    from scipy.optimize import least_squares

    from sbrdf_jax.representation.lobe_bank import fit_lobe_bank
    from sbrdf_jax.representation.lobe_fit import fit_lobe, width_bank

    rng = np.random.default_rng(3)
    alpha = rng.uniform(0, np.pi / 2 - 0.05, (GROUPS, DIRECTIONS))
    exponent = np.stack([(a**2, np.tan(a) ** 2, np.tan(a))[k % 3] for k, a in enumerate(alpha)])
    widths = np.tile(width_bank(0.13**2), (GROUPS, 1))
    width = np.exp(rng.uniform(-5, 1, (GROUPS, LANES, 2)))
    lobes = np.exp(-exponent[:, None, :, None] / width[:, :, None])
    target = (lobes * rng.normal(size=(GROUPS, LANES, 1, 2)) * [1.0, 0.2]).sum(axis=-1)
    target += 0.01 * rng.normal(size=target.shape)
    target /= np.abs(target).max(axis=2, keepdims=True)
    weight = rng.integers(1, 3, target.shape).astype(float)
    arrays = tuple(jnp.asarray(a) for a in (target, weight, exponent, widths))

    def timed(function, *args):
        jax.block_until_ready(function(*args))
        seconds = []
        for _ in range(5):
            start = time.process_time()
            found = jax.block_until_ready(function(*args))
            seconds.append(time.process_time() - start)
        return found, min(seconds), max(seconds)

    found, least, most = timed(fit_lobe_bank, *arrays)
    error = np.asarray(found.error)
    print(f"{error.size} lanes of {DIRECTIONS} directions")
    print(f"bank         {least:8.3f} s (to {most:.3f}), mean squared error {error.mean():.8f}")

    def by_optimistix(target, weight, exponent, height, width):
        ends = jnp.array([widths[0, 0], widths[0, -1]])
        inside = jnp.ones(DIRECTIONS, bool)
        return fit_lobe(target, inside, exponent, weight, (height, width), ends)

    batch = jax.jit(jax.vmap(jax.vmap(by_optimistix, (0, 0, None, 0, 0))))
    place = np.abs(np.log(np.asarray(found.width))[..., None] - np.log(widths[0])).argmin(axis=-1)
    start = widths[0][place]
    other, least, most = timed(batch, *arrays[:3], found.height, jnp.asarray(start))
    left = np.asarray(other.error)
    print(
        f"optimistix   {least:8.3f} s (to {most:.3f}), mean squared error {left.mean():.8f}, from the bank's best width"
    )
    print(f"bank worse than optimistix by more than 1e-6 of its error: {(error > left * (1 + 1e-6)).sum()} lanes")

    seconds, worse = time.process_time(), 0
    for lane in range(SCIPY_LANES):
        g, k = lane % GROUPS, lane % LANES
        root = np.sqrt(weight[g, k])

        def residual(x, g=g, k=k, root=root):
            return root * (target[g, k] - x[0] * np.exp(-exponent[g] * np.exp(-x[1])))

        at = np.log(start[g, k]).clip(np.log(widths[0, 0]) + 1e-9, np.log(widths[0, -1]) - 1e-9)
        bounds = ([-np.inf, np.log(widths[0, 0])], [np.inf, np.log(widths[0, -1])])
        fit = least_squares(residual, [float(found.height[g, k]), at], bounds=bounds)
        worse += error[g, k] > 2 * fit.cost * (1 + 1e-6)
    per_lane = (time.process_time() - seconds) / SCIPY_LANES
    print(
        f"SciPy        {per_lane * error.size:8.1f} s for all, by {SCIPY_LANES} lanes; better than the bank in {worse}"
    )


if __name__ == "__main__":
    main()
