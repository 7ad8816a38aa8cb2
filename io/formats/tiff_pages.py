"""Pages of a TIFF that its metadata describe, compared with those that it contains."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.text import one_line, shortened
from mirrorskin.io.base.types import InputError

_AXES = "TZC"
_MICROMETRE = ("micron", "um", "\\u00B5m")  # as ImageJ writes it
_MOST_DIGITS = 9  # of a number of pages


@dataclass(frozen=True)
class Described:
    """What the metadata of ImageJ, OME or tifffile describe.

    Attributes
    ----------
    by : str
        Whose metadata they are.
    frames : int
        Number of pictures.
    axes : tuple of str
        Axes of pages that are longer than 1, such as ``("T", "C")``.
    files : tuple of str
        The files of OME that contain the pictures; empty if they are not named.
    """

    by: str
    frames: int
    axes: tuple[str, ...]
    files: tuple[str, ...] = ()


def pictures_in(series: Any) -> int:
    """Return the number of pictures in a series, present or not."""
    return int(series.size) // max(1, int(series.keyframe.size))


def in_one_piece(series: Any, pages: Any) -> bool:
    """Return whether the first of a file's pages stands for all pictures of a series, without gaps."""
    count, first = pictures_in(series), series.pages[0]
    if not len(series.pages) == 1 < count:
        return False
    places = [page.dataoffsets[0] for page in pages[first.index + 1 : first.index + 2] if page.dataoffsets]
    return not places or not first.dataoffsets[0] < places[0] < first.dataoffsets[0] + count * first.nbytes


def described_pages(file: Any, path: Path) -> Described | None:
    """Return what the metadata of an open TIFF describe; None if they describe no pages.

    InputError for planes of OME beyond its size.
    """
    if file.is_ome and file.ome_metadata:
        return _described_by_ome(file.ome_metadata, path)
    if file.is_imagej and file.imagej_metadata:
        sizes = {axis: _count(file.imagej_metadata.get(name)) for axis, name in _IMAGEJ.items()}
        frames = math.prod(sizes.values())
        frames = frames if frames > 1 else _count(file.imagej_metadata.get("images"))
        axes = tuple(axis for axis, count in sizes.items() if count > 1)
        return Described("ImageJ", frames, axes)
    shapes = [part.get("shape") for part in file.shaped_metadata or ()]
    if len(shapes) == 1 and isinstance(shapes[0], list | tuple):
        lengths = [_count(length) for length in shapes[0]]
        page = file.pages.first
        frames = math.prod(lengths) // max(1, page.imagelength * page.imagewidth * page.samplesperpixel)
        return Described("tifffile", max(1, frames), ())
    return None


_IMAGEJ = {"T": "frames", "Z": "slices", "C": "channels"}


def _count(value: Any) -> int:
    return value if isinstance(value, int) and value > 0 else 1


def _described_by_ome(text: str, path: Path) -> Described | None:
    """Return the planes of the only image of OME; None if it has several, or cannot be read."""
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return None
    images = [element for element in root.iter() if _tag(element) == "Pixels"]
    for pixels in images:
        _check_planes(pixels, path)
    if len(images) != 1:
        return None
    (pixels,) = images
    sizes = {axis: _number(pixels, f"Size{axis}", 1) for axis in _AXES}
    samples = max(
        (_number(part, "SamplesPerPixel", 1) for part in pixels.iter() if _tag(part) == "Channel"), default=1
    )
    sizes["C"] = max(1, sizes["C"] // max(1, samples))
    names = (part.get("FileName", "") for part in pixels.iter() if _tag(part) == "UUID")
    files = tuple(dict.fromkeys(one_line(name) for name in names if name))
    return Described(
        "OME", math.prod(sizes.values()), tuple(axis for axis, n in sizes.items() if n > 1), files
    )


def _check_planes(pixels: Any, path: Path) -> None:
    """Raise InputError for planes whose index is not below the size that is stated."""
    planes = [part for part in pixels if _tag(part) == "TiffData"]
    for axis in _AXES:
        size = _number(pixels, f"Size{axis}", 1)
        beyond = [plane for plane in planes if _number(plane, f"First{axis}", 0) >= size]
        if beyond:
            first = _number(beyond[0], f"First{axis}", 0)
            raise InputError(
                f"{path}: of the {len(planes)} planes that its OME metadata list, {len(beyond)} have a {axis}"
                f" beyond the size, such as First{axis}={first} where Size{axis}={size}: correct them in its"
                " ImageDescription, or save it again"
            )


def _tag(element: Any) -> str:
    return str(element.tag).rpartition("}")[2]


def _number(element: Any, name: str, default: int) -> int:
    text = element.get(name, "")
    return int(text) if text.isdecimal() and len(text) <= _MOST_DIGITS else default


def compare_pages(described: Described, present: int, path: Path) -> Finding | None:
    """Return the finding for a number of pictures that differs from the one described; None if they agree.

    InputError if the order of what is present is unknown.
    """
    if described.frames == present:
        return None
    stated = f"its metadata ({described.by}) state {described.frames} pictures, and it contains {present}"
    others = [name for name in described.files if name != path.name]
    if others and present < described.frames:
        stated += f"; others are in {shortened(', '.join(others), 100)}"
    order = [axis for axis in described.axes if axis in _AXES]
    if len(order) > 1 or "C" in order:
        raise InputError(
            f"{path}: {stated}: their order along the axes {', '.join(order)} is unknown; save it again with"
            " the pictures that there are"
        )
    if present > described.frames:
        return Finding("number of frames", f"{stated}: all are read, in their order")
    remedy = "join the files" if others else "if that is too few, copy or record it again"
    return Finding("number of frames", f"{stated}: these are read; {remedy}")


def pixel_size(file: Any) -> str:
    """Return the pixel size in the metadata of ImageJ or OME, as text."""
    if file.is_ome and file.ome_metadata:
        pixel_sizes = re.findall('PhysicalSize([XY])="([0-9.eE+-]{1,20})"', file.ome_metadata)
        sizes, unit = dict(pixel_sizes), re.search('PhysicalSizeXUnit="([^"]{1,9})"', file.ome_metadata)
        if {"X", "Y"} <= sizes.keys():
            return f"{sizes['X']} x {sizes['Y']} {unit[1] if unit else 'µm'}"
    if file.is_imagej and file.imagej_metadata:
        name = str(file.imagej_metadata.get("unit", ""))
        tags = [file.pages.first.tags.get(code) for code in (282, 283)]
        if name not in ("", "pixel", "pixels") and all(tag is not None and tag.value[0] for tag in tags):
            x, y = (tag.value[1] / tag.value[0] for tag in tags)
            return f"{x:.4g} x {y:.4g} {'µm' if name in _MICROMETRE else name}"
    return ""
