"""The pictures of a page, inside the page."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Result
from mirrorskin.view.report.words import PICTURES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Ends = tuple[tuple[float, float], tuple[float, float]]
"""Of a cross-section: x and y of both, mm."""

FINENESS = 200
"""Pixels in an inch of a figure."""
MOST_BYTES = 400_000
"""Of a picture: seven of them and a surface stay below 5 MB, in letters."""

_QUALITIES = 90, 60  # of WebP, for pictures of noise, which PNG cannot pack
_TWO = 8.0  # inches from which on a figure is one of two maps
_BORDER = 20  # pixels that are left above and below
_WHITE = 250  # and above is paper

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture, and what is said of it.

    Attributes
    ----------
    caption, alt : str
    source : str
        The picture itself, as an address.
    width, height : int
        Pixels.
    wide : bool
        Whether it needs the room of two.
    """

    caption: str
    alt: str
    source: str
    width: int
    height: int
    wide: bool


def pictures_of(result: Result, name: str, section: Ends | None) -> list[Picture]:
    """Draw all figures that a result has.

    Raises
    ------
    mirrorskin.io.InputError
        There is a section, and no pixel size to place it by.
    """
    from mirrorskin.view.result import figures_of, png_of

    figures = figures_of(result, name=name, section=section)
    pictures = []
    for which, figure in figures.items():
        width = figure.get_figwidth()
        png = png_of(_untitled(figure), round(FINENESS * width))
        pictures.append(_picture(which, png, wide=width > _TWO))
    return pictures


def _untitled(figure: Figure) -> Figure:
    """Hide a figure's title, which is the page's own."""
    for text in figure.texts:
        text.set_visible(False)
        text.set_in_layout(False)
    return figure


def _picture(name: str, png: bytes, wide: bool) -> Picture:
    pixels = _trimmed(np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR), np.uint8))
    caption, alt = PICTURES[name]
    kind, data = packed(pixels)
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
    return Picture(caption, alt, source, pixels.shape[1], pixels.shape[0], wide)


def _trimmed(pixels: Pixels) -> Pixels:
    """Leave a border of paper above and below, and no more."""
    (drawn,) = np.nonzero(np.any(pixels < _WHITE, axis=(1, 2)))
    if not drawn.size:
        return pixels
    return pixels[max(drawn[0] - _BORDER, 0) : drawn[-1] + 1 + _BORDER]


def packed(pixels: Pixels) -> tuple[str, bytes]:
    """Pack a picture into at most ``MOST_BYTES``: as it is if it can be, else nearly, else smaller.

    Parameters
    ----------
    pixels : ndarray, (H, W, 3), uint8
        Blue, green and red.

    Returns
    -------
    kind : {"png", "webp"}
    data : bytes
    """
    png = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 6])[1].tobytes()
    if len(png) <= MOST_BYTES:
        return "png", png
    for quality in _QUALITIES:
        webp = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
        if len(webp) <= MOST_BYTES:
            return "webp", webp
    return packed(
        np.asarray(cv2.resize(pixels, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
    )
