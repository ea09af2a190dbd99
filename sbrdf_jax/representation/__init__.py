"""From coefficients on the grid to the compact form; one file a method."""

from typing import Any

from sbrdf_jax.colour import ColourMatching
from sbrdf_jax.host_blas import one_blas_thread
from sbrdf_jax.options import ErrorBudget, RepresentOptions
from sbrdf_jax.records import CompactBRDF, GriddedBRDF, LobeHarmonics, LobeTensor, SpectralField
from sbrdf_jax.runtime import require_float64


def represent(
    field: SpectralField, options: RepresentOptions, gridded: GriddedBRDF | None = None
) -> CompactBRDF | LobeHarmonics | LobeTensor:
    """Return the compact form of a field by the method that the options name.

    Args:
        field: Coefficients at the nodes.
        options: Method, target and limits.
        gridded: The grid stage, where there is one: other methods than "paper" are then measured
            against its spectra and fitted between its nodes too.

    Raises:
        UserError: float64 is off in JAX.
    """
    return represent_with_plan(field, options, gridded)[0]


def represent_with_plan(
    field: SpectralField,
    options: RepresentOptions,
    gridded: GriddedBRDF | None = None,
    matching: ColourMatching | None = None,
    budget: ErrorBudget | None = None,
) -> tuple[CompactBRDF | LobeHarmonics | LobeTensor, dict[str, Any]]:
    """Return what `represent` does, and what was computed and what was skipped, and why."""
    # here, because evaluation, which these methods use, imports the values of this package's records
    from sbrdf_jax.representation import lobe_harmonics, lobe_tensor, paper

    require_float64()
    if options.method == "paper":
        return paper.represent(field, options)
    method = lobe_harmonics if options.method == "lobe_harmonics" else lobe_tensor
    with one_blas_thread():
        return method.represent(field, options, gridded, matching, budget)
