"""Kinds of files of other programs that contain frames, and their readers."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Literal

from mirrorskin.io.base.system import check_regular
from mirrorskin.io.base.types import InputError
from mirrorskin.io.base.url import is_zarr
from mirrorskin.io.formats.folder import FolderFrames
from mirrorskin.io.formats.pictures import PICTURE_SUFFIXES
from mirrorskin.io.formats.tiff import TIFF_SUFFIXES, TiffFrames
from mirrorskin.io.formats.video import VIDEO_SUFFIXES, VideoFrames
from mirrorskin.io.model.frames import FrameReader

MCAP_SUFFIX, NUMPY_SUFFIXES = ".mcap", (".npy", ".npz")


Kind = Literal["", "array", "folder", "MCAP", "picture", "TIFF", "video"]


def kind_of_frames(path: Path) -> Kind:
    """Return the kind of a path from its suffix, or as a folder; an empty text for HDF5 and Zarr."""
    if is_zarr(path):
        return ""
    with suppress(OSError):  # reported when it is opened
        if path.is_dir():
            return "folder"
    return _KINDS.get(path.suffix.lower(), "")


_KINDS: dict[str, Kind] = {
    **dict.fromkeys(PICTURE_SUFFIXES, "picture"),
    **dict.fromkeys(TIFF_SUFFIXES, "TIFF"),
    **dict.fromkeys(VIDEO_SUFFIXES, "video"),
    **dict.fromkeys(NUMPY_SUFFIXES, "array"),
    MCAP_SUFFIX: "MCAP",
}


def open_reader(
    path: Path,
    dataset: str | None = None,
    channel: int | None = None,
    memory_limit: int | None = None,
    verify: bool = True,
) -> FrameReader:
    """Open the frames of a folder of pictures, a TIFF, a video or an MCAP file.

    ``dataset`` is a TIFF's series, a video's stream, or a topic; ``channel`` a colour, or a TIFF's channel.
    ``verify``: compare the chunks of an MCAP file with their checksums.
    """
    match kind_of_frames(path):
        case "TIFF":
            return TiffFrames(path, dataset, channel)
        case "video":
            return VideoFrames(path, dataset, channel, memory_limit)
        case "MCAP":
            from mirrorskin.io.formats.mcap import MessageFrames

            return MessageFrames(path, dataset, channel, verify)
        case "folder" if dataset is not None:
            raise InputError(f"{path}: a folder of pictures is one stack: leave --dataset out")
        case "folder":
            return FolderFrames(path, channel)
        case _:
            check_regular(path)
            raise InputError(f"{path} is one picture, not a stack: name the folder that contains its frames")
