"""``mirrorskin app``: recordings and results in the browser."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.defaults import calibration_of, with_pixel_size
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import RECORDING, stack_options, stack_words

if TYPE_CHECKING:
    from mirrorskin.view.app import Opening

_ENDING = "SIGINT", "SIGTERM", "SIGHUP"
_LIFETIME = 1000
"""Milliseconds after which a rig is stopped if its page was closed or lost its connection."""


def command(
    files: Annotated[
        list[Path] | None, Argument(metavar="FILE", help="Recordings and results.", required=False)
    ] = None,
    rig: Annotated[
        Path | None,
        Option(
            "--rig",
            metavar="RIG.toml",
            help="Rig to drive: live picture, moves by hand, runs. Nothing moves before 'Connect'.",
        ),
    ] = None,
    calibration: options.Calibration = None,
    device: options.Devices = None,
    operation: Annotated[
        str | None,
        Option(
            metavar="MODULE:CLASS", help="Operation to begin with, and of a rig's runs, such as your own."
        ),
    ] = None,
    port: Annotated[
        int | None,
        Option(metavar="N", min=1, max=65535, help="Port to listen on.", show_default="any free one"),
    ] = None,
    no_browser: Annotated[
        bool, Option("--no-browser", help="Only print the address; open it in a browser of this machine.")
    ] = False,
    **chosen: Annotated[Any, RECORDING],
) -> None:
    """Show recordings and results in the browser: click, change options, measure, save. Ctrl-C ends it.

    The page opens files of the folder in which it is started, and files that are dropped on it. It listens on
    this machine only, at an address that contains a secret.
    """
    from mirrorskin.view.app.server import AppServer, StopServer, check_app

    check_app()
    openings = [
        _opening(path, calibration, device, operation, dict(chosen), read=number == 0)
        for number, path in enumerate(files or ())
    ]
    with ExitStack() as stack:
        control = None
        if rig is not None:
            from mirrorskin.engine.base.reconstruction import load_operation
            from mirrorskin.hw.base.rig_file import load_rig
            from mirrorskin.view.app.rig_control import RigControl

            kind = None if operation is None else load_operation(operation)
            control = RigControl(load_rig(rig), operation=kind)
            stack.callback(control.close)
            stop = stack.enter_context(closing(StopServer(control.stop)))
            control.stop_address = stop.address
        from mirrorskin.view.app.page import pages

        lifetime = {} if control is None else {"lifetime": _LIFETIME}
        drops = Path(
            stack.enter_context(TemporaryDirectory(prefix="mirrorskin-", ignore_cleanup_errors=True))
        )
        page = stack.enter_context(pages(files or (), openings, control, Path.cwd(), drops))
        server = AppServer(page, port or 0, drops=drops, **lifetime)
        click.echo(server.address)
        try:
            with _ended_by_signals(server.stop):
                server.run(browser=not no_browser)
        except KeyboardInterrupt:
            click.echo("ended", err=True)


@contextmanager
def _ended_by_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Let signals stop the server, and handle them as usual when it has ended.

    An exception in the middle of what the server does could be lost there.
    """
    numbers = [getattr(signal, name) for name in _ENDING if hasattr(signal, name)]
    usual = {number: handler for number in numbers if callable(handler := signal.getsignal(number))}
    received: list[int] = []

    def handle(number: int, _: FrameType | None) -> None:
        received.append(number)
        stop()

    for number in usual:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)
    if received:
        usual[received[0]](received[0], None)


def _opening(
    path: Path,
    calibration: Path | None,
    device: str | None,
    operation: str | None,
    chosen: dict[str, Any],
    read: bool,
) -> Opening:
    """Return how to open a file; it is opened once, so that faults are reported first.

    Of several results, the first one is read, and each of the others when it is chosen.
    """
    from mirrorskin import io
    from mirrorskin.view.app.session import Opening, holds_result

    if holds_result(path):
        if read:
            io.open_result(path)
        return Opening()
    values = dict(chosen)
    stack: dict[str, Any] = {**stack_options(chosen)}
    part = {name: stack.pop(name, None) for name in ("region", "frames")}
    with io.open_recording(path, **stack, **part) as recording:
        if recording.header.pixel_size is None:
            size = with_pixel_size(recording).header.pixel_size
            if size is not None:
                stack["pixel_size"] = values["pixel_size"] = size
        calibration = calibration_of(recording, calibration)
    return Opening(stack, stack_words(values), calibration, device, operation or "", **part)
