"""Measurements that try to break the pipeline, each with what must come out; shared by tests and benchmarks.

Most have the same number of samples and wavelengths, so that they share compiled code. `truth` is the field that
the samples were taken from, where there is one; a bound of the error stands beside it, by method, where it is known
how far a sound answer may be from the truth.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np

from sbrdf_jax.options import GridOptions
from sbrdf_jax.records import RawSamples, Status

Method = Literal["paper", "guided"]
METHODS: tuple[Method, ...] = ("paper", "guided")
GRID = GridOptions(theta_i_step_deg=15.0, theta_o_step_deg=15.0, phi_o_step_deg=30.0)
INCIDENCES_DEG = (0.0, 20.0, 40.0, 60.0)
NUM_DIRECTIONS = 50  # for each of them
WAVELENGTH_NM = np.array([450.0, 550.0, 650.0])
HIGHEST_DEG = 75.0  # of theta_o, but where a problem says otherwise
NOISE = 1e-3  # relative

Truth = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # angles [rad] -> [direction, wavelength]


@dataclasses.dataclass(frozen=True)
class HostileProblem:
    """A measurement, and what must come out of it."""

    name: str
    samples: RawSamples
    truth: Truth | None = None
    max_error: Mapping[str, float] = dataclasses.field(default_factory=dict)  # of eq. (18), by method
    max_median: Mapping[str, float] = dataclasses.field(default_factory=dict)  # of relative errors, by method
    status: tuple[Status, ...] | None = None  # of each wavelength; None: all are OK
    refused: str | None = None  # what the one line says
    smoothness_weight: Mapping[str, float] = dataclasses.field(default_factory=dict)  # by method, where not the default
    may_give_up: bool = False  # so nearly singular that MAX_STEPS is an honest end
    own_shape: tuple[str, ...] = ()  # methods that compile code for this problem alone

    def expected_status(self) -> np.ndarray:
        """[wavelength] the status that every wavelength must have."""
        lanes = len(self.samples.wavelength_nm)
        return np.full(lanes, Status.OK) if self.status is None else np.array(self.status)


def smooth_field(theta_i, theta_o, phi_o) -> np.ndarray:
    """A diffuse base with a wide lobe about the mirror direction [direction, wavelength], 1/sr; even in azimuth."""
    return _lobed(theta_i, theta_o, phi_o, width=0.35)


def spiky_field(theta_i, theta_o, phi_o) -> np.ndarray:
    """The base with a lobe of half a degree, a thirtieth of a node's step."""
    return _lobed(theta_i, theta_o, phi_o, width=np.deg2rad(0.5), height=100.0)


def _lobed(theta_i, theta_o, phi_o, *, width: float, height: float = 0.4) -> np.ndarray:
    cosine = np.cos(theta_i) * np.cos(theta_o) - np.sin(theta_i) * np.sin(theta_o) * np.cos(phi_o)
    lobe = height * np.exp((cosine - 1) / width**2)
    return np.array([0.10, 0.15, 0.25]) + lobe[:, None] * np.array([1.0, 0.9, 0.8])


def directions(
    rng: np.random.Generator, incidences_deg=INCIDENCES_DEG, *, highest_deg=HIGHEST_DEG, count=NUM_DIRECTIONS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random directions, `count` for each incident angle, uniform in solid angle [rad]."""
    theta_i = np.repeat(np.deg2rad(incidences_deg), count)
    cosine = rng.uniform(np.cos(np.deg2rad(highest_deg)), 1.0, theta_i.size)
    return theta_i, np.arccos(cosine), rng.uniform(0.0, 2 * np.pi, theta_i.size)


def as_samples(angles, value, wavelength_nm=WAVELENGTH_NM) -> RawSamples:
    """Put angles [rad] and values into a record."""
    theta_i, theta_o, phi_o = angles
    wavelength_nm, row = np.asarray(wavelength_nm, float), np.arange(len(theta_i))
    return RawSamples(theta_i, theta_o, phi_o, wavelength_nm, value, row, "brdf", "hostile", "builtin", "0" * 64)


def measured(rng: np.random.Generator, angles=None, truth: Truth = smooth_field) -> RawSamples:
    """Values of a field at directions, with a little noise."""
    angles = directions(rng) if angles is None else angles
    exact = truth(*angles)
    return as_samples(angles, exact * (1 + NOISE * rng.standard_normal(exact.shape)))


def with_values(samples: RawSamples, value: np.ndarray, wavelength_nm=None) -> RawSamples:
    """Replace the values, and the wavelengths where they are given."""
    wavelength_nm = samples.wavelength_nm if wavelength_nm is None else np.asarray(wavelength_nm, float)
    return dataclasses.replace(samples, value=value, wavelength_nm=wavelength_nm)


def hostile_problems(*, many_wavelengths: int = 2000) -> list[HostileProblem]:
    """Return the table.

    Args:
        many_wavelengths: How many the longest spectrum has.
    """
    rng = np.random.default_rng(20240611)
    usual = measured(rng)
    sound = {"paper": 0.35, "guided": 0.05}
    problems = [HostileProblem("usual", usual, smooth_field, sound)]
    for power in (-12, -6, 6, 12):
        factor = 10.0**power
        scaled = with_values(usual, usual.value * factor)
        problems.append(HostileProblem(f"values times 1e{power}", scaled, _times(smooth_field, factor), sound))
    wide = np.array([1e-4, 1.0, 1e4])
    far = {1e-28: "values near 1e-29", 1e29: "values near 1e29"}
    return [
        *problems,
        *(
            HostileProblem(name, with_values(usual, usual.value * factor), _times(smooth_field, factor), sound)
            for factor, name in far.items()
        ),
        HostileProblem(
            "range 1e8 in a spectrum", with_values(usual, usual.value * wide), _times(smooth_field, wide), sound
        ),
        *_repeats(rng, usual),
        *_geometries(rng),
        *_odd_values(rng, usual),
        *_spectra(usual, sound, many_wavelengths),
        *_refused(usual),
    ]


def _times(truth: Truth, factor) -> Truth:
    return lambda *angles: truth(*angles) * factor


def _repeats(rng, usual) -> list[HostileProblem]:
    """Duplicates, near-duplicates, and next to no smoothing."""
    few = usual.take(np.repeat(np.arange(0, usual.num_samples, 4), 4))
    noisy = with_values(few, few.value * (1 + 1e-2 * rng.standard_normal(few.value.shape)))
    near = dataclasses.replace(noisy, theta_o=np.abs(few.theta_o + 1e-9 * rng.standard_normal(few.num_samples)))
    loose = {"paper": 0.4, "guided": 0.5}  # 50 directions are left
    singular: dict[str, Any] = {"smoothness_weight": {"paper": 1e-6, "guided": 1e-9}, "may_give_up": True}
    guided = ("guided",)  # its centres are the distinct directions
    return [
        HostileProblem("every sample four times", few, smooth_field, loose, own_shape=guided),
        HostileProblem("near-duplicates that disagree by 1 %", near, smooth_field, loose, own_shape=guided),
        HostileProblem("next to no smoothing", usual, **singular, own_shape=guided),  # its steps are of another kind
        HostileProblem("next to no smoothing, duplicates", near, **singular, own_shape=guided),
    ]


def _geometries(rng) -> list[HostileProblem]:
    """Where the samples are, and where none is."""
    angles = directions(rng)
    half_space = (*angles[:2], angles[2] % (np.pi / 2))
    in_plane = (*angles[:2], np.where(angles[2] > np.pi, np.pi, 0.0))
    at_pole = (angles[0], np.zeros_like(angles[1]), angles[2])
    grazing = directions(rng, (0.0, 45.0, 80.0, 89.99), highest_deg=89.99)
    grazing[1][::5] = np.deg2rad(89.99)
    single = directions(rng, (30.0,), count=len(INCIDENCES_DEG) * NUM_DIRECTIONS)
    few = directions(rng, (0.0, 20.0, 40.0, 60.0), count=1)
    return [
        HostileProblem("nothing measured near the mirror", measured(rng, half_space)),
        HostileProblem("plane of incidence only", measured(rng, in_plane)),
        HostileProblem("all samples at the pole", measured(rng, at_pole), own_shape=("guided",)),
        HostileProblem("grazing, 89.99 degrees", measured(rng, grazing)),
        HostileProblem("one incident angle", measured(rng, single), own_shape=METHODS),
        HostileProblem("four samples, over 100 unknowns for each", measured(rng, few), own_shape=("guided",)),
    ]


def _odd_values(rng, usual) -> list[HostileProblem]:
    """What a detector, or a strange surface, may give."""
    constant = lambda *angles: np.full((len(angles[0]), len(WAVELENGTH_NM)), 0.2)  # noqa: E731
    zero_lane, hot, dropped = usual.value.copy(), usual.value.copy(), usual.value.copy()
    zero_lane[:, 1] = 0.0
    hot[17] *= 1e4
    dropped[rng.choice(len(dropped), len(dropped) // 50, replace=False)] *= 1e-3
    one = np.zeros_like(usual.value)
    one[17] = 1.0
    noisy = usual.value + 0.2 * rng.standard_normal(usual.value.shape)
    loose = {"paper": 0.6, "guided": 0.6}
    exact = as_samples((usual.theta_i, usual.theta_o, usual.phi_o), constant(usual.theta_i))
    return [
        HostileProblem("constant", exact, constant, {"paper": 0.3, "guided": 1e-2}),
        HostileProblem("one wavelength without light", with_values(usual, zero_lane), own_shape=("guided",)),
        HostileProblem("one sample is hot by 1e4", with_values(usual, hot), smooth_field, max_median={"guided": 0.1}),
        HostileProblem("a single sample is not zero", with_values(usual, one)),
        HostileProblem("spikes of a thirtieth of a node", measured(rng, truth=spiky_field), spiky_field),
        HostileProblem("noise as large as the signal", with_values(usual, noisy), smooth_field, loose),
        HostileProblem("drop-outs", with_values(usual, dropped), smooth_field, {"paper": 0.4, "guided": 0.25}),
        *(_bad_lane(usual, number) for number in (np.nan, np.inf)),
    ]


def _bad_lane(usual: RawSamples, number: float) -> HostileProblem:
    value = usual.value.copy()
    value[:, 1] = number
    status = (Status.OK, Status.NONFINITE, Status.OK)
    return HostileProblem(f"one wavelength {number}", with_values(usual, value), status=status, own_shape=("guided",))


def _spectra(usual, sound, many: int) -> list[HostileProblem]:
    """Wavelengths, few, many and uneven, of the same field."""

    def stretched(wavelength_nm):
        at = np.linspace(0, 2, len(wavelength_nm))
        weights = np.stack([np.interp(at, [0, 1, 2], unit) for unit in np.eye(3)])
        return with_values(usual, usual.value @ weights, wavelength_nm), lambda *angles: smooth_field(*angles) @ weights

    uneven = [400.0, 400.001, 401.0, 402.0, 900.0, 2500.0]
    long = np.linspace(350.0, 2500.0, many)
    return [
        HostileProblem("wavelengths a picometre apart", *stretched([400.0, 400.001, 1400.0]), sound),
        HostileProblem("6 wavelengths, uneven", *stretched(uneven), sound, own_shape=METHODS),
        HostileProblem("2 wavelengths", *stretched([500.0, 600.0]), sound, own_shape=METHODS),
        HostileProblem(f"{many} wavelengths", *stretched(long), sound, own_shape=METHODS),
    ]


def _refused(usual) -> list[HostileProblem]:
    return [
        HostileProblem("one sample", usual.take(np.array([3])), refused="1 usable samples of 1, expected at least 4"),
        HostileProblem("all zero", with_values(usual, 0 * usual.value), refused="no positive value"),
        HostileProblem("denormal values", with_values(usual, usual.value * 1e-310), refused="but below 1e-30"),
        HostileProblem("all nan", with_values(usual, np.nan * usual.value), refused="no positive value"),
        HostileProblem("all negative", with_values(usual, -usual.value), refused="no positive value"),
    ]
