"""The records that stages hand to each other; the axis order is fixed here, once.

Axes everywhere: theta_i, theta_o, phi_o, then wavelength or coefficient. Angles are in
radians, wavelengths in nanometres, BRDF values in 1/sr. A record that holds numbers of
a fit is a JAX pytree: its arrays may be traced, its other fields are static.
"""

import dataclasses
import typing
from typing import Any

import jax
import numpy as np

from sbrdf_jax.options import VECTOR_KINDS
from sbrdf_jax.status import STATUS_TEXT as STATUS_TEXT
from sbrdf_jax.status import Status as Status


@typing.dataclass_transform(frozen_default=True)
def pytree(*, static: tuple[str, ...] = (), host: tuple[str, ...] = ()):
    """Class decorator: a frozen dataclass that JAX may trace, but for the fields `static`.

    The fields `host` change no value: JAX does not see them, compiles once whatever they are, and returns their
    defaults.
    """

    def register(cls):
        cls = dataclasses.dataclass(frozen=True)(cls)
        data = [f.name for f in dataclasses.fields(cls) if f.name not in static + host]
        return jax.tree_util.register_dataclass(cls, data_fields=data, meta_fields=list(static), drop_fields=host)

    return register


@dataclasses.dataclass(frozen=True)
class RawSamples:
    """A measurement as read: NumPy on the host, every row of the file, in file order.

    Angles follow the project's convention: the azimuth of incidence is 0 and the mirror
    direction lies at phi_o = pi. Values are what `quantity` says, after `input.scale`.
    """

    theta_i: np.ndarray  # [sample] rad
    theta_o: np.ndarray  # [sample] rad
    phi_o: np.ndarray  # [sample] rad, in [0, 2 pi)
    wavelength_nm: np.ndarray  # [wavelength], increasing
    value: np.ndarray  # [sample, wavelength] 1/sr
    row: np.ndarray  # [sample] int, from 0 in file order
    quantity: str  # "brdf", or "relative": proportional to it
    source: str  # file name or "builtin:..."
    source_format: str  # a name of `input.format`, or "builtin"
    source_sha256: str
    notes: tuple[str, ...] = ()  # what a reader should know of the file, a sentence each

    @property
    def num_samples(self) -> int:
        """Number of samples (rows)."""
        return len(self.theta_i)

    def take(self, keep: np.ndarray) -> "RawSamples":
        """Return the samples that a mask or index array keeps."""
        return dataclasses.replace(
            self,
            theta_i=self.theta_i[keep],
            theta_o=self.theta_o[keep],
            phi_o=self.phi_o[keep],
            value=self.value[keep],
            row=self.row[keep],
        )


@pytree(static=("method", "window", "bilateral", "interpolate_theta_i"))
class GriddedBRDF:
    """The resampled field on the uniform grid, and what proves it.

    phi_o runs from 0 to 2 pi inclusive. For method "paper" the nodes are the field: any
    direction follows from them by eq. (5), under `window`; for "guided" they are read off
    `field`. `interpolate_theta_i` is False where fewer than 3 incident angles were measured:
    the theta_i axis is then the measured ones. What `store.load_stage` does not read is None.
    """

    theta_i: Any  # [theta_i] rad
    theta_o: Any  # [theta_o] rad
    phi_o: Any  # [phi_o] rad
    wavelength_nm: Any  # [wavelength]
    brdf: Any  # [theta_i, theta_o, phi_o, wavelength] 1/sr
    extrapolated: Any  # [theta_i, theta_o, phi_o] 0 measured nearby, 1 interpolated, 2 beyond the data
    kkt_residual: Any  # [wavelength] relative, of the stored solution, in float64
    num_steps: Any  # [wavelength]
    status: Any  # [wavelength] Status
    method: str = "paper"
    window: str = "factor"
    bilateral: bool = False
    interpolate_theta_i: bool = True
    standard_error: Any = None  # [theta_i, theta_o, phi_o, wavelength] 1/sr, where the method has one
    residual_variance: Any = None  # [theta_i, theta_o, phi_o] the error's part that no wavelength changes
    field: Any = None  # what evaluates any direction, where that is more than the nodes
    needed: Any = None  # [theta_i, theta_o, phi_o] bool: nodes that were computed, the others are nan; None: all


@pytree(static=("kind", "uniform"))
class SpectralBasis:
    """The functions of wavelength whose coefficients stand for a spectrum.

    kind "fourier": eq. (11), coefficients a_0, a_1, b_1, a_2, b_2, ...; "cosine": the even
    extension, c_0, c_1, ...; "identity": the samples themselves; "data": orthonormal vectors
    found in a material, by importance; "log_data": the same of its logarithm, so that every
    spectrum is positive. The measured wavelengths are kept, because they are the
    domain and, but for series, the nodes.
    """

    wavelength_nm: Any  # [wavelength]
    analysis: Any  # [wavelength, coefficient]: spectrum @ analysis = coefficients
    synthesis: Any  # [coefficient, wavelength]: coefficients @ synthesis = spectrum
    kind: str = "fourier"
    uniform: bool = False  # wavelengths so nearly uniform that a series is encoded by an FFT

    @property
    def stores_vectors(self) -> bool:
        """True where the functions are found in a material, and do not follow from kind and count."""
        return self.kind in VECTOR_KINDS

    @property
    def is_logarithmic(self) -> bool:
        """True where the functions add up to the logarithm of a spectrum."""
        return self.kind == "log_data"


@pytree(static=("window", "interpolate_theta_i"))
class SpectralField:
    """Coefficients of the spectrum at every node of the grid; between nodes as the grid itself is evaluated."""

    theta_i: Any  # [theta_i] rad
    theta_o: Any  # [theta_o] rad
    phi_o: Any  # [phi_o] rad
    coefficient: Any  # [theta_i, theta_o, phi_o, coefficient] 1/sr
    basis: SpectralBasis
    window: str = "factor"
    interpolate_theta_i: bool = True


@pytree(static=("max_degree", "interpolate_theta_i"), host=("storage",))
class CompactBRDF:
    """Eq. (13) for every incident angle and coefficient: harmonics plus one lobe.

    lobe_kind counts from 0 = none in the order of `lobes.LOBE_KINDS`. Between incident
    angles the field is linear between the values at the neighbouring nodes.
    """

    theta_i: Any  # [theta_i] rad
    basis: SpectralBasis
    background: Any  # [theta_i, coefficient, harmonic] 1/sr
    lobe_kind: Any  # [theta_i, coefficient] int, 0 = none
    lobe_height: Any  # [theta_i, coefficient] 1/sr
    lobe_width: Any  # [theta_i, coefficient] rad^2 or dimensionless
    critical_angle: Any  # [theta_i, coefficient] rad, nan where there is no lobe
    lobe_peak_theta_o: Any  # [theta_i] rad, at phi_o = pi
    status: Any  # [theta_i, coefficient] Status
    max_degree: int = 4
    interpolate_theta_i: bool = True
    storage: str = "float64"  # how its numbers are written; they are rounded to it already


@pytree(static=("half_angle_floor", "interpolate_theta_i"), host=("storage",))
class LobeTensor:
    """A Tucker decomposition over theta_i, theta_o, a directional factor with all lobes, and the spectrum.

    The coefficients of the spectrum are exp(-log_scale) times the core, contracted with a factor
    of splines of theta_i, one of splines of theta_o and one of `direction_functions`; the spectrum
    is clipped at 0. Incident angles beyond `theta_i_range` take the factors of its ends.
    """

    theta_i: Any  # [theta_i] rad, nodes of the grid
    theta_i_range: Any  # [2] rad, first and last incident angle with data
    basis: SpectralBasis
    log_scale: Any  # [theta_i_function] logarithm of sr
    theta_i_factor: Any  # [theta_i_function, a]
    theta_o_factor: Any  # [theta_o_function, b]
    direction_factor: Any  # [direction_function, q]
    core: Any  # [a, b, q, coefficient]
    status: Any  # [theta_i] Status; SKIPPED where an incident angle has no data
    half_angle_floor: float = 1e-4
    interpolate_theta_i: bool = True
    storage: str = "float64"  # how its numbers are written; they are rounded to it already


@pytree(static=("max_degree", "interpolate_theta_i"), host=("storage",))
class LobeHarmonics:
    """Even spherical harmonics plus up to two lobes at every incident angle that has data.

    The coefficients of the spectrum are background + sum over lobes of height * shape; the spectrum
    is clipped at 0. `degree` is that of a coefficient's background, -1 where the whole coefficient
    is 0. Kinds are places in `representation.lobe_family.SHAPES`; a lobe keeps its kind from one
    incident angle to the next, or is absent (0). Harmonics are those with m >= 0, by l, then m.
    """

    theta_i: Any  # [theta_i] rad, nodes of the grid
    fitted_theta_i: Any  # [fitted] rad, those of them that have data
    basis: SpectralBasis
    degree: Any  # [fitted, coefficient] int
    background: Any  # [fitted, coefficient, harmonic] 1/sr
    lobe_kind: Any  # [fitted, lobe] int, 0 = none
    lobe_width: Any  # [fitted, lobe] rad^2 or without unit
    lobe_peak_theta_o: Any  # [fitted, lobe] rad, at phi_o = pi
    lobe_height: Any  # [fitted, lobe, coefficient] 1/sr
    status: Any  # [theta_i] Status; SKIPPED where an incident angle has no data
    max_degree: int = 8
    interpolate_theta_i: bool = True
    storage: str = "float64"  # how its numbers are written; they are rounded to it already
