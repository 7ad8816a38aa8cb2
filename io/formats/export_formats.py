"""The formats of exports, each declared once: suffix, content, encoder, options, and the package it needs.

To add one, write a function that encodes a result, and add an entry to `FORMATS`.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """A format that a result can be exported to.

    Attributes
    ----------
    kind : str
        Content, for the help of the command; formats of the same kind are listed together.
    encoder : str
        ``module:function`` below `mirrorskin.io`; the function takes the result and the options, and returns
        the parts of the file and a description. With ``writes_itself`` it also takes the path, and returns
        only the description.
    options : tuple of str
        Options of ``export_result`` that apply.
    package, extra : str
        Package that is imported when the format is used, and the extra that installs it; "" without.
    needs_heights : bool
        Whether heights in millimetres are needed.
    writes_itself : bool
        Whether the function writes the file.
    """

    kind: str
    encoder: str
    options: tuple[str, ...] = ()
    package: str = ""
    extra: str = ""
    needs_heights: bool = True
    writes_itself: bool = False


_TIFF = ExportFormat("heights in 16 bits", "formats.export:encode_tiff", ("float32", "map_name"))

FORMATS: dict[str, ExportFormat] = {
    ".ply": ExportFormat("a mesh", "formats.export:encode_ply", ("points",)),
    ".stl": ExportFormat("a mesh", "formats.export:encode_stl"),
    ".obj": ExportFormat("a mesh", "formats.export:encode_obj"),
    ".xyz": ExportFormat("points", "formats.export:encode_xyz"),
    ".x3p": ExportFormat("a surface", "formats.topography:encode_x3p", package="x3pio", extra="metrology"),
    ".sur": ExportFormat(
        "a surface", "formats.topography:encode_sur", package="surfalize", extra="metrology"
    ),
    ".gsf": ExportFormat("a surface", "formats.topography:encode_gsf", package="gsffile", extra="metrology"),
    ".png": ExportFormat("heights in 16 bits", "formats.export:encode_png"),
    ".tif": _TIFF,
    ".tiff": _TIFF,
    ".csv": ExportFormat("a matrix or a cross-section", "formats.export:encode_csv", ("section", "map_name")),
    ".npz": ExportFormat("arrays", "formats.export:encode_npz", ("map_name",), needs_heights=False),
    ".mcap": ExportFormat("ROS 2 messages", "formats.mcap:save_messages", writes_itself=True),
    ".zarr": ExportFormat(
        "everything in the file", "files.result_file:save_result", needs_heights=False, writes_itself=True
    ),
}
"""Formats by suffix."""


def contents() -> str:
    """Return the contents and suffixes of the formats: "a mesh .ply .stl, points .xyz"."""
    kinds: dict[str, list[str]] = {}
    for suffix, form in FORMATS.items():
        kinds.setdefault(form.kind, []).append(suffix)
    return ", ".join(f"{kind} {' '.join(suffixes)}" for kind, suffixes in kinds.items())


def suffixes_with(option: str) -> tuple[str, ...]:
    """Return the suffixes of the formats that take an option.

    Examples
    --------
    >>> suffixes_with("points")
    ('.ply',)
    """
    return tuple(suffix for suffix, form in FORMATS.items() if option in form.options)
