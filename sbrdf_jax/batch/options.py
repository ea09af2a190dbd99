"""Frozen option records of a library file, as `sbrdf_jax/options.py` has those of a config."""

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Ge, MinLen

from sbrdf_jax.options import Auto, Text

_STRICT: Any = {"extra": "forbid", "strict": True, "allow_inf_nan": False, "use_attribute_docstrings": True}

Count = Annotated[int, Ge(1)]


@dataclass(frozen=True)
class MaterialOptions:
    """One material of a library."""

    __pydantic_config__ = _STRICT

    name: Text
    """Name of its result, NAME.h5; letters, digits and . _ + - only."""
    input: Text
    """Its measurement, relative to the library file, or builtin:NAME."""
    overrides: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Keys of the config, dotted, and their values; a block replaces the whole block."""


@dataclass(frozen=True)
class SlurmOptions:
    """A job array of Slurm."""

    __pydantic_config__ = _STRICT

    shards: Count = 8
    """Tasks of the array; each takes an equal part of the library."""
    options: tuple[Text, ...] = ()
    """Lines of options for sbatch, such as --time=02:00:00; the shard's cores are executor.workers x threads."""
    set_up: tuple[Text, ...] = ()
    """Lines of shell that each task runs first, such as module load python."""


@dataclass(frozen=True)
class DaskOptions:
    """A dask.distributed scheduler that runs, or one whose workers dask-jobqueue asks a cluster for."""

    __pydantic_config__ = _STRICT

    address: Text | None = None
    """Address of a scheduler that runs; null: start one, with workers of `cluster`."""
    cluster: Literal["local", "slurm", "pbs", "lsf", "sge", "moab", "oar", "htcondor"] = "local"
    """Who starts the workers."""
    memory: Text = "4GiB"
    """Memory of a worker."""
    walltime: Text | None = None
    """Time limit of a worker's job, as the cluster writes it."""
    queue: Text | None = None
    """Queue or partition."""
    options: tuple[Text, ...] = ()
    """Further lines of options for the cluster's job script."""
    set_up: tuple[Text, ...] = ()
    """Lines of shell that each worker's job runs first."""


@dataclass(frozen=True)
class ExecutorOptions:
    """What runs the materials."""

    __pydantic_config__ = _STRICT

    kind: Literal["local", "slurm", "dask"] = "local"
    """local: processes of this machine; slurm: a job array; dask: dask.distributed."""
    workers: Auto | Count = "auto"
    """Processes at a time; auto: one for each core that this process may use, and no more than materials."""
    threads: Auto | Count = "auto"
    """Threads of each; auto: the cores divided by the workers."""
    tries: Count = 3
    """How often a material is tried whose worker dies."""
    compile_cache: Text | None = None
    """Folder to keep compiled code in, relative to the working directory; null: none is kept."""
    slurm: SlurmOptions = SlurmOptions()
    """A job array of Slurm."""
    dask: DaskOptions = DaskOptions()
    """dask.distributed."""


@dataclass(frozen=True)
class LibraryOptions:
    """A library file."""

    __pydantic_config__ = _STRICT

    base: Text
    """A config, relative to the library file; the keys of every material that its overrides do not set."""
    materials: Annotated[tuple[MaterialOptions, ...], MinLen(1)] | Text
    """A list; a glob such as measured/*.brdf; or a CSV table with columns name, input and keys of the config."""
    output_folder: Text
    """Where the results go, relative to the working directory."""
    executor: ExecutorOptions = ExecutorOptions()
    """What runs the materials."""
