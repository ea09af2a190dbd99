"""How the numbers of a compact form are stored: rounded once, before anything is measured, and written without loss.

float32 and float16 keep significant bits; float16 counts in a power of two for each slice, so that no unit is too
small or too large for it. "quantised" keeps multiples of a power of two for each slice, as coarse as the form's own
error allows. A slice is one entry of the first axis. What gives a position stays exact: axes, angles, kinds, degrees.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sbrdf_jax.encoding import vector_basis
from sbrdf_jax.records import CompactBRDF, LobeHarmonics, LobeTensor

VALUES = {  # what is rounded, by record; the vectors of a basis that stores them are too
    CompactBRDF: ("background", "lobe_height"),
    LobeHarmonics: ("background", "lobe_height"),
    LobeTensor: ("theta_i_factor", "theta_o_factor", "direction_factor", "core"),
}
PRECISE = {  # within an exponential, where a small error grows: float32 at least
    CompactBRDF: ("lobe_width",),
    LobeHarmonics: ("lobe_width",),
    LobeTensor: ("log_scale",),
}
MOST_NEGATIVE = -(2**14)  # an exponent below that of any number


class Written(NamedTuple):
    """An array as it lies in a file: value = (number - offset) * 2**exponent, an exponent for each slice."""

    number: np.ndarray
    exponent: np.ndarray | None = None  # [slice] int; None: the numbers are the values
    offset: int = 0


def round_form(
    compact: CompactBRDF | LobeHarmonics | LobeTensor, storage: str, bits: int = 0
) -> CompactBRDF | LobeHarmonics | LobeTensor:
    """Return a compact form with its numbers rounded to a storage, in float64.

    Args:
        compact: The form, unrounded.
        storage: "float64", "float32", "float16" or "quantised".
        bits: Of "quantised": how many binary digits below the size of a slice the last one lies.

    Numerics:
        Beyond float32's range a value becomes infinite. "quantised" takes finite numbers only.
    """
    if storage == "float64":
        return dataclasses.replace(compact, storage=storage)
    units = _units(compact) if storage == "quantised" else {}

    def rounded(name: str, value) -> np.ndarray:
        value = np.asarray(value, np.float64)
        rows = first_axis(value.shape)
        if storage == "float32":
            return _as_float32(value)
        exponent = _float16_exponent(value, rows)
        if storage == "quantised":
            exponent = np.frexp(np.broadcast_to(units[name], len(value)))[1] - bits
            return np.ldexp(np.rint(np.ldexp(value, -exponent[rows])), exponent[rows])
        return np.ldexp(np.ldexp(value, -exponent[rows]).astype(np.float16).astype(np.float64), exponent[rows])

    parts = {name: rounded(name, getattr(compact, name)) for name in VALUES[type(compact)]}
    parts |= {name: _as_float32(getattr(compact, name)) for name in PRECISE[type(compact)]}
    basis = compact.basis
    if basis.stores_vectors:
        basis = vector_basis(basis.wavelength_nm, rounded("spectral_vectors", basis.synthesis), basis.kind)
    return dataclasses.replace(compact, storage=storage, basis=basis, **parts)


def written(value: Float[np.ndarray, "*shape"], storage: str, rows: Int[np.ndarray, "*shape"]) -> Written:
    """Return rounded values as they are written; `rows`: the slice of each.

    Integers are as narrow as they fit. Two or more bytes wide, they are counted from an offset that
    makes all bytes but the lowest alike near zero: then they compress well, whatever their sign.
    """
    if storage in ("float64", "float32"):
        return Written(value.astype(storage))
    if storage == "float16":
        exponent = _float16_exponent(value, rows)
        return Written(np.ldexp(value, -exponent[rows]).astype(np.float16), exponent)
    exponent = _coarsest_exponent(value, rows)
    number = np.ldexp(value, -exponent[rows]).astype(np.int64)
    largest = np.abs(number).max(initial=0)
    for width in (1, 2, 4, 8):
        offset = sum(0x80 << 8 * byte for byte in range(width - 1))
        if largest + offset < 1 << (8 * width - 1):
            return Written((number + offset).astype(f"i{width}"), exponent, offset)
    raise ValueError(f"integers up to {largest} are too wide")


def read_back(found: Written, rows: Int[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Return what `written` was given."""
    if found.exponent is None:
        return found.number.astype(np.float64)
    number = found.number if found.number.dtype.kind == "f" else found.number.astype(np.int64) - found.offset
    return np.ldexp(number.astype(np.float64), found.exponent.astype(np.int64)[rows])


def first_axis(shape: tuple[int, ...]) -> np.ndarray:
    """Return the place of each entry of an array along its first axis."""
    return np.broadcast_to(np.arange(shape[0]).reshape(-1, *[1] * (len(shape) - 1)), shape)


def narrowest(value) -> np.ndarray:
    """Return an array in the narrowest type of its kind that holds every entry exactly."""
    value = np.asarray(value)
    kinds = [f"{value.dtype.kind}{width}" for width in ((2, 4) if value.dtype.kind == "f" else (1, 2, 4))]
    with np.errstate(over="ignore"):
        narrow = [value.astype(kind) for kind in kinds]
    return next((x for x in narrow if np.array_equal(x, value, equal_nan=x.dtype.kind == "f")), value)


def _as_float32(value) -> np.ndarray:
    with np.errstate(over="ignore"):
        return np.asarray(value).astype(np.float32).astype(np.float64)


def _float16_exponent(value: np.ndarray, rows: np.ndarray) -> Int[np.ndarray, " slice"]:
    """Return by which power of two the largest entry of each slice is below 2^15, once it is rounded to float16."""
    fraction, exponent = np.frexp(np.where(np.isfinite(value), value, 0.0))
    exponent = exponent + (np.abs(fraction).astype(np.float16) == 1)  # rounds up to the next power
    top = np.full(int(rows.max(initial=-1)) + 1, MOST_NEGATIVE)
    np.maximum.at(top, rows, np.where(fraction == 0, MOST_NEGATIVE, exponent))
    return np.where(top == MOST_NEGATIVE, 0, top - 15)


def _coarsest_exponent(value: np.ndarray, rows: np.ndarray) -> Int[np.ndarray, " slice"]:
    """Return the largest power of two of which all entries of a slice are multiples."""
    fraction, exponent = np.frexp(value)
    whole = np.ldexp(fraction, 53).astype(np.int64)
    lowest_bit = np.frexp((whole & -whole).astype(np.float64))[1] - 1
    coarsest = np.full(int(rows.max(initial=-1)) + 1, -MOST_NEGATIVE)
    np.minimum.at(coarsest, rows, np.where(fraction == 0, -MOST_NEGATIVE, exponent - 53 + lowest_bit))
    return np.where(coarsest == -MOST_NEGATIVE, 0, coarsest)


def _units(compact: CompactBRDF | LobeHarmonics | LobeTensor) -> dict[str, Any]:
    """Return the size of each slice, in which steps of "quantised" count; 1 where a slice is 0.

    Spectral vectors weigh what their coefficients do, so that the steps of weak ones are wide. The core of a tensor
    has one step, because its factors are orthonormal; functions of the factors are seen over different shares of
    the hemisphere, and so each has its own.
    """
    largest = {
        name: np.abs(value).reshape(len(value), -1).max(axis=1, initial=0.0)
        for name, value in ((name, np.asarray(getattr(compact, name))) for name in VALUES[type(compact)])
    }
    if isinstance(compact, LobeTensor):
        core = np.asarray(compact.core)
        largest["core"] = np.sqrt((core**2).mean())
        weight = np.sqrt((core**2).sum(axis=(0, 1, 2)))
    else:
        height = np.asarray(compact.lobe_height)
        by_lobe = height[:, None] if height.ndim == 2 else height  # [theta_i, lobe, coefficient]
        parts = np.concatenate([np.swapaxes(compact.background, 1, 2), by_lobe], axis=1)
        size = np.abs(parts).max(axis=(1, 2), keepdims=True)
        weight = np.sqrt(((parts / np.where(size > 0, size, 1.0)) ** 2).sum(axis=(0, 1)))
    vectors = np.abs(np.asarray(compact.basis.synthesis)).max(axis=1)
    largest["spectral_vectors"] = vectors * weight.max() / np.where(weight > 0, weight, weight.max() or 1.0)
    return {name: np.where(size > 0, size, 1.0) for name, size in largest.items()}
