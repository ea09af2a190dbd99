"""What every test runs under: x64, strict dtypes and ranks, array annotations enforced, the measured data by name."""

import os
from pathlib import Path

# Compiling takes most of the tests' time, so LLVM's optimisation is off; `scripts/nightly.sh` has it on.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")

import jax
import jaxtyping
import numpy as np
import pytest

# Before the first import of the package: annotations of shape, dtype and type are checked at every call.
jaxtyping.install_import_hook("sbrdf_jax", "beartype.beartype")

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared"  # measured data that are not part of the repository
IN_CI = os.environ.get("CI", "").lower() in ("1", "true")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let the nightly script ask for more damaged files than the usual run reads, and for a record of them."""
    parser.addoption("--fuzz-inputs", type=int, metavar="N", help="damaged files for each reader; unset: some hundred")
    parser.addoption("--fuzz-records", metavar="FILE", help="append a line for each reader, for benchmarks.pages")


def shared_file(name: str) -> Path:
    """Path of a measured file below `SHARED`; skips the test by name where it is absent, fails in CI."""
    path = SHARED / name
    if path.exists():
        return path
    message = f"{path.parent.name}/{path.name}: no such measured file below {SHARED}"
    if IN_CI:
        pytest.fail(f"{message}, and CI must have it")
    pytest.skip(message)


@pytest.fixture
def shared():
    """The function `shared_file`: `shared("data/cornell/cayman.brdf")` is a path, or the test skips."""
    return shared_file


@pytest.fixture
def rng() -> np.random.Generator:
    """A random generator with a fixed seed, new for each test."""
    return np.random.default_rng(20240607)
