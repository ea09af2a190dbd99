"""What a run computes and what it skips, and why; decided on the host, before anything is traced."""

import dataclasses
from collections.abc import Mapping

from sbrdf_jax.folds import Folds
from sbrdf_jax.grid import Grid
from sbrdf_jax.options import RunOptions
from sbrdf_jax.records import RawSamples

CRITICAL_ANGLES = 21


@dataclasses.dataclass(frozen=True)
class PlanRow:
    """How much of one stage is needed."""

    stage: str
    what: str
    needed: int
    total: int
    reason: str


def plan_run(kept: RawSamples, num_read: int, grid: Grid, coefficients: int, options: RunOptions) -> list[PlanRow]:
    """Count what each stage needs of what there is.

    Args:
        kept: The samples that cleaning kept.
        num_read: Samples in the file.
        grid: The grid to fill.
        coefficients: Real coefficients per spectrum.
        options: Resolved options.

    Returns:
        A row per stage; the represent stage is an upper limit, since the data decide which lanes need a lobe.
    """
    wavelengths = len(kept.wavelength_nm)
    nodes = len(grid.theta_i) * len(grid.theta_o) * (grid.num_phi_o + 1)
    lanes = len(grid.theta_i) * coefficients
    kinds = 3 if options.represent.lobe == "best" else 1
    folded = "phi_o folded, poles tied" if grid.bilateral else "poles tied, 360 degrees = 0"
    solved = PlanRow("resample", "unknowns", grid.num_unknowns, nodes, folded)
    if options.resample.method == "guided":
        distinct = len(grid.theta_i) * len(grid.theta_o) * grid.num_azimuths
        solved = PlanRow("resample", "nodes", distinct, nodes, "phi_o folded; read off the fitted field")
    represent = [PlanRow("represent", "lanes", len(grid.theta_i), len(grid.theta_i), "incident angles, all at once")]
    if options.represent.method == "paper":
        represent = [
            PlanRow("represent", "lanes", lanes, lanes, "incident angles x coefficients"),
            PlanRow(
                "represent",
                "lobe fits, at most",
                lanes * CRITICAL_ANGLES * kinds,
                lanes * CRITICAL_ANGLES * 3,
                "lanes that the background explains are skipped",
            ),
        ]
    return [
        PlanRow("clean", "samples", kept.num_samples, num_read, "what is dropped is listed by reason"),
        solved,
        PlanRow("resample", "wavelengths", wavelengths, wavelengths, "no scene: every wavelength"),
        PlanRow("encode", "coefficients", coefficients, wavelengths, f"basis {options.encode.basis}"),
        *represent,
    ]


def plan_validation(schemes: Mapping[str, Folds]) -> list[PlanRow]:
    """Count the fits of held-out validation, a row per scheme: each is a resampling of its own."""
    counts = {name: len(folds.labels) for name, folds in schemes.items()}
    return [PlanRow("validate", name, counts[name], counts[name], folds.how) for name, folds in schemes.items()]


def plan_text(rows: list[PlanRow]) -> str:
    """Return the plan as a table."""
    lines = [f"{'stage':<10} {'what':<21} {'needed':>10} {'total':>10}  why"]
    lines += [f"{r.stage:<10} {r.what:<21} {r.needed:>10} {r.total:>10}  {r.reason}" for r in rows]
    return "\n".join(lines)
