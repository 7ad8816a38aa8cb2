"""What the command line says of a stack that its file does not."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypedDict

from mirrorskin.cli.options import MotionName

if TYPE_CHECKING:
    from mirrorskin.io import Motion, Steps


class Given(TypedDict):
    """The keywords of ``io.open_recording`` that describe a stack."""

    motion: Motion | None
    travel: Steps | None
    phase: Steps | None
    tilt: float | None
    pixel_size: tuple[float, float] | None


def given(
    motion: MotionName | None,
    travel_step: str | None,
    travel_start: str,
    phase_step: str | None,
    tilt: str | None,
    pixel_size: str | None,
) -> Given:
    """Turn the options' words into numbers, in millimetres and radians."""
    from mirrorskin.cli.quantity import angle, length, lengths
    from mirrorskin.io import Steps

    return Given(
        motion=motion.value if motion else None,
        travel=Steps(length(travel_step, "--travel-step"), length(travel_start, "--travel-start"))
        if travel_step
        else None,
        phase=Steps(angle(phase_step, "--phase-step")) if phase_step else None,
        tilt=angle(tilt, "--tilt") if tilt else None,
        pixel_size=lengths(pixel_size, "--pixel-size") if pixel_size else None,
    )
