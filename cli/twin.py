"""``mirrorskin twin serve``: a rig for anyone to try, without hardware."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import click

from mirrorskin.cli import options, sensor
from mirrorskin.cli.groups import Group, Option

_LOOK = 0.2  # seconds from one look whether all is well to the next
_PRESS = "vertical --stop 1.5mm --speed 0.5mm/s"
_TURN = "axial --press 1mm --rate 0.5"  # which needs the zenith's scale
_SIDEWAYS = (
    "horizontal --press 1mm --distance 0.5mm --step 0.1mm",
    "twist --press 1mm --angle 10deg --step 2deg",
)

app = Group(help="Emulate a whole rig: its stage and its camera.", no_args_is_help=True)


@app.add
def serve(
    output: Annotated[
        Path, Option("--output", "-o", metavar="DIR", help="Where to write the rig file.")
    ] = Path("emulated-rig"),
    thing: Annotated[
        str,
        Option(
            "--object", metavar="NAME", or_file=True, help="What to press on, as in 'mirrorskin simulate'."
        ),
    ] = "sphere",
    size: sensor.Size = "320x240",
    pixel_size: sensor.PixelSize = "0.04mm",
    pattern: Annotated[
        str,
        Option(
            metavar="NAME",
            or_file=True,
            help="Of the wall: uniform, for presses; linear, for rotations; or a picture.",
        ),
    ] = "uniform",
    contact: sensor.Contact = sensor.ContactName.conform,
    optics: sensor.Optics = sensor.OpticsName.ideal,
    texture: sensor.Texture = sensor.TextureName.none,
    texture_size: sensor.TextureSize = "0.1mm",
    texture_contrast: sensor.TextureContrast = 0.5,
    rate: Annotated[float, Option(metavar="HZ", help="Frames a second.")] = 20.0,
    delay: Annotated[str, Option(metavar="TIME", help="From a frame's exposure to its sending.")] = "50ms",
    jitter: Annotated[str, Option(metavar="TIME", help="Of that delay, one sigma.")] = "0s",
    seed: Annotated[int, Option(help="Of noise and jitter.")] = 0,
    device: options.Device = None,
) -> None:
    """Run an emulated rig: a stage behind a serial port, and the twin as its camera, until Ctrl-C."""
    from mirrorskin.cli.quantity import duration, frame_size, lengths
    from mirrorskin.hw.emulator.rig import EmulatedRig

    columns, rows = frame_size(size, "--size")
    rig = EmulatedRig(
        thing,
        shape=(rows, columns),
        pixel_size=lengths(pixel_size, "--pixel-size"),
        pattern=pattern,
        contact=contact.value,
        optics=optics.value,
        texture=sensor.sheet_texture(texture, texture_size, texture_contrast),
        rate=rate,
        delay=duration(delay, "--delay"),
        jitter=duration(jitter, "--jitter"),
        seed=seed,
        home=True,
        device=device,
    )
    with rig, rig.serve() as server:
        path = rig.write(output, server.url)
        what = f"{thing} under {columns} x {rows} pixels at {rate:g} frames a second"
        click.echo(f"{path}: {what}; stage at {rig.port.url}, camera at {server.url}")
        scale = rig.settings.camera.zenith_gain
        click.echo(_tell(path, [_PRESS] if scale is None else [_PRESS, _TURN]))
        try:
            while rig.camera.error is None:
                time.sleep(_LOOK)
            raise rig.camera.error
        except KeyboardInterrupt:
            click.echo("the rig has ended")


def _tell(rig: Path, movements: list[str]) -> str:
    """Say what can be tried."""
    said = ["in another terminal, try", f"  mirrorskin rig check {rig}"]
    for movement in movements:
        name = movement.split()[0]
        said += [
            f"  mirrorskin capture {movement} --rig {rig} -o {name}.h5",
            f"  mirrorskin reconstruct {name}.h5",
            f"  mirrorskin live {movement} --rig {rig}",
        ]
    for movement in _SIDEWAYS:
        said.append(f"  mirrorskin capture {movement} --rig {rig} -o {movement.split()[0]}.h5")
    return "\n".join([*said, "Ctrl-C ends the rig"])
