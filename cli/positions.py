"""What the command line says of a stack that its file does not."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypedDict

from mirrorskin.cli.options import MotionName

if TYPE_CHECKING:
    from pathlib import Path

    from mirrorskin.io import Motion, Positions


class Given(TypedDict):
    """The keywords of ``io.open_recording`` that describe a stack."""

    motion: Motion | None
    travel: Positions | None
    phase: Positions | None
    tilt: float | None
    pixel_size: tuple[float, float] | None


def given(
    motion: MotionName | None,
    travel_step: str | None,
    travel_start: str | None,
    phase_step: str | None,
    phases: Path | None,
    tilt: str | None,
    pixel_size: str | None,
) -> Given:
    """Turn the options' words into numbers, in millimetres and radians."""
    from mirrorskin.cli.phases import read_phases
    from mirrorskin.cli.quantity import angle, length, lengths
    from mirrorskin.io import InputError, Steps

    if travel_start is not None and travel_step is None:
        raise InputError("--travel-start without --travel-step says nothing: give both")
    if phase_step is not None and phases is not None:
        raise InputError("--phase-step and --phases both tell the phases: give one of them")
    travel: Positions | None = None
    phase: Positions | None = None
    if travel_step is not None:
        travel = Steps(length(travel_step, "--travel-step"), length(travel_start or "0mm", "--travel-start"))
    if phase_step is not None:
        phase = Steps(angle(phase_step, "--phase-step"))
    if phases is not None:
        phase = read_phases(phases)
    return Given(
        motion=motion.value if motion else None,
        travel=travel,
        phase=phase,
        tilt=None if tilt is None else angle(tilt, "--tilt"),
        pixel_size=None if pixel_size is None else lengths(pixel_size, "--pixel-size"),
    )
