"""What recordings have in common, however they are written: header, storage, and what to plot."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any, Literal, get_args

import h5py

from mirrorskin.io.layout import MARK, SERIES, STACK
from mirrorskin.io.plain import legible
from mirrorskin.io.types import Header, InputError, Motion

Compression = Literal["raw", "bitshuffle", "blosc", "gzip", "lzf"]
COMPRESSIONS: tuple[Compression, ...] = get_args(Compression)

POSITIONS: dict[Motion, str] = {
    "vertical": "travel",
    "axial": "phase",
    "horizontal": "displacement",
    "twist": "twist",
}
"""Which series tells where the body was, of each motion."""


def check_compression(compression: str) -> None:
    """Raise InputError for a compression that nobody knows."""
    if compression not in COMPRESSIONS:
        raise InputError(f"unknown compression {compression!r}; known are {', '.join(COMPRESSIONS)}")


def packing(compression: Compression) -> dict[str, Any]:
    """Return what to create a dataset with so that it is packed."""
    if compression == "raw":
        return {}
    if compression == "gzip":
        return {"compression": "gzip", "compression_opts": 1, "shuffle": True}
    if compression == "lzf":
        return {"compression": "lzf", "shuffle": True}
    import hdf5plugin  # registers its filters with HDF5

    if compression == "bitshuffle":
        return {**hdf5plugin.Bitshuffle(cname="lz4")}
    return {**hdf5plugin.Blosc(cname="lz4", shuffle=hdf5plugin.Blosc.BITSHUFFLE)}


def write_header(file: h5py.File, header: Header) -> None:
    """Write what holds for all frames, and the groups for what does not."""
    file.attrs.update(NX_class="NXroot", default="entry")
    entry = new_group(file, "entry", "NXentry", default="data", **{MARK: 1})
    entry["title"] = legible(header.title)
    entry["start_time"] = header.start_time or datetime.now(UTC).isoformat(timespec="milliseconds")
    instrument = new_group(entry, "instrument", "NXinstrument")
    detector = new_group(instrument, "detector", "NXdetector")
    stage = new_group(instrument, "stage", "NXpositioner")
    stage["motion"] = header.motion
    put(detector, "local_name", None, legible(header.camera) or None)
    x, y = header.pixel_size or (None, None)
    put(detector, "x_pixel_size", "mm", x)
    put(detector, "y_pixel_size", "mm", y)
    put(detector, "dark", "counts", header.dark)
    put(detector, "bright", "counts", header.bright)
    put(detector, "zenith_gain", "1/rad", header.zenith_gain)
    put(detector, "zenith_offset", "counts", header.zenith_offset)
    put(stage, "tilt", "rad", header.tilt)
    put(stage, "pivot", "mm", header.pivot)
    if header.motion != "vertical":
        put(stage, "travel", "mm", header.press)


def new_stack(file: h5py.File, shape: tuple[int, int, int], dtype: Any, **storage: Any) -> h5py.Dataset:
    """Make the dataset of the frames."""
    stack = file.create_dataset(STACK, shape, dtype, **storage)
    stack.attrs.update(interpretation="image", units="counts")
    return stack


def write_plot(file: h5py.File, motion: Motion, known: set[str]) -> None:
    """Say what to plot: the frames, along what is known of each: their positions, else their time."""
    data = new_group(file["entry"], "data", "NXdata", signal="frames")
    data["frames"] = h5py.SoftLink(STACK)
    axes = known - {"displacement"}  # which is two numbers a frame
    along = next((name for name in (POSITIONS[motion], "time") if name in axes), None)
    if along is not None:
        target = SERIES[along][0]
        name = target.rsplit("/", 1)[-1]
        data.attrs["axes"] = [name, ".", "."]
        data[name] = h5py.SoftLink(target)


def new_group(parent: h5py.Group, name: str, nexus: str, **attrs: Any) -> h5py.Group:
    """Make a group of a NeXus class."""
    group = parent.create_group(name)
    group.attrs.update(NX_class=nexus, **attrs)
    return group


def put(group: h5py.Group, name: str, unit: str | None, value: Any) -> None:
    """Write a value and its unit, if there is one."""
    if value is not None:
        group[name] = value
        if unit is not None:
            group[name].attrs["units"] = unit
