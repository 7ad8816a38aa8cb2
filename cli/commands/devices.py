"""``mirrorskin devices``: the OpenCL devices of this machine."""

from __future__ import annotations

import click

from mirrorskin.cli import options
from mirrorskin.cli.output import print_json, print_table


def command(as_json: options.Json = False) -> None:
    """List the OpenCL devices of this machine."""
    from mirrorskin.kernels.device import list_devices, open_device

    chosen = open_device().info
    devices = list_devices()
    default = devices.index(chosen)
    if as_json:
        print_json({"devices": devices, "default": default})
        return
    rows = [
        [
            "*" if number == default else "",
            str(number),
            device.kind,
            device.title,
            device.driver,
            f"{device.compute_units}",
            f"{device.memory / 1e9:.1f} GB",
            device.note,
        ]
        for number, device in enumerate(devices)
    ]
    print_table(["", "number", "kind", "name", "driver", "units", "memory", "note"], rows)
    click.echo("* is the default; choose another with --device NUMBER or a part of its name")
