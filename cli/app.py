"""``mirrorskin app``: recordings and results in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.stack import RECORDING, stack_options, stack_words


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
    words = stack_words(chosen)
    stack = stack_options(chosen)
    region, frames = stack.pop("region", None), stack.pop("frames", None)
    from mirrorskin.view.app import Opening
    from mirrorskin.view.app.page import pages
    from mirrorskin.view.app.session import Session

    opening = Opening(stack, words, calibration, device, operation or "", region, frames)
    for path in files:  # refused before a browser is opened
        Session(path, opening).close()
    server = AppServer(pages(files, opening), port or 0)
    click.echo(server.address)
    try:
        server.run(browser=not no_browser)
    except KeyboardInterrupt:
        click.echo("ended", err=True)
