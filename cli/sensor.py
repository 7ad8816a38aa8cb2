"""Options of the twin that several commands share, worded once."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from mirrorskin.cli.groups import Option


class ContactName(StrEnum):
    """How the sheet lies on the object."""

    conform = "conform"
    elastic = "elastic"


class OpticsName(StrEnum):
    """How the light of a slope is found."""

    ideal = "ideal"
    cylinder = "cylinder"


Size = Annotated[str, Option(metavar="WxH", help="Pixels across and down.")]
PixelSize = Annotated[str, Option(metavar="LENGTH[,LENGTH]", help="Size of a pixel.")]
Contact = Annotated[ContactName, Option(help="The sheet takes the object's shape (eq. 1), or resists.")]
Optics = Annotated[OpticsName, Option(help="Light goes by the zenith alone, or is traced to the wall.")]
