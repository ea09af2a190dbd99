"""Where the compact form lies in the result file: all that its evaluation needs, in one group.

Its numbers are rounded to its storage already: they are written in fewer bytes, and nothing is lost here.
Readers give float64 and int64, whatever the storage.
"""

import json
from typing import NamedTuple

import h5py
import numpy as np

from sbrdf_jax.encoding import coefficient_names, make_basis, vector_basis
from sbrdf_jax.errors import UserError
from sbrdf_jax.harmonics import harmonic_orders
from sbrdf_jax.hdf5 import attribute, dataset, dataset_of, degrees, scale
from sbrdf_jax.hdf5 import read as read_as_written
from sbrdf_jax.lobes import LOBE_KINDS
from sbrdf_jax.metrics import stored_numbers
from sbrdf_jax.options import VECTOR_KINDS
from sbrdf_jax.records import STATUS_TEXT, CompactBRDF, LobeHarmonics, LobeTensor, SpectralBasis, Status
from sbrdf_jax.representation.joint_fit import NUM_LOBES
from sbrdf_jax.representation.lobe_family import SHAPES
from sbrdf_jax.representation.lobe_harmonics import stored_harmonics
from sbrdf_jax.representation.lobe_harmonics_value import even_orders
from sbrdf_jax.representation.storage import Written, first_axis, narrowest, read_back, written
from sbrdf_jax.representation.tensor_pruning import WORD, num_words

_FACTORS = {  # dataset: its axes
    "log_scale": ("theta_i_function",),
    "theta_i_factor": ("theta_i_function", "theta_i_rank"),
    "theta_o_factor": ("theta_o_function", "theta_o_rank"),
    "direction_factor": ("direction_function", "direction_rank"),
}
_CORE = ("theta_i_rank", "theta_o_rank", "direction_rank", "coefficient")


class _Writer(NamedTuple):
    """Writes datasets of a group as a storage has them."""

    group: h5py.Group
    storage: str

    @property
    def is_narrow(self) -> bool:
        """Whether a number takes less than 8 bytes."""
        return self.storage != "float64"

    def scale(self, name: str, value, units: str) -> h5py.Dataset:
        """Write an axis; exactly, whatever the storage."""
        value = narrowest(value) if self.is_narrow else value
        return scale(self.group, name, value, units, narrow=self.is_narrow)

    def exact(self, name: str, value, units: str, axes: list[h5py.Dataset]) -> h5py.Dataset:
        """Write what is not rounded: angles, integers, and widths and logarithms, which float32 holds."""
        value = narrowest(value) if self.is_narrow else value
        return dataset(self.group, name, value, units, axes, narrow=self.is_narrow)

    def values(
        self, name: str, value, units: str, axes: list[h5py.Dataset], rows=None, of: str = "theta_i"
    ) -> h5py.Dataset:
        """Write what is rounded; `rows`: the slice of each entry, its place along the first axis unless given.

        `of`: what the slices are then entries of.
        """
        value = np.asarray(value, np.float64)
        found = written(value, self.storage, first_axis(value.shape) if rows is None else rows)
        made = dataset(self.group, name, found.number, units, axes, narrow=self.is_narrow)
        if found.exponent is not None:
            made.attrs["exponent"], made.attrs["offset"] = narrowest(found.exponent), narrowest(found.offset)
            slices = "the first axis" if rows is None else of
            made.attrs["storage"] = f"value = (number - offset) * 2**exponent, one for each entry of {slices}"
        return made


def read(group: h5py.Group, name: str, shape: tuple[int, ...] | None = None, rows=None) -> np.ndarray:
    """Read a dataset of whatever storage as float64 or int64; `rows` as they were written."""
    number, attributes = read_as_written(group, name, shape), dataset_of(group, name).attrs
    if "exponent" in attributes:
        found = Written(number, np.asarray(attributes["exponent"]), int(attributes["offset"]))
        return read_back(found, first_axis(number.shape) if rows is None else rows)
    return number.astype(np.float64 if number.dtype.kind == "f" else np.int64)


def stored_bytes(compact: CompactBRDF | LobeHarmonics | LobeTensor) -> int:
    """Count the bytes on disk of all numbers that the `compact` group holds, compressed as they are.

    Axes, statuses, exponents, checksums and numbers in attributes count; names and texts, and what HDF5 needs to find
    them, do not.
    """
    count = 0
    with h5py.File("counted", "w", driver="core", backing_store=False) as file:
        group = file.create_group("compact")
        write_compact(group, compact)
        count += sum(group.attrs[name].nbytes for name in ("half_angle_floor", "max_degree") if name in group.attrs)
        for item in group.values():
            count += item.id.get_storage_size()
            if "exponent" in item.attrs:
                count += item.attrs["exponent"].nbytes + item.attrs["offset"].nbytes
    return count


def write_compact(group: h5py.Group, compact: CompactBRDF | LobeHarmonics | LobeTensor) -> None:
    """Write all that evaluation of the compact stage needs, and how each lane ended."""
    group.attrs["stored_numbers"] = stored_numbers(compact)
    group.attrs["storage"] = compact.storage
    group.attrs["basis"] = compact.basis.kind
    group.attrs["interpolate_theta_i"] = bool(compact.interpolate_theta_i)
    writer = _Writer(group, compact.storage)
    writer.scale("theta_i_deg", degrees(compact.theta_i), "deg")
    writer.scale("wavelength_nm", compact.basis.wavelength_nm, "nm")
    if isinstance(compact, LobeTensor):
        _write_tensor(writer, compact)
    elif isinstance(compact, LobeHarmonics):
        _write_harmonics(writer, compact)
    else:
        _write_paper(writer, compact)


def read_compact(group: h5py.Group) -> CompactBRDF | LobeHarmonics | LobeTensor:
    """Read the compact form from its group alone."""
    method = str(attribute(group, "method"))
    readers = {"paper": _read_paper, "lobe_harmonics": _read_harmonics, "lobe_tensor": _read_tensor}
    if method not in readers:
        found = f"found {method!r}, expected one of {', '.join(readers)}"
        raise UserError(f"{group.file.filename}: compact: method: {found}")
    return readers[method](group)


def _write_tensor(writer: _Writer, tensor: LobeTensor) -> None:
    """Write scales, factors and core."""
    group = writer.group
    group.attrs["method"] = "lobe_tensor"
    group.attrs["half_angle_floor"] = tensor.half_angle_floor
    group.attrs["direction_functions"] = "splines of the half angle, azimuth, Fresnel"
    axes = {"coefficient": write_basis(group, tensor.basis, dataset_of(group, "wavelength_nm"), tensor.storage)}
    for name, names in _FACTORS.items():
        value = np.asarray(getattr(tensor, name))
        for axis, size in zip(names, value.shape, strict=True):
            axes[axis] = axes.get(axis) or writer.scale(axis, np.arange(size), "1")
        write = writer.exact if name == "log_scale" else writer.values
        write(name, value, "1", [axes[axis] for axis in names])
    core = np.asarray(tensor.core, np.float64)
    is_stored = core != 0
    stored = writer.values("core", core[is_stored], "1", [], np.nonzero(is_stored)[0], of=_CORE[0])
    stored.attrs["meaning"] = f"cells by {', '.join(_CORE)}, those that are 0 left out"
    words = dataset(group, "core_stored", _bit_words(is_stored), "1", [], narrow=writer.is_narrow)
    words.attrs["meaning"] = f"a bit for each cell, lowest of a word first: 1 if it is stored; by {', '.join(_CORE)}"
    group["log_scale"].attrs["meaning"] = "coefficients [1/sr] are exp(-log_scale) times what the factors make"
    ends = writer.scale("theta_i_range_deg", degrees(tensor.theta_i_range), "deg")
    ends.attrs["meaning"] = "splines of theta_i span this range; beyond it the factors are those of its ends"
    status_dataset(group, tensor.status, [dataset_of(group, "theta_i_deg")], narrow=writer.is_narrow)


def _read_tensor(group: h5py.Group) -> LobeTensor:
    """Read scales, factors and core."""
    theta_i, wavelength_nm = read(group, "theta_i_deg"), read(group, "wavelength_nm")
    sizes = {axis: len(read(group, axis)) for names in (*_FACTORS.values(), _CORE) for axis in names}
    factors = {name: read(group, name, tuple(sizes[axis] for axis in names)) for name, names in _FACTORS.items()}
    if "direction_functions" not in group.attrs:  # results of earlier versions lack the last function
        factors["direction_factor"] = np.pad(factors["direction_factor"], ((0, 1), (0, 0)))
    shape = tuple(sizes[axis] for axis in _CORE)
    if "core_stored" in group:
        words = read_as_written(group, "core_stored", (num_words(int(np.prod(shape))),))
        is_stored = _bits(words, shape)
        core = np.zeros(shape)
        core[is_stored] = read(group, "core", (int(is_stored.sum()),), rows=np.nonzero(is_stored)[0])
    else:  # results of earlier versions hold all cells
        core = read(group, "core", shape)
    return LobeTensor(
        theta_i=np.deg2rad(theta_i),
        theta_i_range=np.deg2rad(read(group, "theta_i_range_deg", (2,))),
        basis=read_basis(group, attribute(group, "basis"), wavelength_nm, sizes["coefficient"]),
        status=read(group, "status", (len(theta_i),)),
        half_angle_floor=float(attribute(group, "half_angle_floor")),
        interpolate_theta_i=bool(attribute(group, "interpolate_theta_i")),
        storage=_storage_of(group),
        core=core,
        **factors,
    )


def _bit_words(mask: np.ndarray) -> np.ndarray:
    """Return a bit for each entry of a mask in words of 64, the lowest of a word first."""
    padded = np.zeros(num_words(mask.size) * WORD, bool)
    padded[: mask.size] = mask.ravel()
    return np.packbits(padded, bitorder="little").view("<u8")


def _bits(words: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the mask that `_bit_words` was given."""
    bits = np.unpackbits(words.astype("<u8").view(np.uint8), bitorder="little")
    return bits[: int(np.prod(shape))].reshape(shape).astype(bool)


def _write_harmonics(writer: _Writer, compact: LobeHarmonics) -> None:
    """Write lobes and backgrounds; heights and harmonics one after another, those that are 0 left out."""
    group = writer.group
    group.attrs["method"] = "lobe_harmonics"
    group.attrs["max_degree"] = compact.max_degree
    coefficient = write_basis(group, compact.basis, dataset_of(group, "wavelength_nm"), compact.storage)
    fitted = writer.scale("fitted_theta_i_deg", degrees(compact.fitted_theta_i), "deg")
    lobe = [fitted, writer.scale("lobe", np.arange(NUM_LOBES), "1")]
    degree = writer.exact("degree", np.asarray(compact.degree, np.int64), "1", [fitted, coefficient])
    degree.attrs["meaning"] = "of the background of a coefficient; -1: the coefficient is 0, lobes included"
    kind = writer.exact("lobe_kind", np.asarray(compact.lobe_kind, np.int64), "1", lobe)
    kind.attrs["names"] = ",".join(SHAPES)
    width = writer.exact("lobe_width", compact.lobe_width, "1", lobe)
    width.attrs["meaning"] = "rad^2 for angle_squared, else without unit"
    writer.exact("lobe_peak_theta_o_deg", degrees(compact.lobe_peak_theta_o), "deg", lobe)
    has_harmonic, has_height = stored_harmonics(compact)
    of_background, of_height = np.nonzero(has_harmonic)[0], np.nonzero(has_height)[0]
    background = writer.values("background", np.asarray(compact.background)[has_harmonic], "1/sr", [], of_background)
    background.attrs["harmonic_order"] = np.array(even_orders(compact.max_degree))  # rows of (l, m)
    background.attrs["meaning"] = "by theta_i, coefficient, harmonic up to its degree; at theta_i = 0 those of m = 0"
    height = writer.values("lobe_height", np.asarray(compact.lobe_height)[has_height], "1/sr", [], of_height)
    height.attrs["meaning"] = "by theta_i, lobe that is not none, coefficient that is not 0"
    status_dataset(group, compact.status, [dataset_of(group, "theta_i_deg")], narrow=writer.is_narrow)


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
        storage=_storage_of(group),
    )
    has_harmonic, has_height = stored_harmonics(compact)
    for name, mask in (("background", has_harmonic), ("lobe_height", has_height)):
        getattr(compact, name)[mask] = read(group, name, (int(mask.sum()),), rows=np.nonzero(mask)[0])
    return compact


def _write_paper(writer: _Writer, compact: CompactBRDF) -> None:
    """Write background and lobes of every lane, and how each ended."""
    group = writer.group
    orders = harmonic_orders(compact.max_degree)
    names = coefficient_names(compact.basis)
    group.attrs["method"] = "paper"
    group.attrs["max_degree"] = compact.max_degree
    theta_i = dataset_of(group, "theta_i_deg")
    coefficient = write_basis(group, compact.basis, dataset_of(group, "wavelength_nm"), compact.storage)
    harmonic = writer.scale("harmonic", np.arange(len(orders)), "1")
    lane = [theta_i, coefficient]
    background = writer.values("background", compact.background, "1/sr", [*lane, harmonic])
    background.attrs["harmonic_order"] = np.array(orders)  # rows of (l, m)
    background.attrs["coefficient_order"] = ",".join(names)
    kind = writer.exact("lobe_kind", np.asarray(compact.lobe_kind, np.int64), "1", lane)
    kind.attrs["names"] = ",".join(LOBE_KINDS)
    writer.values("lobe_height", compact.lobe_height, "1/sr", lane)
    width = writer.exact("lobe_width", compact.lobe_width, "1", lane)
    width.attrs["meaning"] = "b of eqs. (14) to (16): rad^2 for angle_squared, else without unit"
    writer.exact("critical_angle_deg", degrees(compact.critical_angle), "deg", lane)
    status_dataset(group, compact.status, lane, narrow=writer.is_narrow)
    writer.exact("lobe_peak_theta_o_deg", degrees(compact.lobe_peak_theta_o), "deg", [theta_i])


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
        storage=_storage_of(group),
    )


def _storage_of(group: h5py.Group) -> str:
    """Return how the numbers of a group are stored; results made before there was a choice do not say."""
    return str(attribute(group, "storage")) if "storage" in group.attrs else "float64"


def write_basis(
    group: h5py.Group, basis: SpectralBasis, wavelength: h5py.Dataset, storage: str = "float64"
) -> h5py.Dataset:
    """Write the axis of coefficients and the vectors of a basis that stores them; others follow from kind and count."""
    names, writer = coefficient_names(basis), _Writer(group, storage)
    coefficient = writer.scale("coefficient", np.arange(len(names)), "1")
    coefficient.attrs["coefficient_order"] = ",".join(names)
    if basis.stores_vectors:
        writer.values("spectral_vectors", basis.synthesis, "1", [coefficient, wavelength])
    return coefficient


def read_basis(group: h5py.Group, kind: str, wavelength_nm: np.ndarray, count: int) -> SpectralBasis:
    """Read a spectral basis by its kind and count; vectors found in a material lie in the group."""
    if kind in VECTOR_KINDS:
        return vector_basis(wavelength_nm, read(group, "spectral_vectors", (count, len(wavelength_nm))), kind)
    basis = make_basis(wavelength_nm, str(kind), count)
    if np.shape(basis.synthesis)[0] != count:
        raise ValueError(f"{len(wavelength_nm)} wavelengths cannot carry {count} coefficients of basis {kind}")
    return basis


def status_dataset(group: h5py.Group, status, axes: list[h5py.Dataset], *, narrow: bool = False) -> None:
    """Write a status per lane, with the name and the meaning of each number; `narrow` as for `dataset`."""
    value = np.asarray(status, np.int64)
    made = dataset(group, "status", narrowest(value) if narrow else value, "1", axes, narrow=narrow)
    made.attrs["names"] = ",".join(s.name.lower() for s in Status)
    made.attrs["meaning"] = json.dumps({s.name.lower(): STATUS_TEXT[s] for s in Status})
