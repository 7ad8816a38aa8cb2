"""``mirrorskin twin serve``: an emulated rig that needs no hardware."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.commands.sensor import sensor_options, sensor_terms
from mirrorskin.cli.declared import Terms, term
from mirrorskin.cli.groups import Group, Option

_LOOK = 0.2  # seconds between checks of the camera
_LOG = "twin.log"
_PRESS = "vertical --stop 1.5mm --speed 0.5mm/s"
_TURN = "axial --press 1mm --rate 0.5"  # which needs the zenith's scale
_SIDEWAYS = (
    "horizontal --press 1mm --distance 0.5mm --step 0.1mm",
    "twist --press 1mm --angle 10deg --step 2deg",
)

RIG = Terms(
    [
        *sensor_terms("320x240", "0.04mm").terms,
        term("rate", "frames a second", "Hz", "20"),
        term("delay", "time from a frame's exposure to its sending", "s", "50ms"),
        term("jitter", "jitter of that delay, one sigma", "s", "0s"),
        term("seed", "seed of noise and jitter", "", "0", kind="integer"),
    ]
)

app = Group(help="Emulate a whole rig: its stage and its camera.", no_args_is_help=True)


@app.add
def serve(
    output: Annotated[
        Path, Option("--output", "-o", metavar="DIR", help="Folder for the rig file, rig.toml.")
    ] = Path("emulated-rig"),
    device: options.Device = None,
    background: Annotated[
        bool,
        Option(
            "--background", help=f"Return when the rig is ready and keep it running; it logs to DIR/{_LOG}."
        ),
    ] = False,
    ready: Annotated[int | None, Option("--ready-fd", hidden=True)] = None,
    **chosen: Annotated[Any, RIG],
) -> None:
    """Run an emulated rig: a stage behind a serial port, with the twin as its camera.

    DIR/rig.toml appears when the rig is ready and is removed when the rig ends. Ctrl-C ends it, or with
    --background 'kill' and the process id that is printed.
    """
    if background and ready is None:
        _start_in_background()
        return
    from mirrorskin.twin.emulator.rig import EmulatedRig

    values = RIG.filled(chosen)
    EmulatedRig.check_folder(output)
    times = {name: values[name] for name in ("rate", "delay", "jitter", "seed")}
    rig = EmulatedRig(values["object"], **sensor_options(values), **times, home=True, device=device)
    with rig, rig.serve() as server:
        path = rig.write(output, server.controlled_url)
        columns, rows = values["size"]
        what = f"{values['object']} under {columns} x {rows} pixels at {values['rate']:g} frames a second"
        click.echo(f"{path}: {what}; stage at {rig.port.url}, camera at {server.url}")
        if ready is None:
            scale = rig.settings.camera.zenith_gain
            click.echo(_suggestions(path, [_PRESS] if scale is None else [_PRESS, _TURN]))
        else:
            log = output / _LOG
            click.echo(f"running as process {os.getpid()}, log in {log}; end it with 'kill {os.getpid()}'")
            _detach(log, ready)
        try:
            while rig.camera.error is None:
                time.sleep(_LOOK)
            raise rig.camera.error
        except KeyboardInterrupt:
            click.echo("the rig has ended")


def _start_in_background() -> None:
    """Run this command in a separate session; return when it is ready, or exit with its code."""
    from mirrorskin.hw.base.errors import HardwareError

    reading, writing = os.pipe()
    words = [sys.executable, "-P", "-m", "mirrorskin.cli.main", *sys.argv[1:], "--ready-fd", str(writing)]
    with os.fdopen(reading, "rb") as pipe:
        try:
            child = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, pass_fds=(writing,), start_new_session=True
            )
        finally:
            os.close(writing)
        try:
            ready = pipe.read(1)
        except BaseException:
            child.terminate()
            child.wait()
            raise
    if ready:
        return
    code = child.wait()
    if code < 0:
        raise HardwareError(f"twin serve: signal {-code} ended the rig before it was ready. Start it again")
    raise click.exceptions.Exit(code or 1)


def _detach(log: Path, ready: int) -> None:
    """Send further output to a log, and report to the waiting parent that the rig is ready."""
    from mirrorskin.io.base.system import translate_os_errors

    sys.stdout.flush()
    with (
        translate_os_errors(f"{log} cannot be written", "choose another folder with -o"),
        log.open("ab") as file,
    ):
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.write(ready, b"1")
    os.close(ready)


def _suggestions(rig: Path, movements: list[str]) -> str:
    """List commands to try."""
    lines = ["in another terminal, try", f"  mirrorskin rig check {rig}"]
    for movement in movements:
        name = movement.split()[0]
        lines += [
            f"  mirrorskin capture {movement} --rig {rig} -o {name}.h5",
            f"  mirrorskin reconstruct {name}.h5",
            f"  mirrorskin live {movement} --rig {rig}",
        ]
    for movement in _SIDEWAYS:
        lines.append(f"  mirrorskin capture {movement} --rig {rig} -o {movement.split()[0]}.h5")
    return "\n".join([*lines, "Ctrl-C ends the rig"])
