"""PNG of 16 bits, with its scale."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from io import BytesIO

from mirrorskin.io.export.counts import Counts
from mirrorskin.io.export.notes import DATE, SOFTWARE, SOURCE

_KEYWORDS = {SOURCE: "Title", DATE: "Creation Time", SOFTWARE: "Software"}
_INCH = 25.4  # mm
_METRE = 1e-3  # m a mm


def png(counts: Counts, notes: Mapping[str, str]) -> list[bytes]:
    """Encode heights as a grey picture.

    Its resolution is told in pixels a metre, and the scale of heights in texts: for people, in numbers, and
    under the keys that Gwyddion documents for pictures of 16 bits.

    Parameters
    ----------
    counts : Counts
    notes : mapping of str
        More texts.

    Returns
    -------
    list of bytes
        The file's parts.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    texts = PngInfo()
    for name, said in (*_texts(counts, notes), *_gwyddion(counts, notes.get(SOURCE, "height"))):
        texts.add_text(name, said)
    width, height = counts.pixel_size
    file = BytesIO()
    Image.fromarray(counts.values).save(file, "png", pnginfo=texts, dpi=(_INCH / width, _INCH / height))
    return [file.getvalue()]


def _texts(counts: Counts, notes: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    yield "Description", str(counts)
    yield "height offset", f"{counts.offset!r} mm"
    yield "height step", f"{counts.step!r} mm"
    yield "pixel size", " ".join(f"{size!r}" for size in counts.pixel_size) + " mm"
    for name, said in notes.items():
        yield _KEYWORDS.get(name, name), said


def _gwyddion(counts: Counts, title: str) -> Iterator[tuple[str, str]]:
    """Yield lengths in metres, with y down the picture."""
    rows, columns = counts.values.shape
    (width, height), (x, y) = counts.pixel_size, counts.first
    lengths = {
        "XReal": columns * width,
        "YReal": rows * height,
        "XOffset": x - width / 2,
        "YOffset": -y - height / 2,
        "ZMin": counts.offset,
        "ZMax": counts.highest,
    }
    for name, length in lengths.items():
        yield f"Gwy::{name}", repr(length * _METRE)
    for name in ("XYUnit", "ZUnit"):
        yield f"Gwy::{name}", "m"  # as its source has them
        yield f"Gwy::{name}s", "m"  # as its guide has them
    yield "Gwy::Title", title
