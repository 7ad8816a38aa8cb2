"""Options of the twin that several commands share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mirrorskin.cli.declared import Terms, term

_OBJECT = (
    "sphere, cone, cylinder, plane, step, texture, coin, or a file: heights in NPY, PNG or TIFF, or a mesh in"
    " STL, PLY or OBJ"
)


def sensor_terms(size: str, pixel_size: str) -> Terms:
    """Return the options of a sensor and its object, with these defaults."""
    return Terms(
        [
            term("object", _OBJECT, "NAME", "sphere", kind="name"),
            term("size", "pixels across and down", "WxH", size),
            term("pixel_size", "size of a pixel", "mm,mm", pixel_size),
            term(
                "contact",
                "the sheet takes the object's shape (eq. 1), or resists",
                default="conform",
                choices=("conform", "elastic"),
            ),
            term(
                "optics",
                "light depends on the zenith alone, or is traced to the wall",
                default="ideal",
                choices=("ideal", "cylinder"),
            ),
            term(
                "pattern",
                "wall: uniform, for presses; linear in the zenith, for rotations; or a picture",
                "NAME",
                "uniform",
                kind="name",
            ),
            term(
                "texture",
                "flakes of the mirror coat, or printed dots, which move with the skin",
                default="none",
                choices=("none", "flakes", "dots", "random-dots"),
            ),
            term("texture_size", "width of a flake, or diameter of a dot", "mm", "0.1mm"),
            term("texture_contrast", "greatest share of the light that flakes or dots take", "", "0.5"),
        ]
    )


def sensor_options(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keywords of `mirrorskin.hw.Twin` that these options describe."""
    from mirrorskin.twin import SheetTexture

    columns, rows = values["size"]
    texture = None
    if values["texture"] != "none":
        texture = SheetTexture(values["texture"], values["texture_size"], values["texture_contrast"])
    names = ("pixel_size", "contact", "optics", "pattern")
    return {"shape": (rows, columns), "texture": texture, **{name: values[name] for name in names}}
