"""A roofline of the solver's inner step: its operations and bytes a second beside what the machine gives.

The step is the one of `nnls.advance_newton` on the normal matrix of `resampling.normal.TiedGridNormal`: one product
A'A x, and what the conjugate gradients do to its answer. Operations and bytes are counted from the shapes: K terms,
M incident angles, D direction nodes, U unknowns, W lanes, O bands of the second differences.

- Operations of the product: 2 K D^2 W for the blocks, 4 K M D W to mix incident angles before and after,
  2 O M D W for the bands, 2 M^2 D W over theta_i, 6 M D W for the pole's row, the count and the sums.
- Operations of the rest of the step: 30 U W. These are comparisons and selections mostly, counted as one each.
- Bytes: what must move once in a step, if all that is used again meanwhile stays in a cache: the blocks
  (K D^2 numbers), the state of the lanes, 3 arrays of U W numbers and one of U W truth values, read and written, and
  the products of the blocks, K D W numbers, written and read twice.

So a step has about W / 4 operations for each byte in float64, W / 2 in float32: few lanes are limited by memory, many
by arithmetic. The roof is the lesser of a large matrix product's operations a second, and a copy's bytes a second
times the operations for each byte: of an array as large as the blocks, because both may fit into a cache, and of one
that is larger than any. What XLA counts in the compiled step is in every record, over what is counted here; its bytes
are those of every operation for itself, as if nothing stayed in a cache.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from benchmarks.records import Record, Timing, record_of, timed
from benchmarks.solver import load, thinned

LANES = (1, 4, 16, 31, 101)
STEPS_DEG = (7.5, 3.75)
PRECISIONS = ("float64", "float32")
NUM_STEPS = 20  # of the solver, timed together
PRODUCT_SIZE = 2048
COPY_BYTES = 2**28
PASSES_BYTES = 2**30  # of a copy, timed together
GROUP, ERROR_KIND = "roofline", "relative error of the product, against NumPy in float64"
OTHER_OPERATIONS = 30  # of a step, for each unknown and lane


class Work(NamedTuple):
    """What one step does, or one product or copy."""

    operations: float
    num_bytes: float


def count_step(operator: Any, lanes: int) -> Work:
    """Operations and bytes of one step, by the shapes."""
    layout, width = operator.layout, operator.block.dtype.itemsize
    terms, angles = operator.left.shape
    nodes, bands = layout.num_directions, len(operator.smoothness.offsets)
    unknowns = len(operator.entries)
    along = 4 * terms * angles + 2 * bands * angles + 2 * angles**2 + 6 * angles
    operations = lanes * (2 * terms * nodes**2 + along * nodes + OTHER_OPERATIONS * unknowns)
    state = 2 * unknowns * lanes * (3 * width + 1)
    return Work(operations, width * (terms * nodes**2 + 4 * terms * nodes * lanes) + state)


def records(
    steps_deg: tuple[float, ...] = STEPS_DEG,
    lanes: tuple[int, ...] = LANES,
    precisions: tuple[str, ...] = PRECISIONS,
    repeats: int = 5,
    product_size: int = PRODUCT_SIZE,
    copy_bytes: int = COPY_BYTES,
) -> Iterator[Record]:
    """Yield the matrix product and the copy of each precision, then the steps: amber glass at some grids and lanes."""
    import jax.numpy as jnp

    from sbrdf_jax.resampling.normal import normal_equations

    products = {}
    for precision in precisions:
        products[precision] = product_record(jnp.dtype(precision), product_size, repeats)
        yield products[precision]
        yield copy_record(jnp.dtype(precision), copy_bytes, repeats)
    for step_deg in steps_deg:
        case = load("amber_glass", step_deg)
        assert case is not None  # it is embedded
        samples, grid = case
        operator, rhs = normal_equations(thinned(samples, 1), grid, 1.0)
        problem = f"amber_glass, {step_deg:g} degrees"
        for precision in precisions:
            dtype = jnp.dtype(precision)
            copy = copy_record(dtype, operator.block.size * dtype.itemsize, repeats, problem)
            yield copy
            roof = products[precision].more["GFLOP/s"], copy.more["GB/s"]
            for count in lanes:
                yield step_record(operator, rhs, count, dtype, roof, repeats, problem)


def product_record(dtype, size: int, repeats: int) -> Record:
    """A square matrix product, as large as memory traffic does not matter to."""
    import jax
    import jax.numpy as jnp

    left, right = (np.random.default_rng(k).standard_normal((size, size)) for k in (1, 2))
    on_device = jnp.asarray(left, dtype), jnp.asarray(right, dtype)
    multiply = jax.jit(jnp.matmul)
    found, timing = timed(lambda: multiply(*on_device), repeats)
    error = _relative(found[:, :8], left @ right[:, :8])
    width = np.dtype(dtype).itemsize
    return _record("matrix product", f"{size} x {size}", dtype, timing, error, Work(2 * size**3, 3 * width * size**2))


def copy_record(dtype, num_bytes: int, repeats: int, problem: str = "roof") -> Record:
    """An array read once and written once in each pass, in place, so that no new memory is asked for meanwhile.

    Each number is changed by it, lest the compiler leave the pass out.
    """
    import jax
    import jax.numpy as jnp

    size = num_bytes // np.dtype(dtype).itemsize
    passes = max(PASSES_BYTES // num_bytes, 4)
    add = jax.jit(lambda x: jax.lax.fori_loop(0, passes, lambda _, x: x + 1, x), donate_argnums=0)
    kept = [jnp.zeros(size, dtype)]

    def run():
        kept.append(add(kept.pop()))
        return kept[0]

    found, timing = timed(run, repeats)
    error = _relative(found[:1000], np.full(min(size, 1000), (repeats + 1.0) * passes))
    timing = _of_one(timing, passes)
    return _record(
        "copy", f"{num_bytes / 2**20:.3g} MiB", dtype, timing, error, Work(size, 2 * num_bytes), problem=problem
    )


def step_record(operator, rhs, lanes: int, dtype, roof: tuple[float, float], repeats: int, problem: str) -> Record:
    """Steps of the solver from 0; every lane takes all of them. `operator` and `rhs`, of one lane, in float64."""
    import jax
    import jax.numpy as jnp

    from sbrdf_jax.nnls import advance_newton, begin_newton

    exact, some = operator, np.random.default_rng(3).standard_normal((len(rhs), lanes))
    operator, rhs = jax.tree.map(lambda x: jnp.asarray(x, dtype), (operator, rhs))
    rhs = rhs * jnp.linspace(1, 2, lanes, dtype=dtype)[None]  # lanes of other sizes, which take the same steps
    start = begin_newton(operator, rhs, jnp.zeros_like(rhs))
    arguments = operator, rhs, start, jnp.asarray(0, dtype), jnp.asarray(NUM_STEPS, start.num_steps.dtype)
    compiled: list[Any] = []

    def run():
        if not compiled:
            compiled.append(jax.jit(advance_newton).lower(*arguments).compile())
        return compiled[0](*arguments)

    state, timing = timed(run, repeats)
    if (np.asarray(state.num_steps) != NUM_STEPS).any():
        raise RuntimeError(f"lanes took {np.unique(state.num_steps)} steps, expected {NUM_STEPS}: nothing to time")
    timing = _of_one(timing, NUM_STEPS)
    found = jax.jit(lambda operator, x: operator.multiply(x))(operator, jnp.asarray(some, dtype))
    work = count_step(operator, lanes)
    counted = compiled[0].cost_analysis()  # of a loop's body once
    limit = min(roof[0], roof[1] * work.operations / work.num_bytes)
    return _record(
        "solver step",
        f"{lanes} lanes",
        dtype,
        timing,
        _relative(found, plain_product(exact, some)),
        work,
        problem=problem,
        size={"unknowns": len(rhs), "terms": len(operator.left), "lanes": lanes},
        more={
            "share of the roof": work.operations / min(timing.runs) / 1e9 / limit,
            "XLA's operations over counted": counted.get("flops", 0.0) / work.operations,
            "XLA's bytes over counted": counted.get("bytes accessed", 0.0) / work.num_bytes,
        },
    )


def plain_product(operator, x: np.ndarray) -> np.ndarray:
    """A'A x, its Kronecker sum term by term in NumPy; ties and second differences are the operator's."""
    import jax.numpy as jnp

    planes = operator.layout.spread(jnp.asarray(x))
    terms = zip(*(np.asarray(a) for a in (operator.left, operator.right, operator.block)), strict=True)
    data = sum(np.multiply.outer(a, block @ np.tensordot(b, np.asarray(planes), 1)) for a, b, block in terms)
    return np.asarray(operator.layout.merge(jnp.asarray(data) + operator.smoothness.multiply(planes)))


def _of_one(timing: Timing, count: int) -> Timing:
    """Timing of one of the passes or steps that were timed together; what the first run compiled stays whole."""
    warm = tuple(seconds / count for seconds in timing.warm)
    return Timing(timing.first - (count - 1) * min(warm), warm, timing.peak_bytes)


def _record(
    method, setting, dtype, timing: Timing, error, work: Work, *, problem="roof", size=None, more=None
) -> Record:
    seconds = min(timing.runs)
    return record_of(
        timing,
        group=GROUP,
        problem=problem,
        method=method,
        setting=setting,
        precision=str(dtype),
        size=size or {"operations": int(work.operations), "bytes": int(work.num_bytes)},
        error=error,
        error_kind=ERROR_KIND,
        more={
            "GFLOP/s": work.operations / seconds / 1e9,
            "GB/s": work.num_bytes / seconds / 1e9,
            "operations of a byte": work.operations / work.num_bytes,
        }
        | (more or {}),
    )


def _relative(found, truth) -> float:
    return float(np.linalg.norm(np.asarray(found, np.float64) - truth) / np.linalg.norm(truth))
