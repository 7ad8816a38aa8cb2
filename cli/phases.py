"""The phase of each frame, from a file of text."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mirrorskin.io.types import Floats


@dataclass(frozen=True, slots=True)
class ListedPhases:
    """Phases as a file lists them, one a frame; see ``io.Positions``.

    Attributes
    ----------
    path : Path
    radians : tuple of float
    """

    path: Path
    radians: tuple[float, ...]

    def positions(self, count: int) -> Floats:
        """Return the phases of ``count`` frames, radians; InputError if the file lists another number."""
        import numpy as np

        from mirrorskin.io import InputError

        if len(self.radians) != count:
            raise InputError(
                f"{self.path} lists {len(self.radians)} phases for {count} frames: one a frame is needed"
            )
        return np.array(self.radians)


def read_phases(path: Path) -> ListedPhases:
    """Read angles with their units, one a line or several between blanks; ``#`` begins a comment.

    Raises
    ------
    InputError
        The file cannot be read, or holds something else, or nothing.
    """
    from mirrorskin.cli.quantity import angle
    from mirrorskin.io import InputError

    remedy = "write one angle a frame in it, such as 178.1deg"
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; {remedy}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text: {remedy}") from error
    radians = tuple(
        angle(word, f"{path}, line {number}:")
        for number, line in enumerate(lines, 1)
        for word in line.partition("#")[0].split()
    )
    if not radians:
        raise InputError(f"{path} lists no phases: {remedy}")
    return ListedPhases(path, radians)
