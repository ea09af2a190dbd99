"""The paper's compact form, eq. (13) and section 4.2: harmonics plus one lobe for each coefficient.

For every incident angle and coefficient: the background alone where that is enough, otherwise
21 candidates for the critical angle, background by least squares outside, lobe on the rest
inside, both added everywhere; the least error wins.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sbrdf_jax.angles import MIRROR_AZIMUTH, angle_between
from sbrdf_jax.encoding import mean_spectrum
from sbrdf_jax.harmonics import real_harmonics
from sbrdf_jax.lobes import LOBE_KINDS, lobe_value_any
from sbrdf_jax.options import RepresentOptions
from sbrdf_jax.records import CompactBRDF, SpectralField, Status
from sbrdf_jax.representation.background import orthonormal_harmonics
from sbrdf_jax.representation.critical_angle import CANDIDATES
from sbrdf_jax.representation.directions import distinct_directions

DEFAULT_MAX_DEGREE = 4
ENOUGH = 0.01  # relative error of a lane: what the background leaves, or a lobe takes off it, that calls for a lobe
LANE_REASONS = ("searched", "background_suffices", "zero_everywhere", "nonfinite")  # 0, 1, 2, 3


def compact_coefficient(
    compact: CompactBRDF,
    i_theta: Int[Array | np.ndarray, "..."] | int,
    theta_o: Float[Array | np.ndarray, "*shape"],
    phi_o: Float[Array | np.ndarray, "*shape"],
) -> Float[Array, "*shape coefficient"]:
    """Evaluate eq. (13) at directions, at nodes of the incident angle; pure, for jit, vmap and grad.

    Args:
        compact: Background and lobes.
        i_theta: Node of theta_i, one for all directions or one each.
        theta_o: Polar angle of exitance [rad].
        phi_o: Azimuth of exitance [rad].

    Returns:
        Coefficients [1/sr] of the spectral basis.
    """
    theta_o, phi_o = jnp.asarray(theta_o), jnp.asarray(phi_o)
    harmonic = real_harmonics(theta_o, phi_o, compact.max_degree)
    background = jnp.asarray(compact.background)[i_theta]
    smooth = jnp.einsum("...h,...ch->...c", harmonic, background)
    peak = jnp.broadcast_to(jnp.asarray(compact.lobe_peak_theta_o)[i_theta], theta_o.shape)
    alpha = angle_between(theta_o, phi_o, peak, jnp.full_like(peak, MIRROR_AZIMUTH))
    lobe = (jnp.asarray(a)[i_theta] for a in (compact.lobe_height, compact.lobe_width, compact.lobe_kind))
    return smooth + lobe_value_any(alpha, *lobe)


def represent(field: SpectralField, options: RepresentOptions) -> tuple[CompactBRDF, dict[str, Any]]:
    """Return the paper's compact form of a field, and what was computed and what was skipped.

    Args:
        field: Coefficients at the nodes; phi_o from 0 to 2 pi inclusive.
        options: `max_degree` (auto: 4) and `lobe` are used.

    Returns:
        The compact form, and a plan: `lane_reason` [theta_i, coefficient], places in
        `reason_names`, and `num_lobe_fits`, candidates and kinds included.

    Numerics:
        Eq. (18) counts every node, so a direction weighs as many nodes as it has. A lane has
        no lobe where its background alone leaves a relative error (eq. 18 for this lane) below
        1 %, or where a lobe would lower that error by less than 1 %. A lane with a value that
        is not finite has a background of NaN and the status NONFINITE; the others do not notice.
    """
    # here, because its solver takes a second to import: not for those who only evaluate
    from sbrdf_jax.representation import lane_search
    from sbrdf_jax.representation.peak import plane_of_incidence, refine_peaks

    theta_i, theta_o, phi_o = (np.asarray(axis, np.float64) for axis in (field.theta_i, field.theta_o, field.phi_o))
    max_degree = DEFAULT_MAX_DEGREE if options.max_degree == "auto" else options.max_degree
    chosen = LOBE_KINDS[1:] if options.lobe == "best" else (options.lobe,)
    kinds = lane_search.lobe_kinds(tuple(LOBE_KINDS.index(kind) for kind in chosen), np.diff(theta_o).min())

    directions = distinct_directions(theta_o, phi_o)
    even_harmonics = orthonormal_harmonics(directions, max_degree)
    odd_harmonics = orthonormal_harmonics(directions, max_degree, even=False)
    functions = lane_search.Functions(even_harmonics.value, odd_harmonics.value, directions.weight)
    value, odd_value, scale = _scaled_lanes(*directions.split(np.asarray(field.coefficient, np.float64)))

    known = value * np.nan_to_num(scale)[..., None]
    mean = np.asarray(mean_spectrum(np.moveaxis(known, 1, 2), field.basis))
    plane = plane_of_incidence(theta_o, phi_o, directions)
    peak = refine_peaks(mean, theta_i, plane, directions, kinds, functions)

    # the background alone, for every lane: from here on a lane is only ever improved
    weight = directions.weight
    even, odd = (value * weight) @ functions.even, (odd_value * weight) @ functions.odd
    error = (value - even @ functions.even.T) ** 2 @ weight + (odd_value - odd @ functions.odd.T) ** 2 @ weight
    energy = (value**2 + odd_value**2) @ weight
    reason = np.select([np.isnan(scale), energy == 0, error < ENOUGH**2 * energy], [3, 2, 1], 0)
    kind, height, width = np.zeros(scale.shape, int), np.zeros(scale.shape), np.ones(scale.shape)
    critical_angle = np.full(scale.shape, np.nan)
    status = np.where(np.isnan(scale), int(Status.NONFINITE), int(Status.NO_LOBE))

    lane = np.nonzero(reason == 0)
    if lane[0].size:
        alpha, exponent = lane_search.lobe_geometry(peak, directions)
        geometry = alpha[lane[0]], exponent[lane[0]][:, kinds.index]
        best = lane_search.search(lane_search.Pairs(value[lane], odd_value[lane], *geometry), kinds, functions)
        gains = np.sqrt(error[lane]) - np.sqrt(best.error) >= ENOUGH * np.sqrt(energy[lane])
        lane = (lane[0][gains], lane[1][gains])
        even[lane], odd[lane], critical_angle[lane] = best.even[gains], best.odd[gains], best.critical_angle[gains]
        kind[lane], height[lane] = best.kind[gains], best.lobe.height[gains] * scale[lane]
        width[lane], status[lane] = best.lobe.width[gains], best.lobe.status[gains]

    background = even @ even_harmonics.to_harmonics.T + odd @ odd_harmonics.to_harmonics.T
    compact = CompactBRDF(
        theta_i,
        field.basis,
        background * scale[..., None],
        kind,
        height,
        width,
        critical_angle,
        peak,
        status,
        max_degree=max_degree,
        interpolate_theta_i=field.interpolate_theta_i,
    )
    num_fits = int((reason == 0).sum()) * CANDIDATES * len(kinds.index)
    return compact, {"lane_reason": reason, "reason_names": LANE_REASONS, "num_lobe_fits": num_fits}


def _scaled_lanes(even, odd):
    """Return lanes [theta_i, coefficient, direction] whose largest value is 1, and what they were divided by.

    A lane with a value that is not finite is 0, and its scale NaN.
    """
    is_finite = np.isfinite(even).all(axis=2, keepdims=True)
    even, odd = np.where(is_finite, even, 0.0), np.where(is_finite, odd, 0.0)
    largest = np.maximum(np.abs(even), np.abs(odd)).max(axis=2, keepdims=True)
    scale = np.where(largest > 0, largest, 1.0)
    return even / scale, odd / scale, np.where(is_finite, scale, np.nan)[..., 0]
