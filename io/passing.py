"""What recorders have in common: they pass on the frames of a source, and end what they began."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Generic, TypeVar

from mirrorskin.io.calibration.types import Calibration
from mirrorskin.io.types import Source
from mirrorskin.io.writing import Compression, check_compression

_Passed = TypeVar("_Passed", bound=Source)


class Passing(Generic[_Passed]):
    """A source whose frames are written as they go by.

    Parameters
    ----------
    source : Source
    path : str or Path
        Of the recording.
    compression : {"raw", "bitshuffle", "blosc", "gzip", "lzf"}
    calibration : Calibration, optional
        What the recording is to carry a copy of.

    Raises
    ------
    InputError
        Nobody knows the compression.
    """

    rewindable = False

    def __init__(
        self, source: _Passed, path: str | Path, compression: Compression, calibration: Calibration | None
    ) -> None:
        check_compression(compression)
        self.source = source
        self.path = Path(path)
        self.name, self.motion = source.name, source.motion
        self._compression: Compression = compression
        self._calibration = calibration
        self._exit = ExitStack()  # what is to be done when it is left

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self._exit.__exit__(kind, error, trace)

    def rewind(self) -> None:
        """Refuse: what was written stays written."""
        raise RuntimeError("a recorder cannot be rewound")
