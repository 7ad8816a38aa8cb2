"""Options that describe a stack of frames: positions, pixel size, region, frames."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from mirrorskin.cli.options import MotionName

if TYPE_CHECKING:
    from mirrorskin.io import Motion, Region
    from mirrorskin.io.positions import Positions
    from mirrorskin.io.types import Floats


class StackOptions(TypedDict, total=False):
    """The keywords of ``io.open_recording`` that describe a stack; those not given are missing."""

    motion: Motion
    travel: Positions
    phase: Positions
    tilt: float
    pixel_size: tuple[float, float]
    region: Region
    frames: tuple[int, int | None]


def stack_options(
    *,
    motion: MotionName | None = None,
    travel_step: str | None = None,
    travel_start: str | None = None,
    travel: Path | None = None,
    phase_step: str | None = None,
    phases: Path | None = None,
    tilt: str | None = None,
    pixel_size: str | None = None,
    region: str | None = None,
    frames: str | None = None,
    where: str = "--",
) -> StackOptions:
    """Convert options to numbers, mm and radians; messages put ``where`` before an option's name."""
    from mirrorskin.cli.quantity import angle, lengths

    options = StackOptions()
    if motion is not None:
        options["motion"] = motion.value
    options |= _travel(travel_step, travel_start, travel, where) | _phase(phase_step, phases, where)
    if tilt is not None:
        options["tilt"] = angle(tilt, f"{where}tilt")
    if pixel_size is not None:
        options["pixel_size"] = lengths(pixel_size, f"{where}pixel-size")
    if region is not None:
        options["region"] = region_of(region, f"{where}region")
    if frames is not None:
        options["frames"] = frame_range(frames, f"{where}frames")
    return options


def _travel(step: str | None, start: str | None, listed: Path | None, where: str) -> StackOptions:
    from mirrorskin.cli.quantity import length
    from mirrorskin.io import InputError, Steps

    if listed is not None:
        if step is not None or start is not None:
            own = where.rpartition(" ")[2]
            raise InputError(
                f"{where}travel is that of all frames: leave {own}travel-step and {own}travel-start out"
            )
        return {"travel": read_travel(listed)}
    if step is not None:
        first = length(start or "0mm", f"{where}travel-start")
        return {"travel": Steps(length(step, f"{where}travel-step"), first)}
    if start is not None:
        other = f"{where.rpartition(' ')[2]}travel-step"
        raise InputError(f"{where}travel-start without {other} says nothing: give both")
    return {}


def _phase(step: str | None, phases: Path | None, where: str) -> StackOptions:
    from mirrorskin.cli.quantity import angle
    from mirrorskin.io import InputError, Steps

    if step is not None and phases is not None:
        raise InputError("--phase-step and --phases both give the phases: leave one out")
    if step is not None:
        return {"phase": Steps(angle(step, f"{where}phase-step"))}
    return {} if phases is None else {"phase": read_phases(phases)}


def region_of(text: str, option: str = "") -> Region:
    """Return a rectangle of the picture, as in ``100,50,640x480``: first column and row, columns and rows."""
    from mirrorskin.io import InputError, Region

    found = Region.read("".join(text.split()))
    if found is None:
        raise InputError(
            f"{option} {text}: the first column and row, and how many of each, are needed;"
            " write e.g. 100,50,640x480"
        )
    return found


def frame_range(text: str, option: str = "") -> tuple[int, int | None]:
    """Return a range of frames, as in ``10:200``: the first and the one after the last, None for the end."""
    from mirrorskin.io import InputError

    match = re.fullmatch(r"([0-9]{0,9}):([0-9]{0,9})", "".join(text.split()))
    start, stop = (int(one) if one else None for one in match.groups()) if match else (None, 0)
    if stop is not None and stop <= (start or 0):
        raise InputError(
            f"{option} {text}: the first frame, from 0, and a later one that is left out are needed;"
            " write e.g. 10:200, or 10: for all from 10 on"
        )
    return start or 0, stop


@dataclass(frozen=True, slots=True)
class Listed:
    """The positions that a file lists, one a frame, mm or radians; see ``io.Positions``."""

    path: Path
    what: str
    values: tuple[float, ...]

    def positions(self, count: int) -> Floats:
        """Return the positions of ``count`` frames; InputError if the file lists another number."""
        import numpy as np

        from mirrorskin.io import InputError

        if len(self.values) != count:
            raise InputError(
                f"{self.path} lists {len(self.values)} {self.what} for {count} frames: one a frame is needed"
            )
        return np.array(self.values)


def read_phases(path: Path) -> Listed:
    """Read angles with their units, one a line or several between blanks; ``#`` begins a comment."""
    from mirrorskin.cli.quantity import angle

    return _listed(path, "phases", "write one angle a frame in it, such as 178.1deg", angle)


def read_travel(path: Path) -> Listed:
    """Read the travel of each frame: an array of NumPy's, mm, or a text of lengths, mm where no unit stands.

    In a text they stand between blanks, commas or semicolons; ``#`` begins a comment, and a first line that
    begins with a letter is a head.
    """
    from mirrorskin.cli.quantity import length

    if path.suffix.lower() == ".npy":
        from mirrorskin.io.arrays import read_array

        return Listed(path, "travels", tuple(map(float, read_array(path).reshape(-1))))

    def millimetres(text: str, where: str) -> float:
        try:
            return float(text)
        except ValueError:
            return length(text, where)

    remedy = "write one length a frame in it, such as 0.15mm"
    return _listed(path, "travels", remedy, millimetres, table=True)


def _listed(
    path: Path, what: str, remedy: str, read: Callable[[str, str], float], *, table: bool = False
) -> Listed:
    """Read a text of positions; in a ``table``, commas and semicolons are blanks, and there may be a head."""
    from mirrorskin.io import InputError
    from mirrorskin.io.os_errors import MAX_TEXT_BYTES, read_regular

    try:
        lines = read_regular(path, remedy, MAX_TEXT_BYTES).decode().splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text: {remedy}") from error
    if table:
        lines = [line.replace(",", " ").replace(";", " ") for line in lines]
        lines[:1] = ["" if line.strip()[:1].isalpha() else line for line in lines[:1]]
    values = tuple(
        read(word, f"{path}, line {number}:")
        for number, line in enumerate(lines, 1)
        for word in line.partition("#")[0].split()
    )
    if not values:
        raise InputError(f"{path} lists no {what}: {remedy}")
    return Listed(path, what, values)
