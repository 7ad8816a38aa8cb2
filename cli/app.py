"""``mirrorskin app``: recordings and results in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.defaults import calibration_of, with_pixel_size
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import RECORDING, stack_options, stack_words

if TYPE_CHECKING:
    from mirrorskin.view.app import Opening


def command(
    files: Annotated[list[Path], Argument(metavar="FILE", help="Recordings and results.")],
    calibration: options.Calibration = None,
    device: options.Devices = None,
    operation: Annotated[
        str | None,
        Option(metavar="MODULE:CLASS", help="Operation to begin with, such as your own."),
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

    It listens on this machine only, at an address that contains a secret.
    """
    from mirrorskin.view.app.server import AppServer, check_app

    check_app()
    from mirrorskin.view.app.page import pages

    openings = [_opening(path, calibration, device, operation, dict(chosen)) for path in files]
    server = AppServer(pages(files, openings), port or 0)
    click.echo(server.address)
    try:
        server.run(browser=not no_browser)
    except KeyboardInterrupt:
        click.echo("ended", err=True)


def _opening(
    path: Path, calibration: Path | None, device: str | None, operation: str | None, chosen: dict[str, Any]
) -> Opening:
    """Return how a file is opened; it is opened once, so that faults are reported before anything else."""
    from mirrorskin import io
    from mirrorskin.view.app.session import Opening, holds_result

    if holds_result(path):
        io.open_result(path)
        return Opening()
    given = dict(chosen)
    stack: dict[str, Any] = {**stack_options(chosen)}
    part = {name: stack.pop(name, None) for name in ("region", "frames")}
    with io.open_recording(path, **stack, **part) as recording:
        if recording.header.pixel_size is None:
            size = with_pixel_size(recording).header.pixel_size
            if size is not None:
                stack["pixel_size"] = given["pixel_size"] = size
        calibration = calibration_of(recording, calibration)
    return Opening(stack, stack_words(given), calibration, device, operation or "", **part)
