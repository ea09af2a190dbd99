"""The result file: HDF5 names, units, scales and schema version; write and read.

Angles are stored in degrees, wavelengths in nm, BRDF values in 1/sr. Every dataset has a
`units` attribute and a dimension scale on each axis; big ones are chunked by theta_i, and by
wavelength where a query reads few of them. The group `compact` alone is enough to evaluate the
compact form.
"""

import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from sbrdf_jax.cleaning import CleanReport
from sbrdf_jax.compact_layout import read_compact, write_compact
from sbrdf_jax.errors import UserError
from sbrdf_jax.files import whole_file
from sbrdf_jax.hdf5 import (
    attribute,
    dataset,
    dataset_of,
    degrees,
    file_in_memory,
    group_of,
    one_line_errors,
    read,
    read_datasets,
    read_mapping,
    scale,
    write_mapping,
)
from sbrdf_jax.interpolation import outside_range
from sbrdf_jax.layout import (
    read_cleaning,
    read_field,
    read_grid,
    read_quadrature,
    read_query,
    write_cleaning,
    write_field,
    write_grid,
    write_guided,
    write_quadrature,
    write_validation,
)
from sbrdf_jax.metrics import METRIC_AXES, METRIC_UNITS
from sbrdf_jax.quadrature import Quadrature
from sbrdf_jax.records import CompactBRDF, GriddedBRDF, LobeHarmonics, LobeTensor, SpectralField
from sbrdf_jax.schema import SCHEMA_NAME, SCHEMA_VERSION, open_result


@dataclasses.dataclass(frozen=True)
class RunResult:
    """All that a run found, and where it came from."""

    gridded: GriddedBRDF
    field: SpectralField | None = None
    compact: CompactBRDF | LobeHarmonics | LobeTensor | None = None
    metrics: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    clean: CleanReport | None = None
    input: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # JSON values: source, quantity, notes, ...
    validation: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)  # names with "/" are groups
    plan: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # numbers, arrays, text; nested mappings
    timing: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # seconds; nested mappings
    warnings: tuple[str, ...] = ()
    config: str = ""  # the resolved YAML
    source_sha256: str = ""
    created_utc: str = ""
    versions: Mapping[str, str] = dataclasses.field(default_factory=dict)
    quadrature: Quadrature | None = None  # where the scene needed colours alone

    @property
    def measured_nm(self) -> np.ndarray:
        """All measured wavelengths [nm], those too that the scene did not need."""
        scene = self.plan.get("scene", {})
        return np.asarray(scene["wavelength_nm"] if "wavelength_nm" in scene else self.gridded.wavelength_nm)


def save(path: str | os.PathLike, result: RunResult) -> None:
    """Write a result so that a kill at any moment leaves the whole file or none under its name.

    Raises:
        UserError: the path cannot be written.
    """
    with whole_file(path) as temporary, file_in_memory(temporary) as file:
        write_result(file, result)


def write_result(file: h5py.File, result: RunResult) -> None:
    """Write every group of a result into an open, empty file."""
    file.attrs["schema_name"] = SCHEMA_NAME
    file.attrs["schema_version"] = SCHEMA_VERSION
    file.attrs["config"] = result.config
    file.attrs["config_sha256"] = hashlib.sha256(result.config.encode()).hexdigest()
    file.attrs["source_sha256"] = result.source_sha256
    file.attrs["created_utc"] = result.created_utc
    file.attrs["versions"] = json.dumps(dict(result.versions), sort_keys=True)
    file.attrs["warnings"] = json.dumps(list(result.warnings))
    grid = file.create_group("grid")
    write_grid(grid, result.gridded)
    if result.gridded.field is not None:
        write_guided(file.create_group("field"), result.gridded.field)
    if result.field is not None:
        write_field(file.create_group("spectral"), result.field, grid)
    if result.compact is not None:
        write_compact(file.create_group("compact"), result.compact)
    write_input(file.create_group("input"), result)
    write_metrics(file.create_group("metrics"), result, grid)
    if result.validation:
        write_validation(file.create_group("validation"), result.validation, grid, result.measured_nm)
    if result.quadrature is not None:
        write_quadrature(file.create_group("colour"), result.quadrature, grid)
    write_mapping(file.create_group("plan"), result.plan, "1")
    write_mapping(file.create_group("timing"), result.timing, "s")


def write_input(group: h5py.Group, result: RunResult) -> None:
    """Write what came in, as attributes, and the cleaning report below `cleaning`."""
    for name, value in result.input.items():
        group.attrs[name] = json.dumps(value)
    if result.clean is not None:
        write_cleaning(group.create_group("cleaning"), result.clean)


def write_metrics(group: h5py.Group, result: RunResult, grid: h5py.Group) -> None:
    """Write every metric with the axes and the unit that `metrics` names for it."""
    theta_i = np.asarray(result.gridded.theta_i)
    axes = {"theta_i": dataset_of(grid, "theta_i_deg"), "wavelength": dataset_of(grid, "wavelength_nm")}
    if "relative_error_between_theta_i" in result.metrics:
        midway = degrees((theta_i[:-1] + theta_i[1:]) / 2)
        axes["theta_i_between"] = scale(group, "theta_i_between_deg", midway, "deg")
    for name, value in result.metrics.items():
        default = ("theta_i",) * np.ndim(value)
        names = METRIC_AXES.get(name, default)
        dataset(group, name, value, METRIC_UNITS.get(name, "1"), [axes[axis] for axis in names])


@one_line_errors
def load(path: str | os.PathLike) -> RunResult:
    """Read a whole result.

    Raises:
        UserError: as `open_result`, or the file is damaged.
    """
    with open_result(path) as file:
        source = group_of(file, "input")
        gridded = read_grid(group_of(file, "grid"), _field_of(file))
        compact = read_compact(group_of(file, "compact")) if "compact" in file else None
        return RunResult(
            gridded=gridded,
            field=read_field(group_of(file, "spectral"), gridded) if "spectral" in file else None,
            compact=compact,
            metrics=read_datasets(group_of(file, "metrics")),
            clean=read_cleaning(group_of(source, "cleaning")) if "cleaning" in source else None,
            input={name: json.loads(attribute(source, name)) for name in source.attrs},
            validation=read_datasets(group_of(file, "validation")) if "validation" in file else {},
            plan=read_mapping(group_of(file, "plan")),
            timing=read_mapping(group_of(file, "timing")),
            warnings=tuple(json.loads(attribute(file, "warnings"))),
            config=str(attribute(file, "config")),
            source_sha256=str(attribute(file, "source_sha256")),
            created_utc=str(attribute(file, "created_utc")),
            versions=json.loads(attribute(file, "versions")),
            quadrature=read_quadrature(group_of(file, "colour"), gridded) if "colour" in file else None,
        )


@one_line_errors
def load_stage(
    path: str | os.PathLike, stage: str, wavelength_nm: npt.ArrayLike | None = None
) -> GriddedBRDF | CompactBRDF | LobeHarmonics | LobeTensor:
    """Read what `evaluate` needs of one stage, for all wavelengths or a few, and nothing else.

    The values are those of the whole result, but for rounding. Of a large array only the chunks
    around the wavelengths are read.

    Args:
        path: A result of `run`.
        stage: "grid" or "compact".
        wavelength_nm: Where the record will be evaluated [nm], [query], in the measured range; the measured wavelengths
            unless given.

    Returns:
        The record. That of the grid holds only the measured wavelengths [nm] around those asked for, up to two on
        each side: pass these to `evaluate`, and no others. Its `brdf` is None where `field` is what evaluates it;
        `extrapolated`, `standard_error`, `residual_variance` and `needed` are always None. The compact form is
        small, and whole.

    Raises:
        UserError: as `load`, the result has no such stage, or a wavelength is not in the measured range.
    """
    with open_result(path) as file:
        found = [name for name in ("grid", "compact") if name in file]
        if stage not in found:
            raise UserError(f"{path}: stage {stage}: not in this result, found {', '.join(found) or 'none'}")
        group = group_of(file, stage)
        if wavelength_nm is not None:
            wavelength_nm = np.atleast_1d(np.asarray(wavelength_nm, float))
            measured_nm = read(group, "wavelength_nm")
            wrong = wavelength_nm[outside_range(wavelength_nm, measured_nm)]
            if wrong.size or not wavelength_nm.size:
                shown = f"{wrong[0]:g}" if wrong.size else "none"
                expected = f"expected {measured_nm[0]:g} to {measured_nm[-1]:g} nm, as measured"
                raise UserError(f"{path}: wavelength: found {shown}, {expected}")
        return read_compact(group) if stage == "compact" else read_query(group, _field_of(file), wavelength_nm)


def _field_of(file: h5py.File) -> h5py.Group | None:
    return group_of(file, "field") if "field" in file else None


@one_line_errors
def describe(path: str | os.PathLike) -> list[str]:
    """Describe a result in lines for a user: what the file is, then the tables of its summary.

    Raises:
        UserError: as `load`.
    """
    from sbrdf_jax.summary import summary_text  # it formats what this module stores

    result = load(path)
    versions = ", ".join(f"{name} {version}" for name, version in result.versions.items())
    head = [
        f"{path}: {SCHEMA_NAME}, schema {SCHEMA_VERSION}, {Path(path).stat().st_size / 2**20:.1f} MiB",
        f"created {result.created_utc or 'at an unknown time'} with {versions or 'unknown versions'}",
        f"source sha256 {result.source_sha256 or 'unknown'}",
        "",
    ]
    return head + summary_text(result).splitlines()
