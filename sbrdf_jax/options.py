"""Frozen option records: one for each block of the config, with its defaults, units and ranges.

Angles here are in degrees, because these records are what a user writes; wavelengths are
in nm. "auto" is kept until `config.resolve` or the data decide. A constraint on one key
stands in its annotation (and so reaches the JSON schema); those between keys stand in
`config.py`. The text below a key is its description in the schema.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Lt, MinLen

Auto = Literal["auto"]
Text = Annotated[str, MinLen(1)]
Positive = Annotated[float, Gt(0)]
Share = Annotated[float, Gt(0), Lt(1)]
ThetaDeg = Annotated[float, Ge(0), Le(90)]
ThetaStepDeg = Annotated[float, Ge(0.1), Le(45)]
PhiStepDeg = Annotated[float, Ge(0.1), Le(90)]

# Read by pydantic where `config.py` validates these records and writes the JSON schema.
_STRICT: Any = {"extra": "forbid", "strict": True, "allow_inf_nan": False, "use_attribute_docstrings": True}
_EXACTLY_ONE: Any = _STRICT | {"json_schema_extra": {"minProperties": 1, "maxProperties": 1}}

VECTOR_KINDS = ("data", "log_data")  # spectral bases whose functions are found in a material
ADDING_METHODS = ("paper", "lobe_harmonics")  # forms that add lobes and harmonics up, which logarithms do not
DEFAULT_VECTORS = 12  # of basis "data": with fewer wavelengths fewer are meant


@dataclass(frozen=True)
class InputOptions:
    """What is measured, and what the numbers of the file mean."""

    __pydantic_config__ = _STRICT

    path: Text
    """A measurement, relative to the config file, or builtin:NAME for an embedded sample."""
    format: Literal["auto", "pbrt", "csv", "hdf5", "rgl-bsdf", "merl", "astm", "pab", "inplane", "nist", "alta"] = (
        "auto"
    )
    """File format; auto looks at the content."""
    quantity: Literal["auto", "brdf", "brdf_cos", "reflectance_factor", "relative"] = "auto"
    """What the values are; auto is refused where the format does not say."""
    scale: Positive = 1.0
    """Multiplies the values."""
    mirror_azimuth_deg: Auto | Literal[180, 0] = "auto"
    """Azimuth of the mirror direction in the file [deg]; auto: what the format says."""
    bilateral: Auto | bool = "auto"
    """true: fold |phi_o|; auto: true, but for method paper on data of both half-planes."""


@dataclass(frozen=True)
class GridOptions:
    """The uniform grid. A theta step divides 90, the phi step divides 180."""

    __pydantic_config__ = _STRICT

    theta_i_step_deg: ThetaStepDeg = 7.5
    """Step of the incident polar angle [deg]; divides 90."""
    theta_o_step_deg: ThetaStepDeg = 7.5
    """Step of the outgoing polar angle [deg]; divides 90."""
    phi_o_step_deg: PhiStepDeg = 7.5
    """Step of the outgoing azimuth [deg]; divides 180."""
    reciprocal: bool = False
    """Tie nodes by Helmholtz reciprocity."""


@dataclass(frozen=True)
class ResampleOptions:
    """Scattered samples to the grid."""

    __pydantic_config__ = _STRICT

    method: Literal["paper", "guided"] = "guided"
    """paper: equations 4 to 10 of Xu's paper as printed; guided: this project's own."""
    smoothness_weight: Auto | Literal["data"] | Annotated[float, Ge(0)] = "auto"
    """Weight of smoothness; for paper of the second-difference rows (auto: 1.0), for guided noise variance relative to
    the prior's (auto: data, chosen by leave-one-out)."""
    window: Literal["none", "product", "factor"] = "factor"
    """Cosine window of equation 17, used in evaluation only."""
    tolerance: Auto | Share = "auto"
    """Relative KKT residual to reach; auto: 1e-8 for paper, 1e-6 for guided."""


@dataclass(frozen=True)
class EncodeOptions:
    """Spectra to coefficients."""

    __pydantic_config__ = _STRICT

    basis: Literal["auto", "fourier", "cosine", "data", "log_data", "identity"] = "auto"
    """Functions of wavelength; data: vectors found in the material; log_data: in its logarithm, so that spectra are
    positive (lobe_tensor alone); auto: fourier for paper, else data."""
    coefficients: Auto | Annotated[int, Ge(1), Le(9999)] = "auto"
    """Real numbers per spectrum, odd for fourier; auto: 12 for data and log_data, of which represent takes as many as
    pay, else 19. Not used by identity."""


@dataclass(frozen=True)
class TargetOptions:
    """What the compact form has to meet: exactly one of these."""

    __pydantic_config__ = _EXACTLY_ONE

    ratio: Annotated[float, Ge(1)] | None = None
    """Compression ratio, counted against the paper's 13 x 49 directions per incident angle."""
    numbers: Annotated[int, Ge(1)] | None = None
    """Numbers stored per incident angle."""
    error: Share | None = None
    """Relative error (equation 18) at every incident angle; lobe_tensor: at most 5 times that between the nodes."""
    delta_e: Positive | None = None
    """Colour difference, CIE Delta E 2000."""


@dataclass(frozen=True)
class RepresentOptions:
    """Coefficients on the grid to background and lobe."""

    __pydantic_config__ = _STRICT

    method: Literal["auto", "paper", "lobe_harmonics", "lobe_tensor"] = "auto"
    """paper: equations 13 to 16 of Xu's paper; this project's own: lobe_tensor, the whole field at once, and
    lobe_harmonics, named lobes and harmonics at each incident angle; auto: the smaller of these two that meets
    the target, or of a size the more exact one; the plan says what was tried."""
    target: TargetOptions = TargetOptions(ratio=125.0)
    """What to meet; ignored by paper."""
    max_degree: Auto | Annotated[int, Ge(0), Le(32)] = "auto"
    """Highest degree L of the harmonics; auto: 4, used as it is, for paper; a limit, 8, otherwise."""
    lobe: Literal["angle_squared", "tan_squared", "tan", "best"] = "best"
    """Kind of the lobe for paper, equations 14 to 16; best: the kind with the smallest error."""
    storage: Literal["float64", "float32", "float16", "quantised"] = "float64"
    """How the numbers are stored; what rounding them adds is measured. quantised: as few bits as add a tenth of the
    form's own error at most; wider than asked for, with a warning, where a promised error would not be kept."""


@dataclass(frozen=True)
class ValidateOptions:
    """Predictions of samples that were held out."""

    __pydantic_config__ = _STRICT

    folds: Annotated[int, Ge(0)] = 0
    """Number of random folds, 2 or more; 0: off. Mirror twins and repeats stay together."""
    leave_one_theta_i_out: bool = False
    """Hold out one incident angle at a time."""
    fold_file: Text | None = None
    """CSV with columns row,fold, relative to the config file; row counts from 0 in file order. Wins over folds."""
    seed: Annotated[int, Ge(0), Le(2**32 - 1)] = 0
    """Seed of the random folds."""


@dataclass(frozen=True)
class ThetaRange:
    """Incident angles from min to max [deg]."""

    __pydantic_config__ = _STRICT

    min: ThetaDeg
    """Smallest incident angle [deg]."""
    max: ThetaDeg
    """Largest incident angle [deg]."""


@dataclass(frozen=True)
class WavelengthRange:
    """Wavelengths from min to max [nm]."""

    __pydantic_config__ = _STRICT

    min: Positive
    """Shortest wavelength [nm]."""
    max: Positive
    """Longest wavelength [nm]."""


@dataclass(frozen=True)
class OutgoingOptions:
    """Outgoing directions that a scene needs: exactly one of these."""

    __pydantic_config__ = _EXACTLY_ONE

    theta_o_max_deg: ThetaDeg | None = None
    """A cone about the normal, up to this polar angle [deg]."""
    directions: Text | None = None
    """CSV of directions, relative to the config file."""
    mask: Text | None = None
    """HDF5 mask of cells, relative to the config file."""


@dataclass(frozen=True)
class ColourOptions:
    """A colour in place of a spectrum."""

    __pydantic_config__ = _STRICT

    observer: Literal["cie_1931_2deg", "cie_1964_10deg"] = "cie_1931_2deg"
    """Standard observer."""
    illuminant: Text = "D65"
    """Name of a CIE illuminant."""


@dataclass(frozen=True)
class ErrorBudget:
    """Where to stop: exactly one of these; with represent.target, the stricter wins."""

    __pydantic_config__ = _EXACTLY_ONE

    error: Share | None = None
    """Relative error (equation 18)."""
    delta_e: Positive | None = None
    """Colour difference, CIE Delta E 2000."""


@dataclass(frozen=True)
class SceneOptions:
    """What a scene needs; what is null is needed in full."""

    __pydantic_config__ = _STRICT

    theta_i_deg: Annotated[tuple[ThetaDeg, ...], MinLen(1)] | ThetaRange | None = None
    """Incident angles [deg], a list or a range."""
    wavelength_nm: Annotated[tuple[Positive, ...], MinLen(1)] | WavelengthRange | None = None
    """Measured wavelengths [nm], a list or a range."""
    outgoing: OutgoingOptions | None = None
    """Outgoing directions."""
    colour: ColourOptions | None = None
    """Colour only, for an observer and an illuminant."""
    footprint: Text | None = None
    """A footprint file, relative to the config file."""
    error_budget: ErrorBudget | None = None
    """An error at which to stop."""


@dataclass(frozen=True)
class RuntimeOptions:
    """How it is computed."""

    __pydantic_config__ = _STRICT

    precision: Literal["float64", "float32"] = "float64"
    """float32: solvers begin in it; refinement, certificates and what is solved directly stay in float64."""
    resume_from: Text | None = None
    """A result whose parts may be reused, relative to the working directory."""


@dataclass(frozen=True)
class OutputOptions:
    """What is written."""

    __pydantic_config__ = _STRICT

    path: Text = "results/quickstart.h5"
    """The result, relative to the working directory."""
    report: bool = True
    """Write figures and index.html beside the result."""
    overwrite: bool = False
    """false: an existing result is an error."""


@dataclass(frozen=True)
class RunOptions:
    """A whole config: from one measurement to one result."""

    __pydantic_config__ = _STRICT

    input: InputOptions
    """What is measured."""
    grid: GridOptions = GridOptions()
    """The uniform grid."""
    resample: ResampleOptions = ResampleOptions()
    """Scattered samples to the grid."""
    encode: EncodeOptions = EncodeOptions()
    """Spectra to coefficients."""
    represent: RepresentOptions = RepresentOptions()
    """Coefficients on the grid to background and lobe."""
    validate: ValidateOptions = ValidateOptions()
    """Predictions of samples that were held out."""
    scene: SceneOptions | None = None
    """What a scene needs; null: everything."""
    runtime: RuntimeOptions = RuntimeOptions()
    """How it is computed."""
    output: OutputOptions = OutputOptions()
    """What is written."""
