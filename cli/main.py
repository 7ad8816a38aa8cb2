"""The command ``mirrorskin``: lists the commands, and prints errors of the project as one line.

Nothing slow is imported here or at the top of a command's module, nor any command's module here: ``--help``
must be quick.
"""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedWriter, FileIO, TextIOWrapper
from types import FrameType, TracebackType
from typing import Annotated, Any

import click
from click.shell_completion import shell_complete

from mirrorskin.cli.groups import LazyGroup, Option, make_command

_COMPLETE = "_MIRRORSKIN_COMPLETE"  # environment variable of shell completion, see click.shell_completion
_INTERRUPTED = 130  # what shells say of a program that Ctrl-C ended
_SOON = 0.001  # seconds
_GARBAGE = 5_000  # objects that are created between two searches for garbage
_INSISTS = 3  # signals after the first one that end the program at once
_STOPPING = b"mirrorskin: it is being stopped; two more Ctrl-C end it at once\n"
_LESS = "take a smaller region or fewer frames, or end other programs"
_LEAST = 512 << 20  # bytes of address space, without which NumPy's libraries end the process
_REFUSED = ("failed to map segment", "annot allocate memory", "can't start new thread")
"""Messages of libraries that got no memory or thread from the system."""
_Handler = Callable[[int, FrameType | None], None]
_HELP = "NoArgsIsHelpError"  # of a group that no command was named of; its message is the group's help

PURPOSES = {
    "demo": "Draw the figures of the paper from experiments on the twin.",
    "simulate": "Record what the twin sees, with the truth.",
    "sample": "Write example data.",
    "import": "Convert frames of another program to a recording.",
    "capture": "Move the stage, and record what the camera sees.",
    "live": "Reconstruct while the stage moves.",
    "touch": "Press and turn until the surface has the requested standard deviation.",
    "reconstruct": "Reconstruct heights from a press, normals and heights from a rotation, or slip.",
    "correlate": "Fit mean, cosine and sine of the phase to each pixel's brightness.",
    "run": "Run an operation over a recording: built-in, or your own.",
    "fuse": "Fuse a press and a rotation to one surface.",
    "stitch": "Join several touches to one larger surface.",
    "batch": "Reconstruct many recordings.",
    "app": "Show recordings and results in the browser: click, change options, measure, save.",
    "view": "Show the maps of a result, a section and a histogram of heights.",
    "measure": "Measure height maps: heights, areas, volumes, forms, texture, profiles, steps, grooves.",
    "report": "Write a page with pictures, numbers and the surface.",
    "export": "Write a result as meshes, points, surface files, pictures, tables or arrays.",
    "score": "Compare a result with the ground truth of a simulation.",
    "info": "Show what a file contains.",
    "check": "Check whether frames and their positions are plausible.",
    "devices": "List the OpenCL devices of this machine.",
    "doctor": "Show the device, versions, extras and caches of this installation, for reports of faults.",
    "rig": "Check a stage and a camera before they are used.",
    "calibrate": "Calibrate brightness, scale, tilt and elasticity of a sensor.",
    "twin": "Emulate a whole rig: its stage and its camera.",
    "bench": "Time the core operations and the limits of a device.",
}
"""Purpose of each command, in the order of the help; a command is in the module of its name."""


def _common(
    debug: Annotated[bool, Option("--debug", help="Show tracebacks, and what is logged.")] = False,
) -> None:
    from mirrorskin.cli.output import printable

    _check_address_space()
    _limit_threads()
    _OneLine.debug = debug
    handler = logging.StreamHandler()
    handler.setFormatter(_Formatter("%(message)s"))
    logging.basicConfig(level=logging.INFO if debug else logging.WARNING, handlers=[handler])
    shown = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if category.__module__.startswith("mirrorskin."):
            click.echo(printable(f"warning: {message}"), err=True)
        else:
            shown(message, category, *where, **more)

    warnings.showwarning = show


class _Formatter(logging.Formatter):
    """Log messages without characters that control terminals."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  # overrides
        from mirrorskin.cli.output import printable

        return printable(super().formatMessage(record))


def _limit_threads() -> None:
    """Let PoCL use the processors that this process may use, rather than all of the machine."""
    from mirrorskin.processors import POCL_THREADS, usable_cores

    if (cores := usable_cores()) < (os.cpu_count() or 1):
        os.environ.setdefault(POCL_THREADS, str(cores))


def _check_address_space() -> None:
    if sys.platform == "win32":
        return
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < _LEAST:
        raise click.ClickException(
            f"the address space is limited to {limit >> 20} MB, and {_LEAST >> 20} MB are needed:"
            " raise or remove the limit (ulimit -v)"
        )


app: LazyGroup = make_command(
    "mirrorskin",
    _common,
    LazyGroup,
    package="mirrorskin.cli.commands",
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
    insisted = 0  # signals after the first one

    def __enter__(self) -> None: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, KeyboardInterrupt | click.Abort):
            sys.exit(_INTERRUPTED)
        if isinstance(error, Exception) and self.signalled:
            sys.exit(self.signalled)
        # Classes that carry a code are not imported here: that takes longer than --help may take.
        lacking = _lacking(error)
        no_memory = isinstance(error, MemoryError) or bool(lacking)
        code = 1 if no_memory else getattr(error, "exit_code", None)
        usage = getattr(error, "format_message", None)
        ours = no_memory or (kind is not None and kind.__module__.startswith(("mirrorskin.", __name__)))
        if not isinstance(code, int) or not (ours or usage):
            return
        if isinstance(error, OutputError) and not str(error):
            sys.exit(code)
        if self.debug:
            traceback.print_exception(error)
        message = usage() if usage else lacking or str(error)
        if no_memory:
            message = f"not enough memory{message and f' ({message})'}: {_LESS}"
        if kind is not None and kind.__name__ == _HELP:
            sys.stderr.write(f"{message}\n")
        else:
            from mirrorskin.cli.output import printable

            sys.stderr.write(f"mirrorskin: {printable(' '.join(message.split()))}\n")
        sys.exit(code)


def _lacking(error: BaseException | None) -> str:
    """Return a library's line that the system refused memory or a thread; "" if there is none."""
    if not isinstance(error, ImportError | OSError | RuntimeError) or getattr(error, "exit_code", None):
        return ""
    lines = str(error).splitlines()
    return next((line.strip() for line in lines if any(reason in line for reason in _REFUSED)), "")


def _end(number: int, frame: FrameType | None) -> None:
    """End the program by an exception; do not interrupt its clean-up unless the user insists."""
    if not _OneLine.signalled:
        _OneLine.signalled = 128 + number
        if not _OneLine.debug:  # network reads that never finish would be reported when the program ends
            logging.getLogger("asyncio").disabled = True
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        sys.exit(128 + number)
    _OneLine.insisted += 1
    if _OneLine.insisted == 1:
        with suppress(OSError):
            os.write(2, _STOPPING)  # a stream of Python may be in use
    elif _OneLine.insisted == _INSISTS:
        os._exit(128 + number)


@contextmanager
def _restored_handlers(is_program: bool) -> Iterator[Callable[[int, _Handler], None]]:
    """Pass a function that installs the handler of a signal; the previous handlers are restored at the end.

    Ctrl-C then ends the interpreter of a program without a traceback, unless the caller handles it.
    """
    previous: dict[int, Any] = {}

    def install(number: int, handler: _Handler) -> None:
        previous.setdefault(number, signal.getsignal(number))
        signal.signal(number, handler)

    try:
        yield install
    finally:
        if hasattr(signal, "SIGALRM") and signal.SIGALRM in previous:
            signal.setitimer(signal.ITIMER_REAL, 0)  # an alarm under way would meet the previous handler
        for number, handler in previous.items():
            if is_program and handler is signal.default_int_handler:
                handler = signal.SIG_DFL
            if handler is not None:  # one that C code installed cannot be restored
                signal.signal(number, handler)


@contextmanager
def _ended_by_signals(is_program: bool) -> Iterator[None]:
    """Let signals end the program by an exception, so that no file remains half-written.

    Further signals must not interrupt the clean-up: the stage is stopped, files are completed, and threads
    are waited for, because OpenCL aborts a program that ends while it works.
    """
    _OneLine.signalled = _OneLine.insisted = 0
    previous_hook = sys.unraisablehook

    def insist(lost: sys.UnraisableHookArgs) -> None:
        """Raise the exception again if it was lost, as in destructors and callbacks."""
        if not isinstance(lost.exc_value, KeyboardInterrupt | SystemExit) or not hasattr(signal, "setitimer"):
            previous_hook(lost)
            return
        kind, arguments = type(lost.exc_value), lost.exc_value.args

        def again(number: int, frame: object) -> None:
            signal.setitimer(signal.ITIMER_REAL, 0)
            raise kind(*arguments)

        # Alarms go on until one is taken: the first may come just before the program begins to wait.
        install(signal.SIGALRM, again)
        signal.setitimer(signal.ITIMER_REAL, _SOON, _SOON)

    with _restored_handlers(is_program) as install:
        for name in ("SIGTERM", "SIGHUP"):
            if hasattr(signal, name):
                install(getattr(signal, name), _end)
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not where it is ignored
            install(signal.SIGINT, _end)
        sys.unraisablehook = insist
        try:
            yield
        finally:
            sys.unraisablehook = previous_hook


def _complete(instruction: str) -> None:
    """Print a shell's completion script, or the completions of its command line, by an instruction."""
    if shell_complete(app, {}, "mirrorskin", _COMPLETE, instruction):
        raise click.UsageError(
            f"{_COMPLETE}={instruction}: no such instruction. Use bash_source, zsh_source or fish_source"
        )


class OutputError(Exception):
    """Standard output cannot be written: its disk is full, or its reader has ended."""

    exit_code = 1


class _StandardOutput(FileIO):
    """Standard output, with its own exception for errors."""

    def write(self, data: Any) -> int:
        if not data:  # Click tries streams with nothing, which /dev/full refuses
            return 0
        try:
            return super().write(data)
        except OSError as error:
            # Unwritten output is discarded: Python would otherwise report the error once more when it ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            broken = isinstance(error, BrokenPipeError)
            message = "" if broken else f"standard output could not be written: {error.strerror}"
            raise OutputError(message) from error


class _StandardError(FileIO):
    """Standard error; text that cannot be written is dropped: there is no other place to report it."""

    def write(self, data: Any) -> int:
        with suppress(OSError):
            return super().write(data)
        return len(data)


def _guard_streams() -> None:
    """Make standard output and standard error usable if they are closed, full, or no longer read.

    A closed one becomes ``/dev/null``: otherwise the next opened file would get its number.
    """
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)
            mode = "r" if name == "stdin" else "w"
            setattr(sys, name, os.fdopen(descriptor, mode, encoding="utf-8", closefd=False))
    for name, kind in (("stdout", _StandardOutput), ("stderr", _StandardError)):
        stream = getattr(sys, name)
        raw = kind(stream.fileno(), "w", closefd=False)
        guarded = TextIOWrapper(
            raw if stream.write_through else BufferedWriter(raw),  # PYTHONUNBUFFERED
            stream.encoding,
            stream.errors,
            line_buffering=stream.line_buffering,
            write_through=stream.write_through,
        )
        setattr(sys, name, guarded)


def main(*, is_program: bool = False) -> None:
    """Run the command line, or answer a shell that completes one; ``is_program``: the process ends then."""
    words = sys.argv[1:] or ["--help"]
    completion = os.environ.get(_COMPLETE)
    with _ended_by_signals(is_program), _OneLine():
        try:
            if completion:
                _complete(completion)
                sys.exit(0)
            with app.make_context("mirrorskin", words) as context:
                app.invoke(context)
            sys.stdout.flush()
        except click.exceptions.Exit as ended:
            sys.stdout.flush()
            sys.exit(ended.exit_code)
        sys.exit(0)


def program() -> None:
    """Run the command line as a separate program."""
    _guard_streams()
    gc.set_threshold(_GARBAGE, 5, 5)  # the default searches for garbage 20 times as often during imports
    try:
        main(is_program=True)
    finally:
        gc.freeze()  # the interpreter searches all that it leaves for garbage otherwise, for 80 ms


if __name__ == "__main__":
    program()
