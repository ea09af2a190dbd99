"""From coefficients on the grid to the compact form; one file a method."""

from typing import Any

from sbrdf_jax.errors import UserError
from sbrdf_jax.options import RepresentOptions
from sbrdf_jax.records import CompactBRDF, SpectralField
from sbrdf_jax.representation import paper

METHODS = {"paper": paper.represent, "auto": paper.represent}  # auto: the only one that there is


def represent(field: SpectralField, options: RepresentOptions) -> CompactBRDF:
    """Return the compact form of a field by the method that the options name.

    Raises:
        UserError: the method is not available yet.
    """
    return represent_with_plan(field, options)[0]


def represent_with_plan(field: SpectralField, options: RepresentOptions) -> tuple[CompactBRDF, dict[str, Any]]:
    """Return what `represent` does, and what was computed and what was skipped, and why."""
    if options.method not in METHODS:
        raise UserError(f"represent.method: found {options.method!r}, which is not available yet, expected 'paper'")
    return METHODS[options.method](field, options)
