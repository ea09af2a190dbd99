"""What a batch shows: progress over the whole library, a line for each material, a table at the end."""

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence

from sbrdf_jax.batch.library import Material
from sbrdf_jax.batch.states import Outcome, State
from sbrdf_jax.progress import Progress, format_seconds

MOST_ROWS = 200  # of a table; a longer one lists what is not done


class Watch:
    """Counts starts and ends, and reports them."""

    def __init__(self, outcomes: Sequence[Outcome], progress: Progress, clock: Callable[[], float] = time.monotonic):
        """Begin with where every material stands."""
        self.outcomes = {outcome.name: outcome for outcome in outcomes}
        self._progress, self._clock = progress, clock
        self._running: set[str] = set()
        self._ends: list[float] = []

    def started(self, name: str) -> None:
        """A worker has begun with a material."""
        self._running.add(name)
        self._progress.log(f"{name}: started")
        self._show()

    def ended(self, outcome: Outcome) -> None:
        """A material has come to its result or its failure."""
        self._running.discard(outcome.name)
        self.outcomes[outcome.name] = outcome
        self._ends.append(self._clock())
        self._progress.say(material_line(outcome))
        self._show()

    def _show(self) -> None:
        counts = Counter(outcome.state for outcome in self.outcomes.values())
        text = f"{counts[State.DONE]} of {len(self.outcomes)} done, {len(self._running)} running"
        left = len(self.outcomes) - counts[State.DONE] - counts[State.FAILED]
        if counts[State.FAILED]:
            text += f", {counts[State.FAILED]} failed"
        if left and len(self._ends) > 1:
            pace = (self._ends[-1] - self._ends[0]) / (len(self._ends) - 1)  # without the first, which compiles
            text += f", {format_seconds(left * pace)} left"
        self._progress.update(text)


def material_line(outcome: Outcome) -> str:
    """One line on one material."""
    line = f"{outcome.name}: {outcome.state}"
    if outcome.computed:
        line += f" in {format_seconds(outcome.seconds)}"
        if outcome.compile_seconds >= 0.05:
            line += f" (compile {format_seconds(outcome.compile_seconds)})"
    if outcome.failed_lanes:
        line += f", {outcome.failed_lanes} lanes failed"
    return line + (f": {outcome.reason}" if outcome.reason else "")


def table(outcomes: Sequence[Outcome], running: Sequence[str] = ()) -> str:
    """Every material with its state, times, worst error and reason; of a long library, those that are not done."""
    lines = [f"{'material':<28} {'state':<9} {'seconds':>8} {'compile':>8} {'error %':>8}  reason"]
    shown = [o for o in outcomes if len(outcomes) <= MOST_ROWS or o.state is not State.DONE or o.failed_lanes]
    for outcome in shown[:MOST_ROWS]:
        state = "running" if outcome.name in running else str(outcome.state)
        seconds, compiling = (f"{value:.2f}" if value else "" for value in (outcome.seconds, outcome.compile_seconds))
        error = "" if math.isnan(outcome.worst_error) else f"{100 * outcome.worst_error:.3g}"
        lanes = f"{outcome.failed_lanes} lanes failed" if outcome.failed_lanes else ""
        reason = "; ".join(text for text in (lanes, outcome.reason) if text)
        lines.append(f"{outcome.name:<28} {state:<9} {seconds:>8} {compiling:>8} {error:>8}  {reason}".rstrip())
    if len(shown) > MOST_ROWS:
        lines.append(f"... and {len(shown) - MOST_ROWS} more")
    return "\n".join([*lines, count_states(outcomes, running)])


def count_states(outcomes: Sequence[Outcome], running: Sequence[str] = ()) -> str:
    """Count materials by where they stand: "64 materials: 62 done, 2 failed"."""
    counts = Counter("running" if outcome.name in running else str(outcome.state) for outcome in outcomes)
    parts = ", ".join(f"{count} {state}" for state, count in counts.most_common())
    return f"{len(outcomes)} materials: {parts}"


def plan_table(materials: Sequence[Material], outcomes: Sequence[Outcome], retry_failed: bool) -> str:
    """What a batch would compute, and why; then what it would skip."""
    pairs = [(m, o) for m, o in zip(materials, outcomes, strict=True) if needs_work(o, retry_failed)]
    lines = [f"{'to compute':<28} {'because':<9} input"]
    lines += [f"{m.name:<28} {o.state!s:<9} {m.options.input.path}" for m, o in pairs[:MOST_ROWS]]
    if len(pairs) > MOST_ROWS:
        lines.append(f"... and {len(pairs) - MOST_ROWS} more")
    failed = [o for o in outcomes if o.state is State.FAILED and not retry_failed]
    lines += [f"skipped: {material_line(o)}" for o in failed[:MOST_ROWS]]
    return "\n".join([*lines, f"{count_states(outcomes)}; {len(pairs)} to compute"])


def needs_work(outcome: Outcome, retry_failed: bool) -> bool:
    """Whether a material is to be computed."""
    return outcome.state is not State.DONE and (outcome.state is not State.FAILED or retry_failed)
