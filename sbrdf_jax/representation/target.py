"""What a compact form has to meet: a budget of numbers, or an error at every incident angle that counts."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sbrdf_jax import colour
from sbrdf_jax.options import ErrorBudget, RepresentOptions, TargetOptions

PAPER_DIRECTIONS = 13 * 49  # the paper's nodes of one incident angle, copies at the pole and at 360 degrees counted


class Target(NamedTuple):
    """One promise. `kind` is a key of `represent.target`."""

    kind: str
    value: float
    budget: float  # most stored numbers, over all incident angles
    enough: tuple[tuple[str, float], ...] = ()  # errors by kind: where all of them are reached, the search ends

    @property
    def is_size(self) -> bool:
        """True where numbers are promised, not errors."""
        return self.kind in ("ratio", "numbers")

    @property
    def in_colour(self) -> bool:
        """True where a colour difference is promised, or enough."""
        return "delta_e" in (self.kind, *(kind for kind, _ in self.enough))

    @property
    def stops(self) -> tuple["Target", ...]:
        """Errors at which to stop, as targets of their own."""
        return tuple(Target(kind, value, float("inf")) for kind, value in self.enough)

    @property
    def text(self) -> str:
        """The promise in words."""
        return {
            "ratio": f"compression ratio of at least {self.value:g}",
            "numbers": f"at most {self.value:g} numbers for each incident angle",
            "error": f"relative error of at most {100 * self.value:.3g} % at every incident angle with data",
            "delta_e": f"median Delta E 2000 of at most {self.value:g} at every incident angle with data",
        }[self.kind]


def make_target(
    options: TargetOptions,
    num_theta_i: int,
    num_wavelengths: int,
    budget: ErrorBudget | None = None,
) -> Target:
    """Return the target that the options give, for a grid; of a target and a scene's budget the stricter.

    A budget of numbers and one of error hold both: what is reached first ends the search. The default size, which
    nobody asked for, gives way to a budget.
    """
    if budget is not None and options == RepresentOptions().target:
        options = TargetOptions(**vars(budget))
    kind, value = _given(options)
    enough = {kind: value} if kind in ("error", "delta_e") else {}
    if budget is not None:
        name, limit = _given(budget)
        if name == kind:
            value = min(value, limit)
            enough = {kind: value}
        else:
            enough[name] = limit
    most = {
        "ratio": num_theta_i * PAPER_DIRECTIONS * num_wavelengths / value,
        "numbers": num_theta_i * value,
    }.get(kind, float("inf"))
    return Target(kind, float(value), float(most), tuple(enough.items()))


def _given(options: TargetOptions | ErrorBudget) -> tuple[str, float]:
    return next((name, float(value)) for name, value in vars(options).items() if value is not None)


def azimuth_twins(phi_o: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Return how many directions of the circle each azimuth of one side stands for: that of the mirror for itself."""
    return np.where(np.isclose(phi_o, np.pi), 1.0, 2.0)


def node_errors(
    found: Float[np.ndarray, "i o p wavelength"], wanted: Float[np.ndarray, "i o p wavelength"], twins
) -> Float[np.ndarray, " i"]:
    """Eq. (18) for each incident angle; `twins` [p]: how many nodes each azimuth stands for."""
    error = np.einsum("iopw,p->i", (found - wanted) ** 2, twins)
    energy = np.einsum("iopw,p->i", wanted**2, twins)
    return np.sqrt(error / np.where(energy > 0, energy, 1.0))


def median_delta_e(
    found: Float[np.ndarray, "i o p wavelength"],
    wanted: Float[np.ndarray, "i o p wavelength"],
    matching: colour.ColourMatching,
    needed: Bool[np.ndarray, "i o p"],
) -> Float[np.ndarray, " i"]:
    """Median colour difference over the needed nodes of each incident angle, from those on one side."""
    difference = np.where(needed, colour.delta_e_2000(found, wanted, matching), np.nan)
    difference = np.concatenate([difference, difference[:, :, -2::-1]], axis=2).reshape(len(difference), -1)
    counts = needed.any(axis=(1, 2))
    median = np.zeros(len(difference))
    median[counts] = np.nanmedian(difference[counts], axis=1)
    return median


def measured(
    target: Target,
    stored: int,
    found: Float[np.ndarray, "i o p wavelength"],
    wanted: Float[np.ndarray, "i o p wavelength"],
    twins: Float[np.ndarray, " p"],
    known: Bool[np.ndarray, " i"],
    matching: colour.ColourMatching | None,
    needed: Bool[np.ndarray, "i o p"] | None = None,
) -> float:
    """Return what stands beside the promise: the ratio, the numbers, or the worst incident angle's error."""
    needed = np.ones(found.shape[:3], bool) if needed is None else needed
    if target.is_size:
        return target.value * (target.budget / stored if target.kind == "ratio" else stored / target.budget)
    if target.kind == "error":
        found, wanted = (np.where(needed[..., None], brdf, 0.0) for brdf in (found, wanted))
        return float(node_errors(found, wanted, twins)[known].max(initial=0.0))
    assert matching is not None
    return float(median_delta_e(found, wanted, matching, needed)[known].max(initial=0.0))


def is_met(target: Target, value: float) -> bool:
    """True where a measured value keeps the promise."""
    return value >= target.value if target.kind == "ratio" else value <= target.value


def in_words(target: Target, value: float) -> str:
    """Say what was measured, in the words of the promise."""
    return {
        "ratio": f"{value:.4g}:1",
        "numbers": f"{value:.4g} numbers for each incident angle",
        "error": f"{100 * value:.3g} % at the worst",
        "delta_e": f"{value:.3g} at the worst",
    }[target.kind]
