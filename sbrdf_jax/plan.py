"""What a run computes and what it skips, and why; decided on the host, before anything is traced."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from sbrdf_jax.folds import Folds
from sbrdf_jax.grid import Grid
from sbrdf_jax.multipliers import MAX_UNKNOWNS
from sbrdf_jax.needs import Needs
from sbrdf_jax.options import RunOptions
from sbrdf_jax.records import GriddedBRDF, RawSamples
from sbrdf_jax.resampling.guided.merging import MAX_CENTRES as MOST_CENTRES

CRITICAL_ANGLES = 21
MEBI = 2**20
RATE = 3e10  # operations a second of a large product
FEATURES = 1300  # of a direction on the guided method's grids
NODES_OF_A_HEMISPHERE = 13 * 25
EQUAL = {"guided": 1e-9, "paper": 1e-6}  # see `describe_needs`


@dataclasses.dataclass(frozen=True)
class PlanRow:
    """How much of one stage is needed."""

    stage: str
    what: str
    needed: int
    total: int
    reason: str


def plan_run(
    kept: RawSamples, num_read: int, grid: Grid, coefficients: int, options: RunOptions, needs: Needs
) -> list[PlanRow]:
    """Count what each stage needs of what there is.

    Args:
        kept: The samples that cleaning kept.
        num_read: Samples in the file.
        grid: The grid to fill.
        coefficients: Real coefficients per spectrum.
        options: Resolved options.
        needs: What the scene needs.

    Returns:
        A row per stage; the represent stage is an upper limit, since the data decide which lanes need a lobe.
    """
    wavelengths, needed = len(kept.wavelength_nm), int(needs.wavelength.sum())
    nodes = len(grid.theta_i) * len(grid.theta_o) * (grid.num_phi_o + 1)
    angles, needed_angles = len(grid.theta_i), int(needs.theta_i.sum())
    kinds = 3 if options.represent.lobe == "best" else 1
    folded = "phi_o folded, poles tied" if grid.bilateral else "poles tied, 360 degrees = 0"
    scene = "no scene: every one" if options.scene is None else "the scene's"
    solved = PlanRow("resample", "unknowns", grid.num_unknowns, nodes, folded + "; coupled, all solved")
    if options.resample.method == "guided":
        distinct = int(needs.node[:, :, : grid.num_azimuths].sum())
        solved = PlanRow("resample", "nodes", distinct, nodes, f"{scene}; phi_o folded; read off the fitted field")
    represent = [PlanRow("represent", "lanes", needed_angles, angles, "incident angles, all at once")]
    if options.represent.method == "paper":
        lanes, every = needed_angles * coefficients, angles * coefficients
        represent = [
            PlanRow("represent", "lanes", lanes, every, f"incident angles ({scene}) x coefficients"),
            PlanRow(
                "represent",
                "lobe fits, at most",
                lanes * CRITICAL_ANGLES * kinds,
                every * CRITICAL_ANGLES * 3,
                "lanes that the background explains are skipped",
            ),
        ]
    colour = options.scene is not None and options.scene.colour is not None
    chosen = "those that a colour needs" if colour else scene
    return [
        PlanRow("clean", "samples", kept.num_samples, num_read, "what is dropped is listed by reason"),
        PlanRow("estimate", "samples", kept.num_samples, kept.num_samples, "noise, lobes, smoothness: of the whole"),
        solved,
        PlanRow("resample", "wavelengths", needed, wavelengths, chosen),
        PlanRow("encode", "coefficients", coefficients, needed, f"basis {options.encode.basis}"),
        *represent,
    ]


def describe_needs(needs: Needs, wavelength_nm: np.ndarray, gridded: GriddedBRDF) -> dict[str, Any]:
    """Return what a result keeps of a scene: what was needed, and how far its numbers may be from a full run's.

    Method "guided" solves every wavelength by itself and evaluates every node by itself, from
    estimates of the whole measurement; method "paper" solves all nodes of a wavelength: there is
    no halo to add, and the bound is rounding, for paper what its tolerance leaves.
    """
    return {
        "wavelength_nm": np.asarray(wavelength_nm),
        "wavelength_needed": needs.wavelength.astype(np.uint8),
        "node_needed": needs.node.astype(np.uint8),
        "difference_bound": EQUAL[gridded.method],
        "difference_bound_meaning": "largest difference to the full run's grid, relative to its largest value",
    }


def plan_validation(schemes: Mapping[str, Folds]) -> list[PlanRow]:
    """Count the fits of held-out validation, a row per scheme: each is a resampling of its own."""
    counts = {name: len(folds.labels) for name, folds in schemes.items()}
    return [PlanRow("validate", name, counts[name], counts[name], folds.how) for name, folds in schemes.items()]


def plan_text(rows: list[PlanRow], cost: Mapping[str, tuple[float, float]] | None = None) -> str:
    """Return the plan as a table, with what each stage is predicted to take once it is compiled."""
    lines = [f"{'stage':<10} {'what':<21} {'needed':>10} {'total':>10}  why"]
    lines += [f"{r.stage:<10} {r.what:<21} {r.needed:>10} {r.total:>10}  {r.reason}" for r in rows]
    lines += [
        f"{stage:<10} about {seconds:.2g} seconds, {mebi:.0f} MiB" for stage, (seconds, mebi) in (cost or {}).items()
    ]
    return "\n".join(lines)


def predict_cost(kept: RawSamples, grid: Grid, options: RunOptions, needs: Needs) -> dict[str, tuple[float, float]]:
    """Predict seconds (compiled, on two cores) and memory [MiB] by stage, from operation counts.

    Rates were measured on two cores of a server; they tell a scene from a full run, and hours from seconds.
    """
    lanes, nodes = int(needs.wavelength.sum()), int(needs.node[:, :, : grid.num_azimuths].sum())
    cell_lanes = nodes * lanes
    cost = {}
    if options.resample.method == "guided":
        centres = min(kept.num_samples, MOST_CENTRES)
        cost["estimate"] = (0.2 + 3.5e-10 * centres**3, 3 * 8 * centres**2 / MEBI)
        variance = nodes * centres * (centres + FEATURES) * 2
        seconds = 0.05 + 2 * centres**2 * lanes * 10 / RATE + variance / (2 * RATE) + cell_lanes * 4e-7
        cost["resample"] = (seconds, (8 * (2 * centres**2 + 4 * cell_lanes)) / MEBI)
    else:
        unknowns = grid.num_unknowns
        inverse = unknowns if unknowns <= MAX_UNKNOWNS else 0
        cost["resample"] = (0.5 * inverse**3 / RATE + unknowns**2 * lanes * 40 / RATE, 16 * inverse**2 / MEBI)
    cost["represent"] = (0.05 + 0.04 * nodes / NODES_OF_A_HEMISPHERE + cell_lanes * 1.3e-6, 40 * cell_lanes / MEBI)
    cost["measure"] = (0.3 + cell_lanes * 1.05e-6, 16 * cell_lanes / MEBI)
    return cost
