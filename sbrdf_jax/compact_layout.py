"""Where the compact form lies in the result file: all that its evaluation needs, in one group."""

import json

import h5py
import numpy as np

from sbrdf_jax.encoding import coefficient_names, make_basis, vector_basis
from sbrdf_jax.errors import UserError
from sbrdf_jax.harmonics import harmonic_orders
from sbrdf_jax.hdf5 import attribute, dataset, dataset_of, degrees, read, scale
from sbrdf_jax.lobes import LOBE_KINDS
from sbrdf_jax.metrics import stored_numbers
from sbrdf_jax.records import STATUS_TEXT, CompactBRDF, LobeHarmonics, LobeTensor, SpectralBasis, Status
from sbrdf_jax.representation.joint_fit import NUM_LOBES
from sbrdf_jax.representation.lobe_family import SHAPES
from sbrdf_jax.representation.lobe_harmonics import stored_harmonics
from sbrdf_jax.representation.lobe_harmonics_value import even_orders

_FACTORS = {  # dataset: its axes
    "log_scale": ("theta_i_function",),
    "theta_i_factor": ("theta_i_function", "theta_i_rank"),
    "theta_o_factor": ("theta_o_function", "theta_o_rank"),
    "direction_factor": ("direction_function", "direction_rank"),
    "core": ("theta_i_rank", "theta_o_rank", "direction_rank", "coefficient"),
}


def write_compact(group: h5py.Group, compact: CompactBRDF | LobeHarmonics | LobeTensor) -> None:
    """Write all that evaluation of the compact stage needs, and how each lane ended."""
    group.attrs["stored_numbers"] = stored_numbers(compact)
    group.attrs["basis"] = compact.basis.kind
    group.attrs["interpolate_theta_i"] = bool(compact.interpolate_theta_i)
    scale(group, "theta_i_deg", degrees(compact.theta_i), "deg")
    scale(group, "wavelength_nm", compact.basis.wavelength_nm, "nm")
    if isinstance(compact, LobeTensor):
        _write_tensor(group, compact)
    elif isinstance(compact, LobeHarmonics):
        _write_harmonics(group, compact)
    else:
        _write_paper(group, compact)


def read_compact(group: h5py.Group) -> CompactBRDF | LobeHarmonics | LobeTensor:
    """Read the compact form from its group alone."""
    method = str(attribute(group, "method"))
    readers = {"paper": _read_paper, "lobe_harmonics": _read_harmonics, "lobe_tensor": _read_tensor}
    if method not in readers:
        found = f"found {method!r}, expected one of {', '.join(readers)}"
        raise UserError(f"{group.file.filename}: compact: method: {found}")
    return readers[method](group)


def _write_tensor(group: h5py.Group, tensor: LobeTensor) -> None:
    """Write scales, factors and core."""
    group.attrs["method"] = "lobe_tensor"
    group.attrs["half_angle_floor"] = tensor.half_angle_floor
    axes = {"coefficient": write_basis(group, tensor.basis, dataset_of(group, "wavelength_nm"))}
    for name, names in _FACTORS.items():
        value = np.asarray(getattr(tensor, name))
        for axis, size in zip(names, value.shape, strict=True):
            axes[axis] = axes.get(axis) or scale(group, axis, np.arange(size), "1")
        dataset(group, name, value, "1", [axes[axis] for axis in names])
    group["log_scale"].attrs["meaning"] = "coefficients [1/sr] are exp(-log_scale) times what the factors make"
    ends = scale(group, "theta_i_range_deg", degrees(tensor.theta_i_range), "deg")
    ends.attrs["meaning"] = "splines of theta_i span this range; beyond it the factors are those of its ends"
    status_dataset(group, tensor.status, [dataset_of(group, "theta_i_deg")])


def _read_tensor(group: h5py.Group) -> LobeTensor:
    """Read scales, factors and core."""
    theta_i, wavelength_nm = read(group, "theta_i_deg"), read(group, "wavelength_nm")
    sizes = {axis: len(read(group, axis)) for names in _FACTORS.values() for axis in names}
    factors = {name: read(group, name, tuple(sizes[axis] for axis in names)) for name, names in _FACTORS.items()}
    return LobeTensor(
        theta_i=np.deg2rad(theta_i),
        theta_i_range=np.deg2rad(read(group, "theta_i_range_deg", (2,))),
        basis=read_basis(group, attribute(group, "basis"), wavelength_nm, sizes["coefficient"]),
        status=read(group, "status", (len(theta_i),)),
        half_angle_floor=float(attribute(group, "half_angle_floor")),
        interpolate_theta_i=bool(attribute(group, "interpolate_theta_i")),
        **factors,
    )


def _write_harmonics(group: h5py.Group, compact: LobeHarmonics) -> None:
    """Write lobes and backgrounds; heights and harmonics one after another, those that are 0 left out."""
    group.attrs["method"] = "lobe_harmonics"
    group.attrs["max_degree"] = compact.max_degree
    coefficient = write_basis(group, compact.basis, dataset_of(group, "wavelength_nm"))
    fitted = scale(group, "fitted_theta_i_deg", degrees(compact.fitted_theta_i), "deg")
    lobe = [fitted, scale(group, "lobe", np.arange(NUM_LOBES), "1")]
    degree = dataset(group, "degree", np.asarray(compact.degree, np.int64), "1", [fitted, coefficient])
    degree.attrs["meaning"] = "of the background of a coefficient; -1: the coefficient is 0, lobes included"
    kind = dataset(group, "lobe_kind", np.asarray(compact.lobe_kind, np.int64), "1", lobe)
    kind.attrs["names"] = ",".join(SHAPES)
    width = dataset(group, "lobe_width", compact.lobe_width, "1", lobe)
    width.attrs["meaning"] = "rad^2 for angle_squared, else without unit"
    dataset(group, "lobe_peak_theta_o_deg", degrees(compact.lobe_peak_theta_o), "deg", lobe)
    has_harmonic, has_height = stored_harmonics(compact)
    background = dataset(group, "background", np.asarray(compact.background)[has_harmonic], "1/sr", [])
    background.attrs["harmonic_order"] = np.array(even_orders(compact.max_degree))  # rows of (l, m)
    background.attrs["meaning"] = "by theta_i, coefficient, harmonic up to its degree; at theta_i = 0 those of m = 0"
    height = dataset(group, "lobe_height", np.asarray(compact.lobe_height)[has_height], "1/sr", [])
    height.attrs["meaning"] = "by theta_i, lobe that is not none, coefficient that is not 0"
    status_dataset(group, compact.status, [dataset_of(group, "theta_i_deg")])


def _read_harmonics(group: h5py.Group) -> LobeHarmonics:
    """Read lobes and backgrounds."""
    theta_i, wavelength_nm = read(group, "theta_i_deg"), read(group, "wavelength_nm")
    fitted, count = read(group, "fitted_theta_i_deg"), len(read(group, "coefficient"))
    max_degree = int(attribute(group, "max_degree"))
    lobes = (len(fitted), NUM_LOBES)
    compact = LobeHarmonics(
        theta_i=np.deg2rad(theta_i),
        fitted_theta_i=np.deg2rad(fitted),
        basis=read_basis(group, attribute(group, "basis"), wavelength_nm, count),
        degree=read(group, "degree", (len(fitted), count)),
        background=np.zeros((len(fitted), count, len(even_orders(max_degree)))),
        lobe_kind=read(group, "lobe_kind", lobes),
        lobe_width=read(group, "lobe_width", lobes),
        lobe_peak_theta_o=np.deg2rad(read(group, "lobe_peak_theta_o_deg", lobes)),
        lobe_height=np.zeros((*lobes, count)),
        status=read(group, "status", (len(theta_i),)),
        max_degree=max_degree,
        interpolate_theta_i=bool(attribute(group, "interpolate_theta_i")),
    )
    has_harmonic, has_height = stored_harmonics(compact)
    compact.background[has_harmonic] = read(group, "background", (int(has_harmonic.sum()),))
    compact.lobe_height[has_height] = read(group, "lobe_height", (int(has_height.sum()),))
    return compact


def _write_paper(group: h5py.Group, compact: CompactBRDF) -> None:
    """Write background and lobes of every lane, and how each ended."""
    orders = harmonic_orders(compact.max_degree)
    names = coefficient_names(compact.basis)
    group.attrs["method"] = "paper"
    group.attrs["max_degree"] = compact.max_degree
    theta_i = dataset_of(group, "theta_i_deg")
    coefficient = write_basis(group, compact.basis, dataset_of(group, "wavelength_nm"))
    harmonic = scale(group, "harmonic", np.arange(len(orders)), "1")
    lane = [theta_i, coefficient]
    background = dataset(group, "background", compact.background, "1/sr", [*lane, harmonic])
    background.attrs["harmonic_order"] = np.array(orders)  # rows of (l, m)
    background.attrs["coefficient_order"] = ",".join(names)
    kind = dataset(group, "lobe_kind", np.asarray(compact.lobe_kind, np.int64), "1", lane)
    kind.attrs["names"] = ",".join(LOBE_KINDS)
    dataset(group, "lobe_height", compact.lobe_height, "1/sr", lane)
    width = dataset(group, "lobe_width", compact.lobe_width, "1", lane)
    width.attrs["meaning"] = "b of eqs. (14) to (16): rad^2 for angle_squared, else without unit"
    dataset(group, "critical_angle_deg", degrees(compact.critical_angle), "deg", lane)
    status_dataset(group, compact.status, lane)
    dataset(group, "lobe_peak_theta_o_deg", degrees(compact.lobe_peak_theta_o), "deg", [theta_i])


def _read_paper(group: h5py.Group) -> CompactBRDF:
    """Read background and lobes."""
    theta_i, wavelength_nm = read(group, "theta_i_deg"), read(group, "wavelength_nm")
    max_degree = int(attribute(group, "max_degree"))
    lanes = (len(theta_i), len(read(group, "coefficient")))
    return CompactBRDF(
        theta_i=np.deg2rad(theta_i),
        basis=read_basis(group, attribute(group, "basis"), wavelength_nm, lanes[1]),
        background=read(group, "background", (*lanes, (max_degree + 1) ** 2)),
        lobe_kind=read(group, "lobe_kind", lanes),
        lobe_height=read(group, "lobe_height", lanes),
        lobe_width=read(group, "lobe_width", lanes),
        critical_angle=np.deg2rad(read(group, "critical_angle_deg", lanes)),
        lobe_peak_theta_o=np.deg2rad(read(group, "lobe_peak_theta_o_deg", lanes[:1])),
        status=read(group, "status", lanes),
        max_degree=max_degree,
        interpolate_theta_i=bool(attribute(group, "interpolate_theta_i")),
    )


def write_basis(group: h5py.Group, basis: SpectralBasis, wavelength: h5py.Dataset) -> h5py.Dataset:
    """Write the axis of coefficients and, of basis "data", its vectors; the others follow from kind and count."""
    names = coefficient_names(basis)
    coefficient = scale(group, "coefficient", np.arange(len(names)), "1")
    coefficient.attrs["coefficient_order"] = ",".join(names)
    if basis.kind == "data":
        dataset(group, "spectral_vectors", basis.synthesis, "1", [coefficient, wavelength])
    return coefficient


def read_basis(group: h5py.Group, kind: str, wavelength_nm: np.ndarray, count: int) -> SpectralBasis:
    """Read a spectral basis by its kind and count; its vectors lie in the group if it is "data"."""
    if kind == "data":
        return vector_basis(wavelength_nm, read(group, "spectral_vectors", (count, len(wavelength_nm))))
    basis = make_basis(wavelength_nm, str(kind), count)
    if np.shape(basis.synthesis)[0] != count:
        raise ValueError(f"{len(wavelength_nm)} wavelengths cannot carry {count} coefficients of basis {kind}")
    return basis


def status_dataset(group: h5py.Group, status, axes: list[h5py.Dataset]) -> None:
    """Write a status per lane, with the name and the meaning of each number."""
    written = dataset(group, "status", np.asarray(status, np.int64), "1", axes)
    written.attrs["names"] = ",".join(s.name.lower() for s in Status)
    written.attrs["meaning"] = json.dumps({s.name.lower(): STATUS_TEXT[s] for s in Status})
