"""Lanes on several devices: the arrays lie on all of them, and the answer is that of one."""

import json
import os
import subprocess
import sys

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT

from sbrdf_jax.builtin import measure
from sbrdf_jax.cli import main
from sbrdf_jax.devices import over_lanes
from sbrdf_jax.formats import write_samples

NUM_DEVICES = 4
FOUR = f"--xla_force_host_platform_device_count={NUM_DEVICES}"
AGREEMENT = 1e-10  # relative to the largest value of a dataset
CONFIG = """
input: {path: amber.h5, bilateral: true}
grid: {theta_i_step_deg: 22.5, theta_o_step_deg: 22.5, phi_o_step_deg: 45}
encode: {basis: fourier, coefficients: 5}
represent: {method: paper, max_degree: 1, lobe: angle_squared}
output: {report: false}
"""
METHODS = ("paper", "guided")  # of resampling
# `look` notes how each array that comes back from all devices lies on them:
# [what is computed, shape, number of devices, shape of each shard].
LOOK = """
import json, sys
from sbrdf_jax import devices

seen, home = [], devices._home

def look(leaf, count, axis):
    shards = [list(shard.data.shape) for shard in leaf.addressable_shards]
    seen.append((what, list(leaf.shape), len(leaf.sharding.device_set), shards))
    return home(leaf, count, axis)

devices._home = look
"""
PIPELINE = f"""{LOOK}
from sbrdf_jax.cli import main

for what in sys.argv[1:]:
    words = [f"resample.method={{what}}", f"output.path=four_{{what}}.h5"]
    assert main(["run", "config.yaml", *words]) == 0
print(json.dumps(seen))
"""
SOLVERS = f"""{LOOK}
import jax, numpy as np
from sbrdf_jax.runtime import set_up_jax

set_up_jax()
import jax.numpy as jnp
from sbrdf_jax.nnls import DenseNormal, ProjectedNewton, solve_in_rounds
from sbrdf_jax.representation.lane_search import _fit_batch
from sbrdf_jax.resampling.guided.bounds import solve_bounded

rng = np.random.default_rng(5)
matrix, target = rng.standard_normal((60, 40)), rng.standard_normal((60, 6))
target[3, 2] = np.nan
method = ProjectedNewton(tolerance=1e-10)
normal, rhs = DenseNormal(jnp.asarray(matrix.T @ matrix)), jnp.asarray(matrix.T @ target)
prior, residual = matrix.T @ matrix / 60, rng.standard_normal((40, 6))
exponent = rng.uniform(0, 3, (6, 30))
lobe = 2 * np.exp(-exponent / 0.4), np.ones((6, 30), bool), exponent, np.ones(30), (np.ones(6), np.full(6, 0.2))

def solve():
    global what
    what = "rounds"
    yield solve_in_rounds(normal, rhs, method)
    what = "many rounds"
    yield solve_in_rounds(normal, rhs, ProjectedNewton(tolerance=1e-30, max_steps=250))
    what = "bounded"
    yield solve_bounded(prior, np.linalg.inv(prior + np.eye(40)), np.ones(40), residual, 0 * residual - 0.3, method)

four = list(solve())
looked = len(seen)
with jax.default_device(jax.devices()[0]):
    one = list(solve())
assert len(seen) == looked
for few, many in zip(jax.tree.leaves(one), jax.tree.leaves(four), strict=True):
    assert isinstance(many, np.ndarray) or many.sharding.device_set == {{jax.devices()[0]}}
    size = np.max(np.abs(few), where=np.isfinite(few), initial=1.0)  # a residual is relative to 1
    np.testing.assert_allclose(many, few, rtol=0, atol=1e-10 * size)
what = "lobes"
found = _fit_batch(*lobe, np.tile([0.01, 30.0], (6, 1)))
np.testing.assert_allclose(np.stack([found.height, found.width]), [[2.0] * 6, [0.4] * 6], rtol=1e-6)
assert np.isnan(four[0].value[:, 2]).all() and np.isfinite(four[0].value[:, 3]).all()
print(json.dumps(seen))
"""


def start_on_four(program: str, *words: str, cwd=None) -> subprocess.Popen:
    """Start a program that has four simulated devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} {FOUR}"
    environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", program, *words]
    return subprocess.Popen(
        command, env=environment, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def lines_of(process: subprocess.Popen) -> list:
    """Wait for a program that prints JSON lines."""
    with process:
        printed, said = process.communicate(timeout=600)
    assert process.returncode == 0, said[-2000:]
    return [json.loads(line) for line in printed.splitlines()]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A folder with the results of one device and of four, and how the arrays of the latter lay."""
    folder = tmp_path_factory.mktemp("devices")
    raw = measure("amber_glass", count=40)
    wavelengths = np.linspace(0, len(raw.wavelength_nm) - 1, 6).round().astype(int)  # four devices do not divide 6
    value = raw.value[:, wavelengths]
    value[raw.theta_o > 0.8] = 0.0  # dark beside bright: the bounds bind, and guided needs its solver
    part = {"wavelength_nm": raw.wavelength_nm[wavelengths], "value": value}
    write_samples(folder / "amber.h5", raw.__class__(**{**vars(raw), **part}))
    (folder / "config.yaml").write_text(CONFIG)
    four = start_on_four(PIPELINE, *METHODS, cwd=folder)
    for method in METHODS:
        words = [f"input.path={folder}/amber.h5", f"resample.method={method}", f"output.path={folder}/one_{method}.h5"]
        assert main(["run", str(folder / "config.yaml"), *words]) == 0
    return folder, lines_of(four)[-1]


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_four_devices_give_the_answer_of_one(results, method):
    folder, _ = results
    compared = []
    with h5py.File(folder / f"one_{method}.h5") as one, h5py.File(folder / f"four_{method}.h5") as four:

        def compare(name, item):
            if not isinstance(item, h5py.Dataset) or name.startswith("timing") or item.dtype.kind not in "fiu":
                return
            value, other = item[()], four[name][()]
            size = np.max(np.abs(value), where=np.isfinite(value), initial=0.0)
            if name.endswith(("kkt_residual", "model_residual")):
                size = 1.0  # what is left of the rounding, relative to what it was
            np.testing.assert_allclose(other, value, rtol=0, atol=AGREEMENT * size, err_msg=name)
            compared.append(name)

        one.visititems(compare)
        assert len(compared) > 20 and "grid/brdf" in compared


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_the_lanes_of_a_run_lie_on_four_devices(results, method):
    _, seen = results
    arrays = [array for of, *array in seen if of == method]
    assert_spread(arrays)
    solves = [shards[0] for shape, _, shards in arrays if len(shape) == 2 and shape[1] == 8]  # 6, filled up
    assert solves and all(shard[1] == 2 for shard in solves)
    assert any(shape[0] == 16 and shards[0][0] == 4 for shape, _, shards in arrays)  # pairs of the lobe search


def assert_spread(arrays: list) -> None:
    """Each array lies on all devices, an equal part on each."""
    assert arrays
    for shape, devices, shards in arrays:
        assert devices == NUM_DEVICES == len(shards) and all(shard == shards[0] for shard in shards)
        assert np.prod(shape) == NUM_DEVICES * np.prod(shards[0])


def test_solvers_and_fits_on_four_devices_answer_as_on_one():
    seen = lines_of(start_on_four(SOLVERS))[-1]
    for what in ("rounds", "many rounds", "bounded", "lobes"):
        arrays = [array for of, *array in seen if of == what]
        assert_spread(arrays)
        assert all(8 in shape for shape, _, _ in arrays)  # 6 lanes, filled up


def test_each_device_stops_by_itself_and_lanes_need_not_divide():
    program = """
import jax, jax.numpy as jnp, numpy as np
from sbrdf_jax.devices import over_lanes

def count_down(step, lanes):
    steps = jax.lax.while_loop(lambda s: jnp.any(s[0] > 0), lambda s: (s[0] - step, s[1] + 1), (lanes, 0 * lanes))[1]
    return {"steps": steps}  # of the slowest lane of the device

call = over_lanes(count_down, axis=0, shared=(0,))
for lanes in ([1, 2, 3, 4, 5, 6, 7], [3], [], [1, 9]):
    print(call(jnp.asarray(1), jnp.asarray(lanes, int))["steps"].tolist())
with jax.default_device(jax.devices()[1]):
    print(call(jnp.asarray(1), jnp.asarray([1, 9]))["steps"].tolist())
print(jax.jit(lambda lanes: call(jnp.asarray(1), lanes))(jnp.asarray([1, 9]))["steps"].tolist())
"""
    assert lines_of(start_on_four(program)) == [[2, 2, 4, 4, 6, 6, 7], [3], [], [1, 9], [9, 9], [9, 9]]


def test_on_one_device_it_is_jit():
    traced = []

    def double(x, power):
        traced.append(x)
        return 2 * x**power

    assert len(jax.local_devices()) == 1
    call = over_lanes(double, axis=0, static=(1,))
    for _ in range(2):
        np.testing.assert_array_equal(call(jnp.arange(3), 2), [0, 2, 8])
    assert len(traced) == 1
