"""The command ``mirrorskin``: names the commands, and turns the project's errors into one line.

Nothing heavy is imported here or at the top of a command's module, nor any command's module here: ``--help``
must be quick.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Annotated

import click

from mirrorskin.cli.groups import LazyGroup, Option, make_command

_INTERRUPTED = 130  # what shells say of a program that Ctrl-C ended
_SOON = 0.001  # seconds
_LESS = "take a smaller region or fewer frames, or end other programs"
_HELP = "NoArgsIsHelpError"  # of a group that no command was named of; its message is the group's help

PURPOSES = {
    "demo": "Repeat the paper's experiments on the twin.",
    "simulate": "Record what the twin sees, with the truth.",
    "sample": "Make data to try things on.",
    "import": "Make a recording of a video or pictures.",
    "capture": "Move the stage, and record what the camera sees.",
    "live": "Reconstruct while the stage moves.",
    "reconstruct": "Reconstruct heights from a press, normals and heights from a rotation, or slip.",
    "correlate": "Fit mean, cosine and sine of the phase to each pixel's brightness.",
    "run": "Run an estimator of your own over a recording.",
    "fuse": "Make one surface of a press and a rotation.",
    "stitch": "Make one larger surface of several touches.",
    "batch": "Reconstruct many recordings.",
    "view": "Show the maps of a result, a section and a histogram of heights.",
    "measure": "Measure a height map: heights, areas, volumes, plane or sphere, roughness, steps.",
    "report": "Write a page with pictures, numbers and the surface.",
    "export": "Write a result as meshes, points, pictures, tables or arrays.",
    "score": "Compare a result with a simulation's truth.",
    "info": "Tell what a file holds.",
    "devices": "List the OpenCL devices of this machine.",
    "rig": "Look at a stage and a camera before they are used.",
    "calibrate": "Find out what a sensor's counts and pixels mean.",
    "twin": "Emulate a whole rig: its stage and its camera.",
    "bench": "Time the kernels and whole paths against the limits and against others.",
}
"""What the commands are for, in the order of the help; each stands in the module of its name."""


def _common(
    debug: Annotated[bool, Option("--debug", help="Show tracebacks, and what is logged.")] = False,
) -> None:
    import logging

    _OneLine.debug = debug
    logging.basicConfig(level=logging.INFO if debug else logging.WARNING, format="%(message)s")


app: LazyGroup = make_command(
    "mirrorskin",
    _common,
    LazyGroup,
    package="mirrorskin.cli",
    purposes=PURPOSES,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
click.version_option(package_name="mirrorskin", message="%(prog)s %(version)s")(app)
app.help = "Shape from active tactile sensors with a mirror-like skin."


class _OneLine:
    """Print usage errors and the project's own, and only those, as one line, and exit with their code."""

    debug = False
    signalled = 0  # the exit code of a signal that came; libraries make another error of it at times

    def __enter__(self) -> None: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, KeyboardInterrupt | click.Abort):
            sys.exit(_INTERRUPTED)
        if isinstance(error, Exception) and self.signalled:
            sys.exit(self.signalled)
        # The classes that carry a code are not named here: importing them takes longer than --help may.
        no_memory = isinstance(error, MemoryError)
        code = 1 if no_memory else getattr(error, "exit_code", None)
        usage = getattr(error, "format_message", None)
        ours = no_memory or (kind is not None and kind.__module__.startswith("mirrorskin."))
        if not isinstance(code, int) or not (ours or usage):
            return
        if self.debug:
            traceback.print_exception(error)
        message = usage() if usage else str(error)
        if no_memory:
            message = f"not enough memory{message and f' ({message})'}: {_LESS}"
        if kind is not None and kind.__name__ == _HELP:
            sys.stderr.write(f"{message}\n")
        else:
            from mirrorskin.cli.output import printable

            sys.stderr.write(f"mirrorskin: {printable(' '.join(message.split()))}\n")
        sys.exit(code)


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Let signals end the program by an exception, so that nothing half-written stays behind."""
    _OneLine.signalled = 0

    def end(number: int, frame: FrameType | None) -> None:
        _OneLine.signalled = 128 + number
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        sys.exit(128 + number)

    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), end)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not where it is ignored
        signal.signal(signal.SIGINT, end)
    told = sys.unraisablehook

    def insist(lost: sys.UnraisableHookArgs) -> None:
        """Raise it once more if it was lost, as exceptions are in destructors and callbacks."""
        if not isinstance(lost.exc_value, KeyboardInterrupt | SystemExit) or not hasattr(signal, "setitimer"):
            told(lost)
            return
        kind, given = type(lost.exc_value), lost.exc_value.args

        def again(number: int, frame: object) -> None:
            raise kind(*given)

        signal.signal(signal.SIGALRM, again)
        signal.setitimer(signal.ITIMER_REAL, _SOON)

    sys.unraisablehook = insist
    try:
        yield
    finally:
        sys.unraisablehook = told


def main() -> None:
    """Run the command line."""
    words = sys.argv[1:] or ["--help"]
    with _ended_by_signals(), _OneLine():
        try:
            with app.make_context("mirrorskin", words) as context:
                app.invoke(context)
            sys.stdout.flush()
        except click.exceptions.Exit as ended:
            sys.exit(ended.exit_code)
        except BrokenPipeError:  # nobody reads on; Python would say so once more when it ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(1)
        sys.exit(0)


def program() -> None:
    """Run the command line as a program of its own."""
    try:
        main()
    finally:  # all is said and put away: another Ctrl-C ends the interpreter without a traceback
        signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    program()
