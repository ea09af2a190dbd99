"""What the processes of `test_faults` do: write results until they are stopped, on full disks and in closed folders."""

import itertools
import os
import resource

import numpy as np
from small_results import UNIFORM_NM, small_grid

from sbrdf_jax.errors import UserError
from sbrdf_jax.store import RunResult, save


def result_of(number: int) -> RunResult:
    """A result that tells by every value which one it is."""
    gridded = small_grid(np.random.default_rng(0), wavelength_nm=UNIFORM_NM)
    gridded.brdf[:] = number
    return RunResult(gridded=gridded, config=str(number))


def write_for_ever(path, first: int) -> None:
    """Write one result after the other under the same name."""
    for number in itertools.count(first):
        save(path, result_of(number))


def write_some(path, first: int, count: int) -> None:
    """Write so many results under the same name."""
    for number in range(first, first + count):
        save(path, result_of(number))


def write_on_a_full_disk(path, num_bytes: int, answer) -> None:
    """Write one result where no file may be larger than `num_bytes`; `answer` takes the error's text."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, num_bytes))
    answer.put(_error_of_writing(path))


def write_as_another_user(path, answer) -> None:
    """Write one result as a user who owns nothing, where this one is the administrator."""
    if os.getuid() == 0:
        os.setgid(65534)
        os.setuid(65534)
    answer.put(_error_of_writing(path))


def _error_of_writing(path) -> str:
    try:
        save(path, result_of(1))
    except UserError as error:
        return str(error)
    return ""
