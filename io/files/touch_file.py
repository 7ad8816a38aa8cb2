"""The recording of a touch: a press, and beside it in the same file the turn that followed."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

from mirrorskin.io.base.system import translate_os_errors
from mirrorskin.io.base.types import InputError, Source
from mirrorskin.io.base.url import path_of
from mirrorskin.io.files.opening import open_recording
from mirrorskin.io.files.recorder import Compression, Recorder
from mirrorskin.io.files.recording import Recording
from mirrorskin.io.formats.registry import is_of_others
from mirrorskin.io.model.calibration import Calibration
from mirrorskin.io.storage.atomic import MAKE_ROOM, check_output, new_hdf5
from mirrorskin.io.storage.layout import MARK
from mirrorskin.io.storage.zarr import open_file

TURN = "turn"
"""Name of the group of the turn: ``open_recording(path, dataset="turn")`` opens it."""


def save_touch(
    path: str | Path,
    press: Source,
    turn: Source | None,
    *,
    compression: Compression = "raw",
    calibration: Calibration | None = None,
    overwrite: bool = False,
) -> None:
    """Write the frames of a touch to one file.

    It is the recording of the press. The group ``turn`` contains that of the turn, in the same layout. Both
    sources are closed, as by `Recorder`.

    Parameters
    ----------
    path : str or Path
    press, turn : Source
        Of vertical and of axial motion; without a turn, the file is a plain recording.
    compression : {"raw", "bitshuffle", "blosc", "gzip", "lzf"}
        See `Recorder`.
    calibration : Calibration, optional
        Calibration to copy into both recordings.
    overwrite : bool
        Whether an existing file of that name is replaced.

    Raises
    ------
    mirrorskin.io.InputError
        The file exists, or cannot be written.

    Examples
    --------
    >>> save_touch("ball-frames.h5", press, turn)  # doctest: +SKIP
    >>> open_recording("ball-frames.h5", dataset="turn").motion  # doctest: +SKIP
    'axial'
    """
    path = Path(path)
    check_output(path, replaces="anything" if overwrite else "nothing")
    with translate_os_errors(f"{path} could not be written", MAKE_ROOM):
        folder = tempfile.TemporaryDirectory(dir=path.parent, prefix=".mirrorskin-touch-")
    with folder as parts, new_hdf5(path, "anything" if overwrite else "nothing") as new:
        for name, source in (("", press), (TURN, turn)):
            if source is not None:
                part = Path(parts) / f"{name or 'press'}.h5"
                source.rewind()
                with Recorder(source, part, compression, calibration=calibration) as recorder:
                    recorder.drain()
                with h5py.File(part) as file:
                    _copy(file, new.root, name)
        new.check()


def has_turn(path: str | Path) -> bool:
    """Return whether a file of ours contains the turn of a touch beside its press."""
    if is_of_others(Path(path)):
        return False
    with open_file(path_of(path)) as file:
        return file.marked(MARK) and file.marked(MARK, f"/{TURN}/entry")


@contextmanager
def open_touch(path: str | Path, memory_limit: int | None = None) -> Iterator[tuple[Recording, Recording]]:
    """Open the press and the turn of a touch; InputError for a file with only one movement.

    Parameters
    ----------
    path : str or Path
    memory_limit : int, optional
        Bytes of host memory for frames that are read ahead.

    Examples
    --------
    >>> with open_touch("ball-frames.h5") as (press, turn):  # doctest: +SKIP
    ...     surface = engine.live.fuse_touch(press, turn)
    """
    if not has_turn(path):
        raise InputError(f"{path} is not the recording of a touch: name a press and a rotation")
    with (
        open_recording(path, memory_limit=memory_limit) as press,
        open_recording(path, dataset=TURN, memory_limit=memory_limit) as turn,
    ):
        yield press, turn


def _copy(file: h5py.File, root: h5py.File, name: str) -> None:
    """Copy a recording into a group; links within it lead to the copies."""
    group = root.require_group(name) if name else root
    if not name:
        root.attrs.update(file.attrs)
    file.copy("entry", group)
    data = group["entry/data"]
    for link in list(data):
        target = data.get(link, getlink=True)
        if name and isinstance(target, h5py.SoftLink):
            del data[link]
            data[link] = h5py.SoftLink(f"/{name}{target.path}")
