"""Where each stage's record lies in the result file, with what units and axes: write and read."""

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np

from sbrdf_jax.cleaning import CleanEntry, CleanReport, Flag
from sbrdf_jax.colour import ColourMatching
from sbrdf_jax.compact_layout import read_basis, status_dataset, write_basis
from sbrdf_jax.coverage import Coverage
from sbrdf_jax.encoding import coefficient_names
from sbrdf_jax.hdf5 import (
    attribute,
    dataset,
    dataset_of,
    degrees,
    read,
    read_mapping,
    scale,
    write_array,
    write_mapping,
)
from sbrdf_jax.interpolation import neighbours
from sbrdf_jax.quadrature import Quadrature
from sbrdf_jax.records import GriddedBRDF, SpectralField
from sbrdf_jax.resampling.guided.error_model import ResidualScale
from sbrdf_jax.resampling.guided.field import LAST_AXIS, GuidedField, WholeSpectrum
from sbrdf_jax.resampling.guided.lobe_model import SHAPE_NAMES, LobeModel
from sbrdf_jax.resampling.guided.nodes import GRIDS, ModeVariance, mirror
from sbrdf_jax.scores import SCORE_TEXT

GUIDED_PARTS = {"lobe": LobeModel, "variance": ModeVariance, "scale": ResidualScale, "measured": WholeSpectrum}
WAVELENGTHS_A_CHUNK = 8  # a wavelength between the measured ones needs four
_ANGLES = ("theta_i", "theta_o", "phi_o")
_PROOF = ("kkt_residual", "num_steps", "status")
_EVERY = slice(None)

# Axes and units of what validation stores, by the last part of the name; scores and counts have neither.
VALIDATION_AXES = {
    "predicted": ("row", "wavelength"),
    "expected_error": ("row", "wavelength"),
    "fold": ("row",),
    "status": ("fit", "wavelength"),
}
VALIDATION_UNITS = {"predicted": "1/sr", "expected_error": "1/sr", "lower_deg": "deg", "upper_deg": "deg"}


def write_grid(group: h5py.Group, gridded: GriddedBRDF) -> None:
    """Write the resampled field at its nodes, and how well each wavelength was solved."""
    for name in ("method", "window"):
        group.attrs[name] = getattr(gridded, name)
    for name in ("bilateral", "interpolate_theta_i"):
        group.attrs[name] = bool(getattr(gridded, name))
    axes = {name: scale(group, f"{name}_deg", degrees(getattr(gridded, name)), "deg") for name in _ANGLES}
    axes["wavelength"] = scale(group, "wavelength_nm", gridded.wavelength_nm, "nm")
    directions = [axes[name] for name in _ANGLES]
    some = min(np.shape(gridded.brdf)[-1], WAVELENGTHS_A_CHUNK)
    chunks = (1, *np.shape(gridded.brdf)[1:-1], some)
    dataset(group, "brdf", gridded.brdf, "1/sr", [*directions, axes["wavelength"]], chunks=chunks)
    flags = dataset(group, "extrapolated", np.asarray(gridded.extrapolated, np.uint8), "1", directions)
    flags.attrs["names"] = "measured nearby,interpolated,beyond the measured range"
    dataset(group, "kkt_residual", gridded.kkt_residual, "1", [axes["wavelength"]])
    dataset(group, "num_steps", np.asarray(gridded.num_steps, np.int64), "1", [axes["wavelength"]])
    status_dataset(group, gridded.status, [axes["wavelength"]])
    if gridded.needed is not None:
        dataset(group, "needed", np.asarray(gridded.needed, np.uint8), "1", directions)
    if gridded.residual_variance is not None:
        dataset(group, "residual_variance", gridded.residual_variance, "1", directions)
    if gridded.standard_error is not None:
        error = gridded.standard_error
        dataset(group, "standard_error", error, "1/sr", [*directions, axes["wavelength"]], chunks=chunks)


def write_guided(group: h5py.Group, field: GuidedField) -> None:
    """Write what evaluates the guided field at any direction."""
    record = {f.name: getattr(field, f.name) for f in dataclasses.fields(field)}
    arrays = {name: np.asarray(value) for name, value in record.items() if name not in GUIDED_PARTS}
    for name in GRIDS:
        arrays[name] = arrays[name][1:-1, 1:-1, 1:-1]  # the mirrored nodes follow
    for name in ("theta_limit", "centre"):
        arrays[f"{name}_deg"] = degrees(arrays.pop(name))
    parts = {name: {f: np.asarray(v) for f, v in vars(record[name]).items()} for name in GUIDED_PARTS}
    for name in LAST_AXIS:
        value = arrays.pop(name)
        write_array(group, name, value, "1", chunks=(*value.shape[:-1], min(value.shape[-1], WAVELENGTHS_A_CHUNK)))
    write_mapping(group, arrays | parts | {"lobe_shape": list(SHAPE_NAMES)}, "1")
    for name, grid in GRIDS.items():
        for axis, label in zip(grid.axes, grid.coordinates, strict=True):
            group[name].attrs[f"{label}_nodes"] = axis.nodes


def write_quadrature(group: h5py.Group, quadrature: Quadrature, grid: h5py.Group) -> None:
    """Write the weights of a colour: XYZ is pi times brdf @ weight, Y = 100 for the perfect diffuser."""
    names = scale(group, "tristimulus", np.arange(3), "1")
    matching = quadrature.matching
    dataset(group, "weight", matching.weight, "1", [dataset_of(grid, "wavelength_nm"), names])
    dataset(group, "white", matching.white, "1", [names])
    for name in ("observer", "illuminant", "delta_e", "limit"):
        group.attrs[name] = getattr(quadrature, name)
    group.attrs["note"] = matching.note


def read_quadrature(group: h5py.Group, gridded: GriddedBRDF) -> Quadrature:
    """Read what `write_quadrature` wrote."""
    wavelength_nm = np.asarray(gridded.wavelength_nm)
    note = str(attribute(group, "note"))
    matching = ColourMatching(wavelength_nm, read(group, "weight", (len(wavelength_nm), 3)), read(group, "white"), note)
    texts = (str(attribute(group, name)) for name in ("observer", "illuminant"))
    numbers = (float(attribute(group, name)) for name in ("delta_e", "limit"))
    return Quadrature(np.arange(len(wavelength_nm)), matching, *texts, *numbers)


def write_field(group: h5py.Group, field: SpectralField, grid: h5py.Group) -> None:
    """Write the spectral coefficients at the nodes of the grid."""
    names = coefficient_names(field.basis)
    wavelength, own_nm = dataset_of(grid, "wavelength_nm"), np.asarray(field.basis.wavelength_nm)
    if len(own_nm) != len(wavelength):  # without those that failed
        wavelength = scale(group, "wavelength_nm", own_nm, "nm")
    index = write_basis(group, field.basis, wavelength)
    axes = [dataset_of(grid, f"{name}_deg") for name in _ANGLES]
    written = dataset(
        group, "coefficients", field.coefficient, "1" if field.basis.is_logarithmic else "1/sr", [*axes, index]
    )
    written.attrs["basis"] = field.basis.kind
    written.attrs["coefficient_order"] = ",".join(names)


def write_cleaning(group: h5py.Group, report: CleanReport) -> None:
    """Write the cleaning report: a flag per row of the file, and the table of counts and reasons."""
    row = scale(group, "row", np.arange(len(report.flag)), "1")
    flag = dataset(group, "flag", report.flag, "1", [row])
    flag.attrs["bits"] = json.dumps({f.name.lower(): f.value for f in Flag if f.name and f.value})
    dataset(group, "dead_wavelength_nm", report.dead_wavelength_nm, "nm", [])
    group.attrs["num_rows"] = report.num_rows
    group.attrs["num_kept"] = report.num_kept
    group.attrs["bilateral"] = report.bilateral
    group.attrs["entries"] = json.dumps([dataclasses.asdict(entry) for entry in report.entries])
    theta_i = scale(group, "covered_theta_i_deg", degrees(report.coverage.theta_i), "deg")
    dataset(group, "covered_count", report.coverage.count, "1", [theta_i])
    dataset(group, "covered_theta_o_range_deg", degrees(report.coverage.theta_o_range), "deg", [])
    group.attrs["covers_both_half_planes"] = report.coverage.covers_both_half_planes
    group.attrs["covered"] = json.dumps(report.coverage.covered)
    group.attrs["missing"] = json.dumps(report.coverage.missing)


def write_validation(
    group: h5py.Group, validation: Mapping[str, np.ndarray], grid: h5py.Group, measured_nm: np.ndarray
) -> None:
    """Write held-out predictions, a row for each input row in file order, and their scores.

    Args:
        group: The empty group `validation`.
        validation: Arrays by name; a name with "/" lies in a group of its own.
        grid: The group `grid`, for the wavelengths.
        measured_nm: The wavelengths that are validated: all, also where a scene needs fewer.
    """
    wavelength = dataset_of(grid, "wavelength_nm")
    if wavelength.shape != measured_nm.shape:
        wavelength = scale(group, "wavelength_nm", measured_nm, "nm")
    for name, value in validation.items():
        *parents, last = name.split("/")
        inner = group.require_group("/".join(parents)) if parents else group
        default = ("bin",) * np.ndim(value)
        axes = []
        for axis, size in zip(VALIDATION_AXES.get(last, default), np.shape(value), strict=True):
            if axis != "wavelength" and axis not in inner:
                scale(inner, axis, np.arange(size), "1")
            axes.append(wavelength if axis == "wavelength" else dataset_of(inner, axis))
        if last == "status":
            status_dataset(inner, value, axes)
            continue
        written = dataset(inner, last, value, VALIDATION_UNITS.get(last, "1"), axes)
        if last in SCORE_TEXT:
            written.attrs["meaning"] = SCORE_TEXT[last]


def read_guided(group: h5py.Group, lanes: np.ndarray | slice = _EVERY) -> GuidedField:
    """Read the guided field at some of its wavelengths, by index; no more of the large arrays than their chunks."""
    stored = read_mapping(group, without=LAST_AXIS)
    count = len(dataset_of(group, "wavelength_nm"))
    for name in LAST_AXIS:
        if name == "difference" and name not in group:  # written before there was this grid
            shape = [axis.count for axis in GRIDS[name].axes]
            stored[name] = np.zeros((*shape, len(np.arange(count)[lanes])))
            continue
        stored[name] = read(group, name, (*dataset_of(group, name).shape[:-1], count), last=lanes)
    stored["lobe"].setdefault("mirror_power", 2.0)  # written before it was stored
    stored["lobe"]["log_amplitude"] = stored["lobe"]["log_amplitude"][:, lanes]
    parts = {name: kind(**stored.pop(name)) for name, kind in GUIDED_PARTS.items()}
    angles = {name: np.deg2rad(stored.pop(f"{name}_deg")) for name in ("theta_limit", "centre")}
    variance, lobe = parts["variance"], parts["lobe"]
    parts["variance"] = dataclasses.replace(variance, reciprocal=bool(variance.reciprocal))
    parts["lobe"] = dataclasses.replace(lobe, mirror_power=float(lobe.mirror_power))
    names = {f.name for f in dataclasses.fields(GuidedField)}
    plain = {name: np.asarray(value) for name, value in stored.items() if name in names}
    nodes = {name: mirror(plain.pop(name)) for name in GRIDS}
    return GuidedField(**plain, **parts, **angles, **nodes)


def read_grid(group: h5py.Group, field: h5py.Group | None = None) -> GriddedBRDF:
    """Read the resampled field, with what evaluates it where that is more than the nodes."""
    *directions, lanes = _grid_shape(group)
    return GriddedBRDF(
        **_read_axes(group),
        brdf=read(group, "brdf", (*directions, lanes)),
        extrapolated=read(group, "extrapolated", (*directions,)),
        standard_error=read(group, "standard_error", (*directions, lanes)) if "standard_error" in group else None,
        residual_variance=read(group, "residual_variance", (*directions,)) if "residual_variance" in group else None,
        needed=read(group, "needed", (*directions,)) > 0 if "needed" in group else None,
        field=None if field is None else read_guided(field),
    )


def read_query(group: h5py.Group, field: h5py.Group | None, wavelength_nm: np.ndarray | None) -> GriddedBRDF:
    """Read what evaluates the resampled field at some wavelengths [nm] in the measured range, all unless given.

    The record holds the measured wavelengths around them and their proof. The values at the
    nodes are None where `field` evaluates it, the flags and errors at the nodes always.
    """
    lanes = _EVERY if wavelength_nm is None else neighbours(wavelength_nm, read(group, "wavelength_nm"))
    return GriddedBRDF(
        **_read_axes(group, lanes),
        brdf=read(group, "brdf", _grid_shape(group), last=lanes) if field is None else None,
        extrapolated=None,
        field=None if field is None else read_guided(field, lanes),
    )


def _grid_shape(group: h5py.Group) -> tuple[int, ...]:
    return tuple(len(dataset_of(group, name)) for name in (*(f"{angle}_deg" for angle in _ANGLES), "wavelength_nm"))


def _read_axes(group: h5py.Group, lanes: np.ndarray | slice = _EVERY) -> dict[str, Any]:
    """Read nodes and method of a grid and, at some of its wavelengths, how well each was solved."""
    wavelength_nm = read(group, "wavelength_nm")
    return {
        **{name: np.deg2rad(read(group, f"{name}_deg")) for name in _ANGLES},
        "wavelength_nm": wavelength_nm[lanes],
        **{name: read(group, name, wavelength_nm.shape)[lanes] for name in _PROOF},
        **{name: str(attribute(group, name)) for name in ("method", "window")},
        **{name: bool(attribute(group, name)) for name in ("bilateral", "interpolate_theta_i")},
    }


def read_field(group: h5py.Group, gridded: GriddedBRDF) -> SpectralField:
    """Read the spectral coefficients and their basis."""
    stored = dataset_of(group, "coefficients")
    wavelength_nm = read(group, "wavelength_nm") if "wavelength_nm" in group else np.asarray(gridded.wavelength_nm)
    basis = read_basis(group, attribute(stored, "basis"), wavelength_nm, stored.shape[-1])
    shape = (*np.shape(gridded.brdf)[:3], stored.shape[-1])
    return SpectralField(
        gridded.theta_i,
        gridded.theta_o,
        gridded.phi_o,
        coefficient=read(group, "coefficients", shape),
        basis=basis,
        window=gridded.window,
        interpolate_theta_i=gridded.interpolate_theta_i,
    )


def read_cleaning(group: h5py.Group) -> CleanReport:
    """Read the cleaning report."""
    low, high = np.deg2rad(read(group, "covered_theta_o_range_deg", (2,)))
    coverage = Coverage(
        theta_i=np.deg2rad(read(group, "covered_theta_i_deg")),
        count=read(group, "covered_count"),
        theta_o_range=(float(low), float(high)),
        covers_both_half_planes=bool(attribute(group, "covers_both_half_planes")),
        covered=tuple(json.loads(attribute(group, "covered"))),
        missing=tuple(json.loads(attribute(group, "missing"))),
    )
    stored = json.loads(attribute(group, "entries"))
    entries = (CleanEntry(**entry | {"examples": tuple(entry["examples"])}) for entry in stored)
    return CleanReport(
        flag=read(group, "flag"),
        entries=tuple(entries),
        dead_wavelength_nm=read(group, "dead_wavelength_nm"),
        num_rows=int(attribute(group, "num_rows")),
        num_kept=int(attribute(group, "num_kept")),
        bilateral=bool(attribute(group, "bilateral")),
        coverage=coverage,
    )
