"""From coefficients on the grid to the compact form; one file a method."""

from typing import Any

import numpy as np

from sbrdf_jax.colour import ColourMatching
from sbrdf_jax.host_blas import one_blas_thread
from sbrdf_jax.options import ADDING_METHODS, ErrorBudget, RepresentOptions
from sbrdf_jax.records import CompactBRDF, GriddedBRDF, LobeHarmonics, LobeTensor, SpectralField
from sbrdf_jax.representation.target import Target, in_words, make_target
from sbrdf_jax.runtime import require_float64


def represent(
    field: SpectralField, options: RepresentOptions, gridded: GriddedBRDF | None = None
) -> CompactBRDF | LobeHarmonics | LobeTensor:
    """Return the compact form of a field by the method that the options name.

    Args:
        field: Coefficients at the nodes.
        options: Method, target, limits and storage.
        gridded: The grid stage, where there is one: other methods than "paper" are then measured
            against its spectra and fitted between its nodes too.

    Raises:
        UserError: float64 is off in JAX.
        ValueError: The field's basis is "log_data", and the method is neither `lobe_tensor` nor `auto`.
    """
    return represent_with_plan(field, options, gridded)[0]


def represent_with_plan(
    field: SpectralField,
    options: RepresentOptions,
    gridded: GriddedBRDF | None = None,
    matching: ColourMatching | None = None,
    budget: ErrorBudget | None = None,
) -> tuple[CompactBRDF | LobeHarmonics | LobeTensor, dict[str, Any]]:
    """Return what `represent` does, and what was computed and what was skipped, and why.

    What was found has `storage_error` [theta_i]: eta of eq. (18) between the form as stored and unrounded.
    """
    # here, because evaluation, which these methods use, imports the values of this package's records
    from sbrdf_jax.representation import auto, lobe_harmonics, lobe_tensor, paper

    require_float64()
    if field.basis.is_logarithmic and options.method in ADDING_METHODS:
        raise ValueError(f"basis log_data: method {options.method} adds lobes and harmonics up, not logarithms")
    if options.method == "paper":
        compact, plan = paper.represent(field, options)
        return _stored(compact, plan, field, options, gridded, matching, None)
    method = {"auto": auto, "lobe_harmonics": lobe_harmonics, "lobe_tensor": lobe_tensor}[options.method]
    with one_blas_thread():
        compact, plan = method.represent(field, options, gridded, matching, budget)
    num_theta_i, num_wavelengths = np.size(field.theta_i), np.size(field.basis.wavelength_nm)
    target = make_target(options.target, num_theta_i, num_wavelengths, budget)
    return _stored(compact, plan, field, options, gridded, matching, target)


def _stored(compact, plan, field, options, gridded, matching, target: Target | None):
    """Round a compact form to the storage that the options name, and say in its plan what that did."""
    if options.storage == "float64":
        return compact, plan | {"storage": "float64", "storage_error": np.zeros(np.size(compact.theta_i))}
    from sbrdf_jax.representation.storage_choice import store

    stored = store(compact, options.storage, field, gridded, () if target is None else target.stops, matching)
    plan = plan | {"storage": stored.compact.storage, "storage_error": stored.error}
    plan["warnings"] = [*plan.get("warnings", ()), *stored.warnings]
    if target is not None and target.kind in stored.achieved:
        plan["measured"] = in_words(target, stored.achieved[target.kind])
    return stored.compact, plan
