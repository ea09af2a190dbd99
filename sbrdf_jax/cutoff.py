"""Spectrum of scattered samples over the hemisphere against the grid's cut-off (Xu, section 3, figures 2 to 5).

The paper chooses the step T so that the signal lies below the cut-off pi / T and the noise above. Its figures take
the Fourier transform of a curve; goniometer samples are scattered, so here the modes are the spherical harmonics
that are even about the horizon: they are complete on the hemisphere, have no jump at its edge, and their degree is a
frequency in any direction, in oscillations per full turn of a great circle, so that a step T cuts off at degree pi / T.
Only the harmonics even in phi_o are taken, because an isotropic sample is bilateral; what is odd counts as noise.

The modes are orthogonalised **on the samples**, degree after degree. The power of a degree is what it explains of the
samples beyond all lower degrees: a band-limited signal shows exactly nothing above its band however irregular the
sampling is (an ordinary periodogram leaks there), the powers add up to the samples' energy, and white noise is flat.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from sbrdf_jax.coverage import cluster_incidences

MAX_SAMPLES = 2000  # per incident angle; beyond, a regular subset carries the same picture
SHARE_OF_SAMPLES = 0.8  # modes never use up more of the samples than this: the rest would be explained by counting
ALIAS_SHARE = 0.05  # of the root mean square: beyond the paper's promise of 4.5 %
ALIAS_STEPS = 1.5  # a lobe whose half width is fewer steps has power beyond the cut-off
MAX_DEGREE = 60  # 961 modes: what a grid finer than 3 degrees cuts off is beyond what this can show
MIN_SAMPLES = 12


@dataclasses.dataclass(frozen=True)
class CutoffSpectrum:
    """What one incident angle's samples say about the step of the grid; host record."""

    theta_i: float  # rad
    num_samples: int
    degree: np.ndarray  # [degree] oscillations per full turn, 0, 1, ...
    num_modes: np.ndarray  # [degree] modes that the samples can tell apart
    sample_power: np.ndarray  # [degree] mean square per mode over wavelengths, over the samples' mean square
    residual_power: np.ndarray | None  # likewise of the residual of the fit, over the samples' mean square
    cutoff: float  # pi / largest step
    share_above: float  # root of the share of the samples' energy above the cut-off (or above `degree[-1]`)
    half_width: float  # rad, of the lobe at half its height above the background; nan where there is no lobe
    steps_per_half_width: float  # half_width over the largest step of the grid there; nan where there is no lobe

    @property
    def is_resolved(self) -> bool:
        """Whether the samples are dense enough to show anything up to the cut-off."""
        return bool(self.degree[-1] >= self.cutoff)

    @property
    def is_narrow(self) -> bool:
        """Whether the lobe is narrower than the step can carry."""
        return bool(self.steps_per_half_width < ALIAS_STEPS)

    @property
    def is_aliased(self) -> bool:
        """Whether the step loses a notable part of the samples: signal that it aliases, or noise as large."""
        return self.share_above > ALIAS_SHARE


def cutoff_warnings(spectra: Sequence[CutoffSpectrum]) -> list[str]:
    """Say in a sentence or two where the step of the grid aliases the lobe; nothing where it does not."""
    narrow = [spectrum for spectrum in spectra if spectrum.is_narrow]
    aliased = [spectrum for spectrum in spectra if spectrum.is_aliased]
    warnings = []
    if narrow:
        worst = min(narrow, key=lambda spectrum: spectrum.steps_per_half_width)
        warnings.append(
            f"the grid is coarse for the lobe at theta_i {_angles(narrow)} deg: at {_angles([worst])} deg the half "
            f"width is {np.degrees(worst.half_width):.2g} deg, {worst.steps_per_half_width:.2f} steps where "
            f"{ALIAS_STEPS:g} are needed"
        )
    if aliased:
        worst = max(aliased, key=lambda spectrum: spectrum.share_above)
        edge = "the cut-off" if worst.is_resolved else "what the samples resolve"
        warnings.append(
            f"the step aliases the signal, or the noise is as large, at theta_i {_angles(aliased)} deg: at "
            f"{_angles([worst])} deg {100 * worst.share_above:.2g} % of the samples' root mean square lies above {edge}"
        )
    return warnings


def _angles(spectra: Sequence[CutoffSpectrum]) -> str:
    return ", ".join(f"{np.degrees(spectrum.theta_i):.3g}" for spectrum in spectra)


def hemisphere_modes(theta: np.ndarray, phi: np.ndarray) -> Iterator[np.ndarray]:
    """Yield for degree 0, 1, 2, ... the real harmonics that are even about the horizon (l + m even) and in phi.

    Args:
        theta: Polar angles [rad], shape [sample].
        phi: Azimuths [rad], shape [sample].

    Yields:
        Array [sample, mode] of one degree, by the three-term recurrence in l of the normalised Legendre functions
        (stable at any degree; see e.g. Holmes and Featherstone 2002); amplitudes up to a constant factor.
    """
    cosine, sine = np.cos(theta), np.sin(theta)
    last: list[np.ndarray] = []  # of degree l - 1, by order m
    before: list[np.ndarray] = []  # of degree l - 2
    waves: list[np.ndarray] = []  # cos(m phi), by order m
    degree = 0
    while True:
        now = []
        for order in range(degree + 1):
            if degree == 0:
                now.append(np.full_like(cosine, np.sqrt(0.5)))
            elif order == degree:
                now.append(np.sqrt((2 * degree + 1) / (2 * degree)) * sine * last[-1])
            elif order == degree - 1:
                now.append(np.sqrt(2 * degree + 1) * cosine * last[-1])
            else:
                scale = np.sqrt((4 * degree**2 - 1) / (degree**2 - order**2))
                back = np.sqrt(((degree - 1) ** 2 - order**2) / (4 * (degree - 1) ** 2 - 1))
                now.append(scale * (cosine * last[order] - back * before[order]))
        waves.append(np.cos(degree * phi))
        yield np.stack([now[order] * waves[order] for order in range(degree % 2, degree + 1, 2)]).T
        last, before = now, last
        degree += 1


def sequential_bases(theta: np.ndarray, phi: np.ndarray, *, max_degree: int) -> list[np.ndarray]:
    """Orthonormal columns on the samples, degree after degree, each orthogonal to all lower degrees.

    Stops at `max_degree`, or where the columns would use more than `SHARE_OF_SAMPLES` of the samples' freedom. Modes
    that the samples cannot tell from lower ones (in-plane data, rings) are dropped by their singular values.

    Returns:
        One array [sample, mode] per degree; a degree may have no column.
    """
    allowed = SHARE_OF_SAMPLES * len(theta)
    bases: list[np.ndarray] = []
    every, count = np.empty((len(theta), sum(degree // 2 + 1 for degree in range(max_degree + 1))), order="F"), 0
    for degree, modes in enumerate(hemisphere_modes(theta, phi)):
        if degree > max_degree:
            break
        modes = modes / np.maximum(np.linalg.norm(modes, axis=0), 1e-300)
        found = every[:, :count]
        for _ in range(2):  # once leaves rounding of the size of the condition number
            modes = modes - found @ (found.T @ modes)
        left, singular, _ = np.linalg.svd(modes, full_matrices=False)
        new = left[:, singular > 1e-7]
        if degree > 0 and count + new.shape[1] > allowed:
            break
        bases.append(new)
        every[:, count : count + new.shape[1]] = new
        count += new.shape[1]
    return bases


def lobe_half_width(theta_i: float, theta_o: np.ndarray, phi_o: np.ndarray, value: np.ndarray) -> float:
    """Half width at half height [rad] of the lobe that scattered samples show round their peak.

    The peak is the largest value within 40 degrees of the mirror direction, the background the median beyond 40
    degrees from it, the profile the median of each five samples in order of their distance from the peak.

    Returns:
        Angle where the profile first falls below half; nan where the peak is below twice the background.
    """
    near = _angle(theta_o, phi_o, theta_i, np.pi) < np.radians(40)
    if not near.any():
        return np.nan
    peak = np.flatnonzero(near)[np.argmax(value[near])]
    alpha = _angle(theta_o, phi_o, theta_o[peak], phi_o[peak])
    far = alpha > np.radians(40)
    background = max(float(np.median(value[far])), 0.0) if far.any() else 0.0
    if value[peak] <= 2 * background or value[peak] <= 0:
        return np.nan
    order = np.argsort(alpha, kind="stable")
    alpha, above = alpha[order], (value[order] - background) / (value[peak] - background)
    # the peak alone, then medians of five neighbours in distance: a single spike stays a spike
    if len(alpha) < 6:
        return np.nan
    windows = np.lib.stride_tricks.sliding_window_view(above[1:], 5)
    profile = np.append(above[:1], np.median(windows, axis=1))
    radius = np.append(alpha[:1], alpha[3 : len(windows) + 3])
    below = np.flatnonzero(profile < 0.5)
    if not len(below):
        return np.nan
    k = below[0]
    fraction = (profile[k - 1] - 0.5) / (profile[k - 1] - profile[k])
    return float(radius[k - 1] + fraction * (radius[k] - radius[k - 1]))


def _angle(theta_a, phi_a, theta_b, phi_b):
    haversine = np.sin((theta_a - theta_b) / 2) ** 2
    haversine = haversine + np.sin(theta_a) * np.sin(theta_b) * np.sin((phi_a - phi_b) / 2) ** 2
    return 2 * np.arcsin(np.sqrt(np.clip(haversine, 0.0, 1.0)))


def measure_cutoff(
    theta_i: np.ndarray,
    theta_o: np.ndarray,
    phi_o: np.ndarray,
    value: np.ndarray,
    *,
    residual: np.ndarray | None = None,
    theta_i_step: float,
    theta_o_step: float,
    phi_o_step: float,
) -> list[CutoffSpectrum]:
    """Measure, for every incident angle, how much of the samples the step of the grid can carry.

    Xu, section 3, figures 2 to 5: noise above the cut-off pi / T is filtered, signal above it is aliased.

    Args:
        theta_i: Incident angles [rad], shape [sample]; likewise `theta_o`, `phi_o`.
        theta_o: Outgoing polar angles [rad].
        phi_o: Outgoing azimuths [rad], mirror direction at pi.
        value: BRDF [1/sr], shape [sample, wavelength].
        residual: Value minus the resampled field there, same shape, or None.
        theta_i_step: Step of the grid in theta_i [rad]; it moves the lobe, so it counts for the lobe's width.
        theta_o_step: Step in theta_o [rad].
        phi_o_step: Step in phi_o [rad]; on the horizon it is a step on a great circle.

    Returns:
        One record per incident angle of at least `MIN_SAMPLES` finite samples, in order; possibly none.
    """
    cutoff = np.pi / max(theta_o_step, phi_o_step)
    finite = np.isfinite(value).all(axis=1)
    if residual is not None:
        finite &= np.isfinite(residual).all(axis=1)
    answer = []
    incidences, incidence = cluster_incidences(theta_i)
    for index, angle in enumerate(incidences):
        group = np.flatnonzero((incidence == index) & finite)
        if len(group) < MIN_SAMPLES or not value[group].any():
            continue
        subset = group[:: -(-len(group) // MAX_SAMPLES)]
        max_degree = min(int(np.ceil(1.25 * cutoff)), MAX_DEGREE)
        bases = sequential_bases(theta_o[subset], phi_o[subset], max_degree=max_degree)
        chosen = value[subset]
        energy = np.mean(np.sum(chosen**2, axis=0))
        explained = np.array([np.mean(np.sum((basis.T @ chosen) ** 2, axis=0)) for basis in bases])
        num_modes = np.array([basis.shape[1] for basis in bases])
        per_mode = len(subset) / np.maximum(num_modes, 1) / energy
        residual_power = None
        if residual is not None:
            left = np.array([np.mean(np.sum((basis.T @ residual[subset]) ** 2, axis=0)) for basis in bases])
            residual_power = left * per_mode
        below = explained[np.arange(len(bases)) <= cutoff].sum()
        half_width = lobe_half_width(float(angle), theta_o[group], phi_o[group], value[group].mean(axis=1))
        # along phi_o a step is shorter by the sine of the peak's polar angle, which is near theta_i
        step = max(theta_i_step, theta_o_step, phi_o_step * np.sin(angle))
        answer.append(
            CutoffSpectrum(
                theta_i=float(angle),
                num_samples=len(group),
                degree=np.arange(len(bases)),
                num_modes=num_modes,
                sample_power=explained * per_mode,
                residual_power=residual_power,
                cutoff=float(cutoff),
                share_above=float(np.sqrt(max(energy - below, 0.0) / energy)),
                half_width=half_width,
                steps_per_half_width=half_width / step,
            )
        )
    return answer
