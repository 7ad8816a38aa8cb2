"""TIFF of 16 bits, with its scale."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO

from mirrorskin.io.export.counts import Counts
from mirrorskin.io.export.notes import SOFTWARE

_CENTIMETRE = 10.0  # mm
_NO_DATA = 42113  # the tag by which GDAL names the value of holes


def tiff(counts: Counts, notes: Mapping[str, str]) -> list[bytes]:
    """Encode heights as a grey picture.

    Its resolution is told in pixels a centimetre, holes by GDAL's tag, and the scale of heights in a
    description of lines that ImageJ reads, so that it shows millimetres.

    Parameters
    ----------
    counts : Counts
    notes : mapping of str
        More lines of the description.

    Returns
    -------
    list of bytes
        The file's parts.
    """
    import tifffile

    width, height = counts.pixel_size
    file = BytesIO()
    tifffile.imwrite(
        file,
        counts.values,
        photometric="minisblack",
        resolution=(_CENTIMETRE / width, _CENTIMETRE / height),
        resolutionunit="CENTIMETER",
        description=_description(counts, notes).encode(),
        software=notes.get(SOFTWARE, ""),
        metadata=None,
        extratags=[(_NO_DATA, "s", 0, "0", True)],
    )
    return [file.getvalue()]


def _description(counts: Counts, notes: Mapping[str, str]) -> str:
    (width, height), (x, y) = counts.pixel_size, counts.first
    lines: dict[str, object] = {
        "ImageJ": "1.54",
        "unit": "cm",  # of the resolution
        "xorigin": -x / width,
        "yorigin": y / height,
        "inverty": "true",
        "cf": 0,  # heights are a straight line of counts: c0 + c1 x count
        "c0": counts.offset,
        "c1": counts.step,
        "vunit": "mm",
        "min": 1,
        "max": int(counts.values.max()),
        "scale": counts,
    }
    lines |= {name: said.replace("\\", r"\\") for name, said in notes.items()}  # which begins an escape
    return "".join(f"{name}={said}\n" for name, said in lines.items())
