"""What a live loop feeds."""

from __future__ import annotations

from typing import Any, Protocol

from numpy.typing import NDArray

from mirrorskin.engine.live.types import Update
from mirrorskin.io import Block, Result


class LiveEstimator(Protocol):
    """An estimator that tells what it knows whenever it is asked."""

    @property
    def room(self) -> NDArray[Any]:
        """Where the next frames may be written, (n, H, W)."""

    @property
    def every(self) -> int:
        """It asks for frames whose number is a multiple of this."""

    @property
    def most_updates(self) -> float:
        """Updates a second that are of use."""

    def warm(self) -> None:
        """Compile and try all kernels, so that the first frames need not wait for that; then forget it."""

    def push(self, block: Block) -> None:
        """Take in the next frames."""

    def update(self) -> Update:
        """Return what is known by now."""

    def spare(self, seconds: float) -> None:
        """Do what can wait, for so long at most, as nothing else is to be done."""

    def result(self) -> Result:
        """Return the maps of the frames so far, as well as they can be told, and how they were made."""
