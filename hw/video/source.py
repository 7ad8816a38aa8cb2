"""What a rig file's ``camera.source`` means: a camera of this machine, a stream, or a file."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mirrorskin.io import InputError

Kind = Literal["device", "stream", "file"]

_DEVICES = Path("/dev")


@dataclass(frozen=True, slots=True)
class VideoSource:
    """Where pictures come from.

    Attributes
    ----------
    kind : {"device", "stream", "file"}
    target : str
        A device's path, a URL, or a file's path.
    name : str
        What messages call it, without a password.
    """

    kind: Kind
    target: str
    name: str


def find_source(source: int | str) -> VideoSource:
    """Tell what kind of source it is, and see that it is there.

    Parameters
    ----------
    source : int or str
        The number of a camera or its path under /dev, a URL, or the path of a video file.

    Raises
    ------
    InputError
        There is no such device or file, or it may not be read.
    """
    text = str(source)
    if re.fullmatch(r"\d+", text):
        text = str(_DEVICES / f"video{text}")
    if Path(text).is_relative_to(_DEVICES):
        _check_device(Path(text))
        return VideoSource("device", text, f"camera {text}")
    if re.match(r"[a-zA-Z][a-zA-Z0-9+.-]+://", text):
        return VideoSource("stream", text, f"camera {re.sub('//[^/]*@', '//', text)}")
    if not Path(text).is_file():
        raise InputError(f"camera {text}: there is no such file; give a camera's number, a URL or a video")
    return VideoSource("file", str(Path(text).absolute()), f"camera {text}")


def _check_device(path: Path) -> None:
    if not path.exists():
        there = sorted(str(found) for found in _DEVICES.glob("video*"))
        raise InputError(
            f"camera {path}: there is no such device; "
            + (f"there are {', '.join(there)}" if there else "no camera is connected that Linux knows")
        )
    if not os.access(path, os.R_OK | os.W_OK):
        raise InputError(f"camera {path} may not be used: add yourself to the group 'video'")
