"""Other people's frames, whatever they come in."""

from __future__ import annotations

from pathlib import Path

from numpy.typing import ArrayLike

from mirrorskin.io.picture_files import PICTURE_SUFFIXES
from mirrorskin.io.pictures import Pictures
from mirrorskin.io.positions import Positions
from mirrorskin.io.types import Header, InputError
from mirrorskin.io.video import Video


def open_frames(
    path: str | Path,
    header: Header,
    travel: ArrayLike | Positions | None = None,
    phase: ArrayLike | Positions | None = None,
) -> Pictures | Video:
    """Open a folder of numbered pictures, a TIFF of many pages, or a video.

    Parameters
    ----------
    path : str or Path
    header : Header
        How the body moved, and what else holds for all frames.
    travel, phase : Positions or array_like, (T,), optional
        Millimetres and radians, one a frame, or ``Steps``.

    Returns
    -------
    Pictures or Video
        A source that can be rewound.

    Raises
    ------
    InputError
        The path holds no such frames, or travel or phase is missing or does not fit them.
    """
    path = Path(path)
    for motion, name, positions, options in (
        ("vertical", "travel", travel, "--travel-step"),
        ("axial", "phase", phase, "--phase-step or --phases"),
    ):
        if header.motion == motion and positions is None:
            raise InputError(f"{path}: frames of {motion} motion need their {name}: give {options}")
        if header.motion != motion and positions is not None:
            raise InputError(f"{path}: frames of {header.motion} motion have no {name}: leave {options} out")
    pictures = path.is_dir() or path.suffix.lower() in PICTURE_SUFFIXES
    return (Pictures if pictures else Video)(path, header, travel, phase)
