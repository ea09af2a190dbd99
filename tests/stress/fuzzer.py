"""Read damaged files, one after the other: python -m tests.stress.fuzzer KIND FIRST COUNT FOLDER.

Every input is an answer or a `UserError` of one line, in bounded time and memory; else the process prints what it is
and ends with 1, or a signal ends it: the file `at` in FOLDER then says at which input. An input is made of its number
alone, so that it can be had again.
"""

import itertools
import math
import os
import resource
import shutil
import signal
import sys
from pathlib import Path

import numpy as np

from sbrdf_jax.errors import UserError
from tests.stress.mutations import damaged, lie

SECONDS = 20  # for one input; a signal ends the process then, in a library too
MAX_BYTES = 3 * 2**30  # of the process' data, libraries and their threads included
LIES_SHARE = 0.3  # of HDF5 inputs are sound files with hostile content
LONGEST_MESSAGE = 700


def read_measurement(path):
    """Read samples, and look whether they can be some."""
    from sbrdf_jax import formats
    from sbrdf_jax.options import InputOptions

    found = formats.read(path, InputOptions(path="unused"))
    assert found.value.shape == (found.num_samples, len(found.wavelength_nm)) and found.num_samples >= 4
    assert (found.wavelength_nm > 0).all() and not (np.abs(found.theta_i) > math.pi / 2 + 1e-4).any()


def read_result(path) -> list[bytes]:
    """Read and describe a result; return all its numbers."""
    import jax

    from sbrdf_jax.store import describe, load

    found = load(path)
    grid = found.gridded
    assert np.shape(grid.brdf) == tuple(map(len, (grid.theta_i, grid.theta_o, grid.phi_o, grid.wavelength_nm)))
    describe(path)
    arrays = [leaf for stage in (grid, found.compact, found.field) for leaf in jax.tree.leaves(stage)]
    return [np.asarray(array).tobytes() for array in arrays]


def read_config(path):
    """Read and resolve a config."""
    from sbrdf_jax.config import load_config, resolve

    resolve(load_config(path))


def read_evaluated_directions(path):
    """Read the directions of `sbrdf evaluate`."""
    from sbrdf_jax.commands.evaluate import read_directions

    read_directions(path)


def read_folds(path):
    """Read given folds."""
    from sbrdf_jax.folds import read_fold_file

    read_fold_file(str(path), 5)


READERS = {
    "pbrt": read_measurement,
    "csv": read_measurement,
    "nist": read_measurement,
    "raw_hdf5": read_measurement,
    "result": read_result,
    "config": read_config,
    "directions": read_evaluated_directions,
    "folds": read_folds,
}
BINARY = ("raw_hdf5", "result")


def outcome(read, path: Path, sound=None) -> str | None:
    """Return what is wrong with the way a file was read, None where nothing is.

    Args:
        read: The reader.
        path: The file.
        sound: What a damaged file must give if it gives anything; None: whatever it is.
    """
    try:
        found = read(path)
        if sound is not None and found != sound:
            return "damaged, and read as other numbers"
    except UserError as error:
        message = str(error)
        if "\n" in message or len(message) > LONGEST_MESSAGE + 2 * len(str(path)):
            return f"a message of {len(message)} characters and {len(message.splitlines())} lines"
    except Exception as error:  # whatever it is, it is what is looked for
        return f"{type(error).__name__}: {error}"
    return None


def main(kind: str, first: int, count: int, folder: Path) -> int:
    """Read inputs `first` to `first + count` of a kind; the seed files lie in FOLDER/seeds."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    is_text, read = kind not in BINARY, READERS[kind]
    seeds = sorted((folder / "seeds").glob(f"{kind}*"))
    contents = [seed.read_bytes() for seed in seeds]
    path, progress = folder / "input", os.open(folder / "at", os.O_CREAT | os.O_RDWR)
    sound = [read(shutil.copy(seed, path)) for seed in seeds]  # imports and compiles what it takes, too
    resource.setrlimit(resource.RLIMIT_DATA, (MAX_BYTES, MAX_BYTES))
    for number in itertools.islice(itertools.count(first), count):
        rng = np.random.default_rng([sum(kind.encode()), number])
        os.pwrite(progress, f"{number:<12}".encode(), 0)
        choice = int(rng.integers(len(seeds)))
        is_lie = not is_text and rng.random() < LIES_SHARE
        if is_lie:
            shutil.copy(seeds[choice], path)
            lie(rng, path)
        else:
            path.write_bytes(damaged(rng, contents[choice], is_text=is_text))
        signal.alarm(SECONDS)
        wrong = outcome(read, path, None if is_text or is_lie else sound[choice])
        signal.alarm(0)
        if wrong:
            print(f"{kind} {number}: {wrong}", flush=True)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])))
