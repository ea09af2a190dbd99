"""What a reader returns, and its conversion to samples: units, quantity, azimuth, the checks that all formats share."""

import dataclasses

import numpy as np

from sbrdf_jax.angles import GRAZING, MIRROR_AZIMUTH, wrap_azimuth
from sbrdf_jax.errors import UserError
from sbrdf_jax.options import InputOptions
from sbrdf_jax.records import RawSamples

QUANTITIES = ("brdf", "brdf_cos", "reflectance_factor", "relative")
MIN_SAMPLES = 4
MIN_COS = np.cos(GRAZING)  # floor of the cosine that brdf_cos is divided by
ANGLE_TOLERANCE = 1e-5  # rad; what rounding in a text file may add to a limit
MAX_NUMBERS = 2**28  # of one file: 2 GiB as float64
MAX_FILE_BYTES = 2**32


@dataclasses.dataclass(frozen=True)
class Table:
    """A file as its format understands it: one row a direction, nothing converted yet."""

    path: str
    source_format: str
    angle_unit: str  # "deg" or "rad"
    theta_i: np.ndarray  # [row]
    theta_o: np.ndarray  # [row]
    phi_o: np.ndarray  # [row] outgoing azimuth less that of incidence
    wavelength_nm: np.ndarray  # [wavelength] in any order
    value: np.ndarray  # [row, wavelength]
    line: np.ndarray | None  # [row] line of the file, where it has lines
    quantity: str | None  # None: the format does not say
    mirror_azimuth_deg: int | None  # None: the format does not say
    notes: tuple[str, ...] = ()

    def where(self, row: int) -> str:
        """Name a row as an error does: by line where there are lines."""
        return f"{self.path}: row {row}" if self.line is None else f"{self.path}:{self.line[row]}"


def to_samples(table: Table, options: InputOptions, sha256: str) -> RawSamples:
    """Convert a table to BRDF samples in the project's convention.

    Values become BRDF [1/sr] unless they are only proportional to it: "brdf_cos" is divided by
    cos(theta_o), floored at cos(85 degrees); "reflectance_factor" by pi. `options.scale` multiplies.

    Args:
        table: What a reader returned.
        options: What the config says of the file; it wins over what the file says, with a note.
        sha256: Of the file.

    Returns:
        All rows in file order, non-finite ones too: `cleaning` counts and drops those.

    Raises:
        UserError: too few samples, no positive value, impossible angles or wavelengths, or a quantity
            or azimuth convention that neither the file nor the config states.
    """
    notes = list(table.notes)
    if len(table.theta_i) < MIN_SAMPLES:
        raise UserError(f"{table.path}: found {len(table.theta_i)} samples, expected at least {MIN_SAMPLES}")
    theta_i, theta_o, phi_o = _angles(table)
    order = _wavelength_order(table)
    if np.any(order != np.arange(len(order))):
        notes.append("the wavelengths are not increasing in the file; they were sorted")

    quantity = _stated("quantity", table, table.quantity, options.quantity, notes)
    mirror = _stated("mirror_azimuth_deg", table, table.mirror_azimuth_deg, options.mirror_azimuth_deg, notes)
    factor = np.full(len(theta_o), options.scale)
    if quantity == "brdf_cos":
        factor = factor / np.maximum(np.cos(theta_o), MIN_COS)
    elif quantity == "reflectance_factor":
        factor = factor / np.pi
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is dropped as non-finite, with a count
        value = table.value[:, order] * factor[:, None]
    if not np.any(value > 0):
        raise UserError(f"{table.path}: no positive value among {value.size}, expected a measured BRDF")

    phi_o = wrap_azimuth(phi_o - np.radians(mirror) + MIRROR_AZIMUTH)
    phi_o = np.where(phi_o >= 2 * np.pi, 0.0, phi_o)  # -1e-17 wraps to 2 pi itself
    samples = RawSamples(
        theta_i=theta_i,
        theta_o=theta_o,
        phi_o=phi_o,
        wavelength_nm=np.asarray(table.wavelength_nm, float)[order],
        value=value,
        row=np.arange(len(theta_i)),
        quantity="relative" if quantity == "relative" else "brdf",
        source=table.path,
        source_format=table.source_format,
        source_sha256=sha256,
        notes=tuple(notes),
    )
    return dataclasses.replace(samples, notes=samples.notes + _azimuth_hint(samples))


def _stated(key: str, table: Table, of_file, of_config, notes: list[str]):
    """Return what the config says of `key`, else what the file says; refuse silence."""
    if of_config != "auto":
        if of_file is not None and of_config != of_file:
            notes.append(f"input.{key} is {of_config}; the file says {of_file}")
        return of_config
    if of_file is None:
        expected = ", ".join(QUANTITIES) if key == "quantity" else "180 or 0"
        raise UserError(
            f"{table.path}: a {table.source_format} file does not say its {key}: input.{key} is auto, "
            f"expected {expected}"
        )
    return of_file


def _angles(table: Table) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return theta_i, theta_o, phi_o [rad] after checking that they can be what the format says."""
    in_degrees = table.angle_unit == "deg"
    angles = [np.asarray(a, float) for a in (table.theta_i, table.theta_o, table.phi_o)]
    angles = [np.where(np.isfinite(a), a, np.nan) for a in angles]  # dropped by cleaning, with a count
    theta_i, theta_o, phi_o = (np.radians(a) for a in angles) if in_degrees else angles
    unit = "degrees" if in_degrees else "rad"
    quarter = 90 if in_degrees else np.pi / 2

    for name, angle, raw, top in (("theta_i", theta_i, angles[0], 1), ("theta_o", theta_o, angles[1], 2)):
        # theta_o may lie below the horizon: cleaning counts and drops those rows
        wrong = (angle < -ANGLE_TOLERANCE) | (angle > top * np.pi / 2 + ANGLE_TOLERANCE)
        if wrong.any():
            row = int(np.argmax(wrong))
            hint = "; the angles look like degrees" if not in_degrees and np.nanmax(raw) > np.pi else ""
            raise UserError(
                f"{table.where(row)}: {name}: found {raw[row]:g}, expected 0 to {top * quarter:.6g} {unit}{hint}"
            )
    finite_phi = np.abs(phi_o[np.isfinite(phi_o)])
    if finite_phi.size and finite_phi.max() > (20 * np.pi if in_degrees else 4 * np.pi) + ANGLE_TOLERANCE:
        row = int(np.nanargmax(np.abs(phi_o)))
        hint = "" if in_degrees else "; the angles look like degrees"
        raise UserError(f"{table.where(row)}: phi_o: found {angles[2][row]:g}, expected an azimuth in {unit}{hint}")
    if in_degrees:
        _refuse_radians(table, angles)
    return np.where(theta_i < 0, 0.0, theta_i), np.where(theta_o < 0, 0.0, theta_o), phi_o


def _refuse_radians(table: Table, angles: list[np.ndarray]) -> None:
    """Refuse a file in degrees whose angles would all fit a hemisphere in radians."""
    largest = [np.max(np.abs(a[np.isfinite(a)]), initial=0.0) for a in angles]
    fits = max(largest[:2]) <= 1.571 and largest[2] <= 6.284
    if fits and largest[1] > 0.1:
        raise UserError(
            f"{table.path}: theta_o and phi_o: found at most {largest[1]:g} and {largest[2]:g}, expected degrees; "
            "the angles look like radians"
        )


def _wavelength_order(table: Table) -> np.ndarray:
    """Return the order that sorts the wavelengths, after checking that they are distinct and in nm."""
    wavelength = np.asarray(table.wavelength_nm, float)
    if wavelength.size == 0:
        raise UserError(f"{table.path}: found no wavelength, expected at least one")
    bad = ~np.isfinite(wavelength) | (wavelength <= 0)
    if bad.any():
        raise UserError(f"{table.path}: wavelength: found {wavelength[bad][0]:g}, expected nm above 0")
    if wavelength.max() < 100 or wavelength.max() > 1e6:
        likely = "micrometres" if wavelength.max() >= 0.05 else "metres"
        hint = f"; they look like {likely}" if wavelength.max() < 100 else ""
        raise UserError(
            f"{table.path}: wavelengths: found {wavelength.min():g} to {wavelength.max():g}, expected nm{hint}"
        )
    order = np.argsort(wavelength, kind="stable")
    repeated = np.diff(wavelength[order]) == 0
    if repeated.any():
        twice = wavelength[order][:-1][repeated][0]
        raise UserError(f"{table.path}: wavelengths: found {twice:g} nm more than once, expected distinct wavelengths")
    return order


def _azimuth_hint(samples: RawSamples) -> tuple[str, ...]:
    """A note where oblique light comes back brighter towards the source than towards the mirror."""
    oblique = (samples.theta_i > np.radians(20)) & (np.abs(samples.theta_o - samples.theta_i) < np.radians(15))
    from_mirror = np.abs(samples.phi_o - MIRROR_AZIMUTH)
    spectrum_level = np.median(samples.value, axis=1)
    finite = np.isfinite(spectrum_level)
    mirror = spectrum_level[finite & oblique & (from_mirror < np.radians(20))]
    retro = spectrum_level[finite & oblique & (from_mirror > np.radians(160))]
    if min(len(mirror), len(retro)) >= 3 and np.mean(retro) > 3 * max(np.mean(mirror), 0):
        return ("values are larger towards the source than the mirror: is input.mirror_azimuth_deg right?",)
    return ()
