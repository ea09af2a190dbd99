"""Which storage a compact form gets: as coarse as its own error allows, and a wider one where a promise needs it."""

import dataclasses
import functools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sbrdf_jax import colour
from sbrdf_jax.encoding import decode
from sbrdf_jax.grid import has_data
from sbrdf_jax.metrics import error_between, needed_nodes, relative_error, slices
from sbrdf_jax.records import CompactBRDF, GriddedBRDF, LobeHarmonics, LobeTensor, SpectralField
from sbrdf_jax.representation.lobe_tensor import MOST_BETWEEN
from sbrdf_jax.representation.storage import PRECISE, VALUES, round_form
from sbrdf_jax.representation.target import Target, is_met

ROUNDING_SHARE = 0.1  # of the form's own error may "quantised" add, at every incident angle with data
LEAST_SHARE = 0.01  # of its worst, where it is more exact than that
TOLERATED = 0.01  # eta that rounding to a float of any width may add, or the form's own worst
EVALUATION = 1e-9  # relative; what an error differs by from how the fit saw it
FIRST_BITS, MOST_BITS = 8, 24  # float32 has as many
WIDER = {"quantised": ("float32", "float64"), "float16": ("float32", "float64"), "float32": ("float64",)}

Form = CompactBRDF | LobeHarmonics | LobeTensor


class Stored(NamedTuple):
    """A compact form as it will be read back, and what its rounding did."""

    compact: Form
    error: Float[np.ndarray, " theta_i"]  # eta of eq. (18) of the rounded form against the unrounded one
    achieved: dict[str, float]  # by kind of promise: the worst incident angle with data
    warnings: tuple[str, ...]


class _Measured(NamedTuple):
    """A form at the nodes that are needed; nan where none is."""

    storage_error: Float[np.ndarray, " theta_i"]  # against the unrounded form
    error: Float[np.ndarray, " theta_i"]  # against the grid
    delta_e: Float[np.ndarray, " theta_i"]  # its median; nan throughout without colours

    def worst(self, kind: str, known: Bool[np.ndarray, " theta_i"]) -> float:
        """Return what stands beside a promise of an "error" or a "delta_e"."""
        return float(np.max((self.error if kind == "error" else self.delta_e)[known], initial=0.0))


def store(
    compact: Form,
    storage: str,
    field: SpectralField,
    gridded: GriddedBRDF | None,
    promises: tuple[Target, ...],
    matching: colour.ColourMatching | None,
) -> Stored:
    """Round a compact form to a storage so that what it keeps, it still keeps.

    Args:
        compact: The form, unrounded.
        storage: "float32", "float16" or "quantised"; the last with the fewest bits by which rounding
            adds no more than `ROUNDING_SHARE` of the form's own error at any incident angle with data, or than
            `LEAST_SHARE` of its worst. The others may add as much as the form's own worst error, or `TOLERATED`.
        field: What the form is of.
        gridded: The grid stage, if there is one; else the field's own spectra are compared.
        promises: Of errors; those that the unrounded form keeps, the rounded one keeps too.
        matching: Colours of the wavelengths, where a promise is about them; made here unless given.

    Returns:
        The form, and a warning where its storage had to be wider.
    """
    if matching is None and any(promise.kind == "delta_e" for promise in promises):
        matching = colour.colour_matching(np.asarray(compact.basis.wavelength_nm))
    grid = _as_grid(field) if gridded is None else gridded
    if not isinstance(compact, CompactBRDF):  # which alone holds what is odd in phi_o: the others promise nothing of it
        brdf = np.asarray(grid.brdf)
        grid = dataclasses.replace(grid, brdf=(brdf + brdf[:, :, ::-1]) / 2)
    exact = round_form(compact, "float64")
    measure = functools.partial(_measure, unrounded=_node_values(exact, grid), gridded=grid, matching=matching)
    before = measure(exact)
    known = has_data(grid) & np.isfinite(before.error)
    kept = [promise for promise in promises if before.worst(promise.kind, known) <= promise.value * (1 + EVALUATION)]
    limit = _limit_between(exact, kept, gridded, known)
    worst = np.max(before.error[known], initial=0.0)
    allowed = np.maximum(ROUNDING_SHARE * before.error, LEAST_SHARE * worst)

    def is_enough(form: Form, found: _Measured) -> bool:
        most = allowed if form.storage == "quantised" else max(worst, TOLERATED)
        small = (found.storage_error <= most)[known].all() and np.isfinite(found.storage_error[known]).all()
        holds = all(is_met(promise, found.worst(promise.kind, known)) for promise in kept)
        return bool(small and holds and (limit == np.inf or _worst_between(form, gridded, known) <= limit))

    form, found = exact, before
    for form in _trials(compact, storage, measure, allowed[known], known):
        found = measure(form)
        if form.storage == "float64" or is_enough(form, found):
            break
    warnings = ()
    if form.storage != storage:
        why = "its rounding would break a promise, or add more than the error is"
        warnings = (f"compact: stored as {form.storage}, not as {storage}: {why}",)
    achieved = {promise.kind: found.worst(promise.kind, known) for promise in promises}
    return Stored(form, found.storage_error, achieved, warnings)


def _trials(compact: Form, storage: str, measure, allowed, known) -> Iterator[Form]:
    """Yield the form in ever wider storage, unrounded at last.

    Numerics:
        A bit halves what rounding adds, but for its chance: "quantised" starts two bits below what one trial foretells.
    """
    names = (*VALUES[type(compact)], *PRECISE[type(compact)])
    is_finite = all(np.isfinite(np.asarray(getattr(compact, name))).all() for name in names)
    if storage == "quantised" and is_finite and (allowed > 0).all():
        excess = measure(round_form(compact, storage, FIRST_BITS)).storage_error[known] / allowed
        start = FIRST_BITS + np.ceil(np.log2(np.max(excess, initial=2.0**-FIRST_BITS))) - 2
        for bits in range(int(np.clip(start, 1, MOST_BITS)), MOST_BITS + 1):
            yield round_form(compact, storage, bits)
    elif storage != "quantised":
        yield round_form(compact, storage)
    for wider in WIDER[storage]:
        yield round_form(compact, wider)


def _node_values(form: Form, gridded: GriddedBRDF) -> list[Float[np.ndarray, "direction wavelength"]]:
    """Evaluate a form at the nodes that are needed, incident angle by incident angle."""
    return list(slices(form, gridded.theta_i, gridded.theta_o, gridded.phi_o, needed_nodes(gridded)))


def _measure(form: Form, *, unrounded, gridded: GriddedBRDF, matching) -> _Measured:
    rows = []
    nodes = zip(np.asarray(gridded.brdf), needed_nodes(gridded), _node_values(form, gridded), strict=True)
    for (brdf, mask, value), reference in zip(nodes, unrounded, strict=True):
        original, delta_e = brdf[mask], np.nan
        if matching is not None and np.isfinite(original).all() and np.isfinite(value).all() and mask.any():
            delta_e = np.median(colour.delta_e_2000(value, original, matching))
        pairs = ((value, reference), (value, original))
        errors = [relative_error(((a - b) ** 2).sum(), (b**2).sum()) if mask.any() else np.nan for a, b in pairs]
        rows.append((*errors, delta_e))
    return _Measured(*np.array(rows, np.float64).T)


def _limit_between(exact: Form, kept: list[Target], gridded: GriddedBRDF | None, known) -> float:
    """Return what error between the nodes a lobe tensor has promised; infinite where none is."""
    limit = MOST_BETWEEN * min((promise.value for promise in kept if promise.kind == "error"), default=np.inf)
    if not isinstance(exact, LobeTensor) or gridded is None or gridded.field is None or limit >= 1:
        return np.inf
    return limit if _worst_between(exact, gridded, known) <= limit else np.inf


def _worst_between(form: Form, gridded: GriddedBRDF | None, known) -> float:
    assert gridded is not None
    return float(np.nanmax(error_between(form, gridded)["relative_error_between"][known], initial=0.0))


def _as_grid(field: SpectralField) -> GriddedBRDF:
    """Return the spectra of a field as a grid whose every node is known."""
    brdf = np.asarray(decode(np.asarray(field.coefficient, np.float64), field.basis))
    lanes = np.zeros(brdf.shape[3])
    axes = field.theta_i, field.theta_o, field.phi_o, field.basis.wavelength_nm
    return GriddedBRDF(*axes, brdf, np.zeros(brdf.shape[:3], int), lanes, lanes, lanes)
