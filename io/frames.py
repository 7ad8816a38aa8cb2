"""Other people's frames, whatever they come in, as sources that are read in order."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.positions import Positions, Steps, along, check_phase, check_strokes
from mirrorskin.io.types import Block, Closing, Floats, Header, InputError, block_memory


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

    Examples
    --------
    >>> open_frames("pictures", Header("vertical"), travel=Steps(0.1)).shape  # doctest: +SKIP
    (240, 480, 640)
    """
    from mirrorskin.io.pictures import PICTURE_SUFFIXES, Pictures
    from mirrorskin.io.video import Video

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


if TYPE_CHECKING:
    from mirrorskin.io.pictures import Pictures
    from mirrorskin.io.video import Video


class FrameSequence(Closing, ABC):
    """A source of other people's frames, read in order and rewindable."""

    rewindable = True

    def __init__(
        self,
        name: str,
        header: Header,
        shape: tuple[int, int, int],
        dtype: np.dtype[Any],
        *,
        travel: ArrayLike | Positions | None = None,
        phase: ArrayLike | Positions | None = None,
        time: Floats | None = None,
        lost: Sequence[int] | None = None,
        left_out: tuple[str, ...] = (),
    ) -> None:
        self.name, self.header, self.motion = name, header, header.motion
        self.shape, self.dtype, self.left_out = shape, dtype, left_out
        self._lost = lost or [0] * shape[0]
        self._time = time
        travel, phase = self._along(travel), self._along(phase)
        self.travel = None if travel is None else check_strokes(travel, shape[0], f"{name}: travel")
        self._phase = None if phase is None else check_phase(phase, shape[0], f"{name}: phase")
        self._next = 0

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the next frames."""
        out = block_memory(out, self.shape, self.dtype)
        start = self._next
        if start == self.shape[0]:
            return None
        stop = self._unbroken(start, min(start + len(out), self.shape[0]))
        frames = out[: stop - start]
        self._fill(start, frames)
        self._next = stop
        series = {"time": self._time, "travel": self.travel, "phase": self._phase}
        known: dict[str, Any] = {
            name: values[start:stop] for name, values in series.items() if values is not None
        }
        return Block(frames, start, **known, dropped=self._lost[start])

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._next = 0

    @abstractmethod
    def _fill(self, start: int, out: NDArray[Any]) -> None:
        """Read the frames from number ``start`` on into the whole of ``out``."""

    def _unbroken(self, start: int, stop: int) -> int:
        """Stop before the first frame that others were lost before."""
        return next((k for k in range(start + 1, stop) if self._lost[k]), stop)

    def _along(self, given: ArrayLike | Positions | None) -> ArrayLike | None:
        """Write out positions; of steps, a lost frame is one as well."""
        if isinstance(given, Steps):
            taken = np.arange(self.shape[0]) + np.cumsum(self._lost)
            return np.asarray(given.start + given.step * taken)
        return along(given, self.shape[0])


@contextmanager
def quiet_opencv() -> Iterator[Any]:
    """Lend OpenCV with its own messages kept off the terminal: the caller raises its own."""
    import cv2  # takes longer than everything else that mirrorskin.io imports

    # OpenCV 5 moved it.
    set_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    level = set_level(0)
    try:
        yield cv2
    finally:
        set_level(level)
