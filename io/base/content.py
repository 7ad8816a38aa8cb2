"""What a file contains by its first bytes, whatever its name is, and how to read it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from mirrorskin.io.base.system import open_regular
from mirrorskin.io.base.types import InputError

TIFF_MARKS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""First bytes of TIFF and BigTIFF."""

_HEAD_BYTES = 64


class UnknownContentError(InputError):
    """A file is not of the format that is needed, nor of another one that is known."""


CONVERT_BAG = "'rosbags-convert --src {} --dst NEW --dst-storage mcap' (of the package rosbags)"


class _Kind(NamedTuple):
    """A kind of files: the bytes at a place that show it, what it is, and the remedy or the usual suffix."""

    place: int
    mark: bytes
    what: str
    remedy: str


# In remedies that are not suffixes, "{}" is replaced by the path, and "{folder}" by its folder.
_KINDS = (
    _Kind(0, b"\x89HDF\r\n\x1a\n", "an HDF5 file", ".h5"),
    *(_Kind(0, mark, "a TIFF", ".tif") for mark in TIFF_MARKS),
    _Kind(0, b"\x89PNG\r\n\x1a\n", "a PNG", ".png"),
    _Kind(0, b"\xff\xd8\xff", "a JPEG", ".jpg"),
    _Kind(0, b"P5\n", "a PGM", ".pgm"),
    _Kind(0, b"\x89MCAP0\r\n", "an MCAP file", ".mcap"),
    _Kind(0, b"\x93NUMPY", "an array of NumPy", ".npy"),
    _Kind(8, b"AVI LIST", "an AVI", ".avi"),
    _Kind(4, b"ftyp", "an MP4 or MOV", ".mp4"),
    _Kind(0, b"\x1aE\xdf\xa3", "a Matroska video", ".mkv"),
    _Kind(0, b"YUV4MPEG2 ", "a YUV4MPEG2 video", ".y4m"),
    _Kind(0, b"#ROSBAG V", "a bag of ROS 1", f"convert it with {CONVERT_BAG}"),
    _Kind(
        0,
        b"SQLite format 3\0",
        "an SQLite database, as the bags of ROS 2 have",
        f"convert a bag with {CONVERT_BAG.replace('{}', '{folder}')}",
    ),
    _Kind(0, b"CDF\x01", "a netCDF file of version 3, which is not HDF5", "convert it with 'nccopy -k nc4'"),
    _Kind(0, b"CDF\x02", "a netCDF file of version 3, which is not HDF5", "convert it with 'nccopy -k nc4'"),
    _Kind(0, b"CDF\x05", "a netCDF file of version 3, which is not HDF5", "convert it with 'nccopy -k nc4'"),
    _Kind(
        0, b"MATLAB 5.0 MAT-file", "a file of MATLAB before version 7.3", "write it with save(..., '-v7.3')"
    ),
    _Kind(0, b"ZISRAWFILE", "a CZI", "convert it with 'bfconvert {} NEW.ome.tif' (of Bio-Formats)"),
    _Kind(0, b"\xda\xce\xbe\n", "an ND2", "convert it with 'bfconvert {} NEW.ome.tif' (of Bio-Formats)"),
    _Kind(0, b"SIMPLE  =", "a FITS file", "save its array with numpy.save or as TIFF"),
    _Kind(0, b"PK\x03\x04", "a ZIP archive", "unpack it; archives of NumPy are .npz, of Zarr .zarr.zip"),
)
_PACKED = (
    (b"\x28\xb5\x2f\xfd", "Zstandard", "zstd -d"),
    (b"\x1f\x8b", "gzip", "gunzip"),
    (b"\xfd7zXZ\0", "xz", "unxz"),
    (b"BZh", "bzip2", "bunzip2"),
    (b"\x04\x22\x4d\x18", "LZ4", "lz4 -d"),
    (b"7z\xbc\xaf\x27\x1c", "7-Zip", "7z x"),
)


def packed_by(data: bytes) -> str:
    """Return what data are compressed by, from their first bytes; "" if by nothing that is known.

    Examples
    --------
    >>> import gzip
    >>> packed_by(gzip.compress(b"frames"))
    'gzip'
    """
    return next((name for mark, name, _ in _PACKED if data.startswith(mark)), "")


def identified(path: Path) -> str:
    """Return what a regular file is, with the remedy: "a TIFF: name it a.tif"; "" if it is not known."""
    with open_regular(path) as file:
        head = file.read(_HEAD_BYTES)
    for mark, name, command in _PACKED:
        if head.startswith(mark):
            return f"a file compressed by {name}: unpack it, '{command} {path}'"
    kind = next((kind for kind in _KINDS if head.startswith(kind.mark, kind.place)), None)
    if kind is None:
        return ""
    if not kind.remedy.startswith("."):
        return f"{kind.what}: {kind.remedy.format(path, folder=path.parent)}"
    if path.suffix.lower() == kind.remedy:
        return ""
    return f"{kind.what}: name it {path.with_suffix(kind.remedy).name}"
