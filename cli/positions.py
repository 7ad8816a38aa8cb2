"""What the command line says of a stack that its file does not."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypedDict

from mirrorskin.cli.options import MotionName

if TYPE_CHECKING:
    from pathlib import Path

    from mirrorskin.io import Motion, Positions, Region


class Given(TypedDict, total=False):
    """The keywords of ``io.open_recording`` that describe a stack; what nobody said is missing."""

    motion: Motion
    travel: Positions
    phase: Positions
    tilt: float
    pixel_size: tuple[float, float]
    region: Region
    frames: tuple[int, int | None]


def given(
    *,
    motion: MotionName | None = None,
    travel_step: str | None = None,
    travel_start: str | None = None,
    phase_step: str | None = None,
    phases: Path | None = None,
    tilt: str | None = None,
    pixel_size: str | None = None,
    region: str | None = None,
    frames: str | None = None,
    where: str = "--",
) -> Given:
    """Turn the options' words into numbers, in millimetres and radians.

    Parameters
    ----------
    motion, travel_step, travel_start, phase_step, phases, tilt, pixel_size, region, frames
        The options.
    where : str
        What stands before an option's name where it was written.

    Raises
    ------
    mirrorskin.io.InputError
        One cannot be read, or does not go with another.
    """
    from mirrorskin.cli import part
    from mirrorskin.cli.quantity import angle, lengths
    from mirrorskin.io import InputError

    if phase_step is not None and phases is not None:
        raise InputError("--phase-step and --phases both tell the phases: give one of them")
    known = Given()
    if motion is not None:
        known["motion"] = motion.value
    known |= _travel(travel_step, travel_start, where)
    known |= _phase(phase_step, phases, where)
    if tilt is not None:
        known["tilt"] = angle(tilt, f"{where}tilt")
    if pixel_size is not None:
        known["pixel_size"] = lengths(pixel_size, f"{where}pixel-size")
    if region is not None:
        known["region"] = part.region(region, f"{where}region")
    if frames is not None:
        known["frames"] = part.frame_range(frames, f"{where}frames")
    return known


def _travel(step: str | None, start: str | None, where: str) -> Given:
    from mirrorskin.cli.quantity import length
    from mirrorskin.io import InputError, Steps

    if step is not None:
        first = length(start or "0mm", f"{where}travel-start")
        return {"travel": Steps(length(step, f"{where}travel-step"), first)}
    if start is not None:
        other = f"{where.rpartition(' ')[2]}travel-step"
        raise InputError(f"{where}travel-start without {other} says nothing: give both")
    return {}


def _phase(step: str | None, phases: Path | None, where: str) -> Given:
    from mirrorskin.cli.phases import read_phases
    from mirrorskin.cli.quantity import angle
    from mirrorskin.io import Steps

    if step is not None:
        return {"phase": Steps(angle(step, f"{where}phase-step"))}
    return {} if phases is None else {"phase": read_phases(phases)}
