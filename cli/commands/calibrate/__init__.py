"""``mirrorskin calibrate``: from brightness to degrees and from pixels to millimetres."""

from __future__ import annotations

from collections.abc import Callable

from mirrorskin.cli.commands.calibrate import (
    check,
    elastic,
    force,
    references,
    scale,
    self_,
    show,
    tilt,
    zenith,
)
from mirrorskin.cli.groups import Group

app = Group(
    help="Calibrate brightness, scale, tilt and elasticity of a sensor.\n\n"
    "The order is references, scale, zenith, tilt, elastic, force; each adds its part to the same calibration"
    " file, and leaves out what the sensor does not need. 'self' needs no known object. Then 'check' measures"
    " the errors that remain.",
    no_args_is_help=True,
)

_COMMANDS: dict[str, Callable[..., None]] = {
    "references": references.command,
    "board": scale.board_command,
    "scale": scale.command,
    "zenith": zenith.command,
    "tilt": tilt.command,
    "elastic": elastic.command,
    "force": force.command,
    "self": self_.command,
    "check": check.command,
    "show": show.command,
}
for name, command in _COMMANDS.items():
    app.add(command, name)
