"""Whether a new file may replace an existing one, from the kind of the existing file."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Literal

from mirrorskin.io.base.types import InputError
from mirrorskin.io.storage.hdf5 import Hdf5File

Replaces = Literal["nothing", "unused", "derived", "calibration", "anything"]
"""The existing files that a new file may replace.

"nothing": none, the name must be free. "unused": the same for a result, which can replace "derived" files
with --overwrite. "derived": files that can be computed again, such as a result, a picture or a table; not a
recording, a calibration, an HDF5 or MCAP file of another program, a video, arrays, an archive or a surface
(SUR, GSF) that ``export`` did not write, or settings. "calibration": "derived" files, and calibrations.
"anything": every file, because the user requested it.
"""

SURFACE_TOPIC = "/surface"
"""Topic of the surface of an exported result."""

_OF_RESULTS = {SURFACE_TOPIC, "/height", "/force"}
_HDF5, _MCAP = b"\x89HDF\r\n\x1a\n", b"\x89MCAP0\r\n"
_NPY, _ZIP, _HEAD = b"\x93NUMPY", b"PK\3\4", 16
_SURFACES = b"DIGITAL SURF", b"DSCOMPRESSED", b"Gwyddion Simple"
_OURS, _NOTES = (
    b"exported by mirrorskin",
    4096,
)  # text in the notes of an exported surface, and length of the notes in bytes
_VIDEOS = (
    (0, b"RIFF"),
    (4, b"ftyp"),
    (0, b"\x1a\x45\xdf\xa3"),
    (0, b"OggS"),
    (0, b"FLV"),
    (0, b"\0\0\1\xba"),
)
"""Offsets and bytes that identify videos: AVI, MP4 and MOV, Matroska and WebM, Ogg, FLV, MPEG."""

_USER_BLOCK = 512  # bytes; HDF5's signature is at 0, or at this value times a power of two
_KINDS = {"recording": "a recording", "calibration": "a calibration", "result": "a result"}
_CALIBRATION = _KINDS["calibration"]
_RESULT, _RECORDING = b"mirrorskin_result", b"mirrorskin_recording"


def check_replaced(path: Path, replaces: Replaces) -> None:
    """Raise InputError unless a new file may replace the existing one."""
    if replaces == "anything":
        return
    kind = protected_kind(path)
    if replaces == "nothing" or (replaces == "unused" and not kind):
        description = f" and is {kind}" if kind else ""
        raise InputError(
            f"{path} exists{description}: add --overwrite to replace it, or choose another name with -o"
        )
    if kind and not (kind == _CALIBRATION and replaces == "calibration"):
        raise InputError(f"{path} is {kind}, which this command never replaces: choose another name with -o")


def _was_result(path: Path) -> bool:
    """Return whether a damaged HDF5 file was a result, and can be computed again."""
    with path.open("rb") as file:
        before, marks = b"", set[bytes]()
        while piece := file.read(1 << 20):
            marks |= {mark for mark in (_RESULT, _RECORDING) if mark in before + piece}
            before = piece[-len(_RECORDING) :]
    return marks == {_RESULT}


def _is_exported(path: Path) -> bool:
    """Return whether an archive contains the maps of a result, as written by ``export``."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = set(archive.namelist())
            if "main.xml" in names:  # X3P
                with archive.open("main.xml") as description:
                    return _OURS in description.read(_NOTES)
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return False
    return {"units.npy", "legends.npy", "process.npy"} <= names


def protected_kind(path: Path) -> str:
    """Return the kind of a file that cannot be computed again; "" for other files."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
        if head.startswith(_MCAP):
            return "" if is_surface(path) else _KINDS["recording"]
        if any(head[place:].startswith(mark) for place, mark in _VIDEOS):
            return "a video"
        if head.startswith(_SURFACES):
            return "" if _OURS in file.read(_NOTES) else "a surface of another program"
        if head.startswith(_NPY):
            return "an array"
        if head.startswith(_ZIP):
            return "" if _is_exported(path) else "an archive"
        if path.suffix.lower() == ".toml":
            return "a file of settings"
        file.seek(0)
        place, size = 0, path.stat().st_size
        while file.read(len(_HDF5)) != _HDF5:
            place = 2 * place or _USER_BLOCK
            if place >= size:
                return ""
            file.seek(place)
    try:
        with Hdf5File(path) as opened:
            kind = next((text for name, text in _KINDS.items() if opened.marked(f"mirrorskin_{name}")), "")
    except InputError:
        return "" if _was_result(path) else "an HDF5 file that cannot be read"
    return "" if kind == _KINDS["result"] else kind or "an HDF5 file of another program"


def is_surface(path: Path) -> bool:
    """Return whether an MCAP file contains an exported result only, and thus no frames."""
    try:
        from mcap.reader import make_reader

        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
    except Exception:  # missing packages; damaged bytes raise errors of many types
        return False
    topics = {channel.topic for channel in summary.channels.values()} if summary is not None else set()
    return SURFACE_TOPIC in topics and topics <= _OF_RESULTS
