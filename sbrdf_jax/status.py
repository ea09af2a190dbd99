"""How a lane ended."""

import enum


class Status(enum.IntEnum):
    """How one lane (a wavelength, or one coefficient of one incident angle) ended."""

    OK = 0
    MAX_STEPS = 1
    NONFINITE = 2
    SKIPPED = 3
    CLAMPED = 4
    NO_LOBE = 5


STATUS_TEXT = {
    Status.OK: "reached its tolerance",
    Status.MAX_STEPS: "stopped at the step limit before its tolerance; raise the limit or the tolerance",
    Status.NONFINITE: "not finite; look at the input of this lane",
    Status.SKIPPED: "not computed, because nothing needs it",
    Status.CLAMPED: "the lobe is narrower than the grid; its width was set to the narrowest that the grid shows",
    Status.NO_LOBE: "the background alone explains it",
}
