"""Options of the twin that several commands share, worded once."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, cast

from mirrorskin.cli.groups import Option

if TYPE_CHECKING:
    from mirrorskin.hw.twin import SheetTexture
    from mirrorskin.hw.twin import TextureName as Kind


class ContactName(StrEnum):
    """How the sheet lies on the object."""

    conform = "conform"
    elastic = "elastic"


class OpticsName(StrEnum):
    """How the light of a slope is found."""

    ideal = "ideal"
    cylinder = "cylinder"


class TextureName(StrEnum):
    """What can be seen of the sheet itself."""

    none = "none"
    flakes = "flakes"
    dots = "dots"
    random_dots = "random-dots"


Size = Annotated[str, Option(metavar="WxH", help="Pixels across and down.")]
PixelSize = Annotated[str, Option(metavar="LENGTH[,LENGTH]", help="Size of a pixel.")]
Contact = Annotated[ContactName, Option(help="The sheet takes the object's shape (eq. 1), or resists.")]
Texture = Annotated[
    TextureName, Option(help="Flakes of the mirror coat, or printed dots: they move with the skin.")
]
TextureSize = Annotated[str, Option(metavar="LENGTH", help="Width of a flake, or diameter of a dot.")]
TextureContrast = Annotated[float, Option(help="Share of the light that flakes or dots take at most.")]
Optics = Annotated[OpticsName, Option(help="Light goes by the zenith alone, or is traced to the wall.")]


def sheet_texture(kind: TextureName, size: str, contrast: float) -> SheetTexture | None:
    """Return the texture that options describe."""
    from mirrorskin.cli.quantity import length
    from mirrorskin.hw.twin import SheetTexture

    if kind is TextureName.none:
        return None
    return SheetTexture(cast("Kind", kind.value), length(size, "--texture-size"), contrast)
