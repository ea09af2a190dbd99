"""The command line: `sbrdf VERB ...`, the same verbs as `python -m sbrdf_jax.VERB ...`.

Exit codes: 0 done, 1 an unexpected error, 2 the config or the input is wrong, 3 finished
but some lanes failed, 130 interrupted, 143 terminated.
"""

import argparse
import gc
import importlib
import os
import sys
from collections.abc import Sequence

from sbrdf_jax.errors import UserError
from sbrdf_jax.stopping import INTERRUPTED, stop_on_signals

UNEXPECTED, WRONG_INPUT, SOME_LANES_FAILED = 1, 2, 3

COMMANDS = {
    "run": "from a measurement to a result, as a config says",
    "evaluate": "values of a result at given directions",
    "inspect": "what a measurement or a result is",
    "sample": "write the embedded sample as a raw file",
    "batch": "many materials, as a library file says",
    "report": "figures and a page of one or more results",
    "footprint": "which directions of its materials a scene looks at",
    "schema": "JSON schema of the config, for editors",
}
OBJECTS_A_COLLECTION = 200_000  # modules are most of a process's objects, and live: to look through them costs 0.4 s
STOPPED_BATCH = "finished results stay; the same command goes on from there"


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str):
        self.exit(WRONG_INPUT, f"{self.prog}: {message}; see {self.prog} --help\n")


def main(argv: Sequence[str]) -> int:
    """Run one command line and return its exit code."""
    if not argv or argv[0] in ("-h", "--help"):
        print(_overview())
        return 0 if argv else WRONG_INPUT
    verb, rest = argv[0], argv[1:]
    if verb not in COMMANDS:
        print(f"sbrdf: unknown command {verb!r}; it is one of {', '.join(COMMANDS)}", file=sys.stderr)
        return WRONG_INPUT
    command = importlib.import_module(f"sbrdf_jax.commands.{verb}")
    parser = _Parser(
        prog=f"sbrdf {verb}",
        description=command.SUMMARY,
        epilog=command.EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_arguments(parser)
    try:
        return command.run(parser.parse_intermixed_args(rest))
    except UserError as error:
        print(f"sbrdf {verb}: {error}", file=sys.stderr)
        return WRONG_INPUT
    except KeyboardInterrupt:
        print(f"sbrdf {verb}: interrupted; nothing was written under the output name", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output went away: `sbrdf ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNEXPECTED
    except Exception as error:
        print(f"sbrdf {verb}: unexpected {type(error).__name__}: {first_line(error)}", file=sys.stderr)
        return UNEXPECTED


def main_exit(*verb: str) -> None:
    """Run the process's own command line, after `verb` where the module names it, and end the process."""
    gc.set_threshold(OBJECTS_A_COLLECTION)
    argv = [*verb, *sys.argv[1:]]
    remarks = {"remark": STOPPED_BATCH} if argv[:1] == ["batch"] else {}
    stop_on_signals(" ".join(["sbrdf", *argv[:1]]), **remarks)
    raise SystemExit(main(argv))


def first_line(error: BaseException) -> str:
    """Return the first line of an error's text."""
    return (str(error).splitlines() or [""])[0]


def _overview() -> str:
    rows = "\n".join(f"  {name:<10} {summary}" for name, summary in COMMANDS.items())
    return f"usage: sbrdf COMMAND ...\n\n{rows}\n\nsbrdf COMMAND --help shows an example."
