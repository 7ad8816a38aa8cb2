"""Options of the twin that several commands share, worded once."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer


class ContactName(StrEnum):
    """How the sheet lies on the object."""

    conform = "conform"
    elastic = "elastic"


class OpticsName(StrEnum):
    """How the light of a slope is found."""

    ideal = "ideal"
    cylinder = "cylinder"


Size = Annotated[str, typer.Option(metavar="WxH", help="Pixels across and down.")]
PixelSize = Annotated[str, typer.Option(metavar="LENGTH[,LENGTH]", help="Size of a pixel.")]
Contact = Annotated[ContactName, typer.Option(help="The sheet takes the object's shape (eq. 1), or resists.")]
Optics = Annotated[OpticsName, typer.Option(help="Light goes by the zenith alone, or is traced to the wall.")]
