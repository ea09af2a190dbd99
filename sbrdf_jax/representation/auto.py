"""`represent.method: auto`: the smallest form that meets an error, or the most exact one of a size.

`lobe_tensor` is first; `lobe_harmonics`, which takes seconds, is tried where it may be better.
"""

from typing import Any

import numpy as np

from sbrdf_jax import colour
from sbrdf_jax.options import ErrorBudget, RepresentOptions
from sbrdf_jax.records import GriddedBRDF, LobeHarmonics, LobeTensor, SpectralField
from sbrdf_jax.representation import lobe_harmonics, lobe_tensor
from sbrdf_jax.representation.target import Target, in_words, make_target

LEAST_ERROR = 0.02  # at the worst incident angle: no `lobe_harmonics` of any material measured so far is below


def represent(
    field: SpectralField,
    options: RepresentOptions,
    gridded: GriddedBRDF | None = None,
    matching: colour.ColourMatching | None = None,
    budget: ErrorBudget | None = None,
) -> tuple[LobeTensor | LobeHarmonics, dict[str, Any]]:
    """Return the better one of two forms; its plan says in `tried` what each reached, or why it was not tried.

    Args are those of both methods. Better is what meets the target; then, for an error or a colour
    difference, what stores fewer numbers; for a size, what has the lesser error at the worst
    incident angle. Where neither meets it, the other of the two decides. Equals leave `lobe_tensor`.
    """
    num_theta_i = np.size(field.theta_i)
    target = make_target(options.target, num_theta_i, np.size(field.basis.wavelength_nm), budget)
    tensor, plan = lobe_tensor.represent(field, options, gridded, matching, budget)
    stored = lobe_tensor.stored_numbers(tensor)
    found: list[tuple[tuple[bool, float], Any, dict[str, Any]]] = [(_rank(target, plan, stored), tensor, plan)]
    tried = {"lobe_tensor": _in_words(target, plan, stored / num_theta_i)}
    reason = _ruled_out(tensor, target, plan, stored, gridded)
    if reason is None:
        harmonics, plan = lobe_harmonics.represent(field, options, gridded, matching, budget)
        stored = lobe_harmonics.stored_numbers(harmonics)
        found.append((_rank(target, plan, stored), harmonics, plan))
        tried["lobe_harmonics"] = _in_words(target, plan, stored / num_theta_i)
    else:
        tried["lobe_harmonics"] = f"not tried: {reason}"
    _, compact, plan = min(found, key=lambda each: each[0])
    return compact, plan | {"tried": tried}


def _rank(target: Target, plan: dict[str, Any], stored: int) -> tuple[bool, float]:
    """Return what is less for the better form."""
    is_met = bool(plan["is_met"])
    return not is_met, float(stored if is_met != target.is_size else plan["worst"])


def _ruled_out(
    tensor: LobeTensor, target: Target, plan: dict[str, Any], stored: int, gridded: GriddedBRDF | None
) -> str | None:
    """Return why `lobe_harmonics` cannot be better than the lobe tensor, as far as that is known without it."""
    if tensor.basis.is_logarithmic:
        return "it adds lobes and harmonics up, not logarithms"
    if gridded is not None and gridded.needed is not None and not np.all(gridded.needed):
        return "it needs whole hemispheres"
    if target.is_size and target.stops:
        return "a budget of error beside a size is lobe_tensor's"
    most = target.budget if target.is_size else stored if plan["is_met"] else np.inf
    least = lobe_harmonics.least_numbers(tensor)
    if least >= most:
        numbers = least / np.size(tensor.theta_i)
        return f"with a lobe and a constant at each incident angle it takes {numbers:.3g} numbers for each"
    asked = plan["worst"] if target.is_size else target.value
    if plan["is_met"] and target.kind != "delta_e" and asked <= LEAST_ERROR:
        return f"its worst incident angle is hardly ever below {100 * LEAST_ERROR:g} %"
    return None


def _in_words(target: Target, plan: dict[str, Any], numbers: float) -> str:
    kind = "delta_e" if target.kind == "delta_e" else "error"
    unit = "Delta E 2000 " if kind == "delta_e" else ""
    return f"{numbers:.4g} numbers for each incident angle, {unit}{in_words(target._replace(kind=kind), plan['worst'])}"
