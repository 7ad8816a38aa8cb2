"""``mirrorskin simulate``: a recording from the digital twin, with the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options, sensor
from mirrorskin.cli.declared import Terms, term
from mirrorskin.cli.groups import Argument, Option, refuse_foreign

if TYPE_CHECKING:
    from mirrorskin.hw.twin import Movement

FRAMES_MAX = 10**7
_FRAMES = 30


class FrameType(StrEnum):
    """Types of a sample."""

    uint8 = "uint8"
    uint16 = "uint16"
    float32 = "float32"


class ReferenceName(StrEnum):
    """Where the references come from."""

    ball = "ball"
    exact = "exact"


_PRESS, _TURN, _SIDEWAYS = ("vertical",), ("axial",), ("horizontal", "twist")
MOVEMENT = Terms(
    [
        term("travel_step", "from frame to frame; below zero it is lifted", "mm", "0.1mm", motions=_PRESS),
        term("travel_start", "travel of the first frame", "mm", "0.1mm", motions=_PRESS),
        term("release", "then lift it by the same steps, in frames - 1 more", kind="switch", motions=_PRESS),
        term(
            "strokes",
            "N strokes down and up like a cosine, as deep as those steps",
            kind="integer",
            least=2,
            motions=_PRESS,
        ),
        term("compliance", "elastic: how far the stage gives way", "mm/N", "0mm/N", motions=_PRESS),
        term("press", "travel at which the body moves", "mm", "1mm", motions=(*_TURN, *_SIDEWAYS)),
        term("tilt", "half-angle of the precession", "rad", "2.5deg", motions=_TURN),
        term("phase_step", "from frame to frame", "rad", "45deg", motions=_TURN),
        term(
            "pivot",
            "centre of the rotation, from the sheet's centre",
            "X,Y,Z",
            "0mm,0mm,0mm",
            kind="text",
            motions=_TURN,
        ),
        term(
            "rock",
            "rock towards this phase, up to --tilt, as a sine of the phases of --phase-step",
            "rad",
            motions=_TURN,
        ),
        term("spiral", "tilt and press grow from nothing, frame by frame", kind="switch", motions=_TURN),
        term(
            "displacement_step",
            "from frame to frame",
            "X,Y",
            "0.01mm,0mm",
            kind="text",
            motions=("horizontal",),
        ),
        term("twist_step", "from frame to frame", "rad", "0.2deg", motions=("twist",)),
    ]
)
"""The options of the body's movement."""


def command(
    context: click.Context,
    motion: Annotated[options.MotionName, Argument(help="How the body moves.")],
    output: options.NewRecording,
    thing: Annotated[
        str,
        Option(
            "--object",
            metavar="NAME",
            or_file=True,
            help="sphere, cone, cylinder, plane, step, texture, coin, or a file:"
            " heights in NPY, PNG or TIFF, or a mesh in STL, PLY or OBJ.",
        ),
    ] = "sphere",
    object_shift: Annotated[
        str, Option(metavar="X,Y", help="Where the object's centre lies, from the picture's.")
    ] = "0mm,0mm",
    size: sensor.Size = "480x480",
    pixel_size: sensor.PixelSize = "0.025mm",
    frames: Annotated[
        int | None,
        Option(min=1, max=FRAMES_MAX, help="Frames to take.", show_default="30; of a rotation one turn"),
    ] = None,
    contact: sensor.Contact = sensor.ContactName.conform,
    optics: sensor.Optics = sensor.OpticsName.ideal,
    pattern: Annotated[
        str,
        Option(
            metavar="NAME", or_file=True, help="Of the wall: uniform, linear in the zenith, or a picture."
        ),
    ] = "uniform",
    air_gap: Annotated[str, Option(metavar="LENGTH", help="Between body and wall.")] = "0mm",
    asymmetry: Annotated[float, Option(help="Of the lamps, as a share of their light.")] = 0.0,
    scatter: Annotated[str, Option(metavar="ANGLE", help="Of the sheet's flakes.")] = "3deg",
    friction: Annotated[float, Option(help="Coefficient, between sheet and object.")] = 0.8,
    modulus: Annotated[
        float, Option(metavar="MPA", help="Young's modulus of the body, which scales all forces.")
    ] = 1.0,
    texture: sensor.Texture = sensor.TextureName.none,
    texture_size: sensor.TextureSize = "0.1mm",
    texture_contrast: sensor.TextureContrast = 0.5,
    camera_distance: Annotated[
        str | None,
        Option(metavar="LENGTH", help="Pinhole above the sheet; without it rays are parallel."),
    ] = None,
    point_spread: Annotated[float, Option(metavar="PIXELS", help="Of the lens, one sigma.")] = 0.0,
    dtype: Annotated[FrameType, Option(help="Type of a sample.")] = FrameType.uint8,
    bits: Annotated[int | None, Option(help="Of a uint16 sample: 10, 12 or 16.", show_default="12")] = None,
    noise: Annotated[float, Option(metavar="COUNTS", help="Read noise, one sigma.")] = 1.5,
    electrons: Annotated[
        float | None, Option(metavar="N", help="In one count of these bits, for shot noise.")
    ] = None,
    gain_deviation: Annotated[float, Option(help="Of the pixels' gains, one sigma.")] = 0.0,
    offset_deviation: Annotated[
        float, Option(metavar="COUNTS", help="Of the pixels' offsets, one sigma.")
    ] = 0.0,
    frame_rate: Annotated[float, Option(metavar="HZ", help="Frames a second.")] = 30.0,
    exposure: Annotated[
        str, Option(metavar="TIME", help="Exposure during which the body moves; 0: it stands still.")
    ] = "0s",
    references: Annotated[
        ReferenceName, Option(help="Dark and bright: taken with a ball, as in a lab, or exact.")
    ] = ReferenceName.ball,
    seed: Annotated[int, Option(help="The same seed, the same recording.")] = 0,
    compression: options.Compression = options.CompressionName.raw,
    overwrite: options.Overwrite = False,
    device: options.Device = None,
    **given: Annotated[Any, MOVEMENT],
) -> None:
    """Record what the twin sees, with the truth."""
    import numpy as np

    from mirrorskin import hw, io
    from mirrorskin.cli.output import printable, progress
    from mirrorskin.cli.quantity import angle, duration, frame_size, length, lengths, vector
    from mirrorskin.hw.twin import Body, Camera

    # A name without a suffix is that of a shape, and not of a file to keep.
    files = [source for source in map(Path, (thing, pattern)) if source.suffix]
    io.check_output(output, *files, replaces="anything" if overwrite else "nothing")
    refuse_foreign(context, motion)
    columns, rows = frame_size(size, "--size")
    along = vector(object_shift, 2, "--object-shift")
    twin = hw.Twin(
        object=thing,
        object_shift=(along[0], along[1]),
        shape=(rows, columns),
        pixel_size=lengths(pixel_size, "--pixel-size"),
        movement=make_movement(motion, frames, given),
        contact=contact.value,
        optics=optics.value,
        pattern=pattern,
        body=Body(
            air_gap=length(air_gap, "--air-gap"),
            asymmetry=asymmetry,
            scatter=angle(scatter, "--scatter"),
            friction=friction,
            modulus=modulus,
        ),
        camera=Camera(
            np.dtype(dtype.value),
            bits=bits,
            noise=noise,
            electrons=float("inf") if electrons is None else electrons,
            gain_deviation=gain_deviation,
            offset_deviation=offset_deviation,
            frame_rate=frame_rate,
            exposure=duration(exposure, "--exposure"),
            point_spread=point_spread,
            distance=float("inf")
            if camera_distance is None
            else length(camera_distance, "--camera-distance"),
            seed=seed,
        ),
        texture=sensor.sheet_texture(texture, texture_size, texture_contrast),
        references=references.value,
        device=device,
    )
    count = twin.shape[0]
    with (
        io.Recorder(
            twin, output, compression.value, truth=lambda: twin.truth, overwrite=overwrite
        ) as recorder,
        progress("simulating", count) as show,
    ):
        recorder.drain(show)
    click.echo(printable(f"{output}: {count} frames of {columns} x {rows}: {twin.header.title}"))


def make_movement(motion: str, frames: int | None, given: Mapping[str, Any]) -> Movement:
    """Return the twin's movement that options describe; `MOVEMENT` has the defaults."""
    import numpy as np

    from mirrorskin import io
    from mirrorskin.cli.quantity import vector
    from mirrorskin.hw import twin

    values = MOVEMENT.filled(given)
    count, press = frames or _FRAMES, values["press"]
    if motion == "vertical":
        travel = io.Steps(values["travel_step"], values["travel_start"]).positions(count)
        if values["strokes"] is not None:
            if values["release"]:
                raise io.InputError("--strokes go up as well: leave --release out")
            travel = twin.oscillating_travel(travel[0], travel[-1], values["strokes"], count)
        if values["release"]:
            travel = np.concatenate([travel, travel[-2::-1]])
        return twin.Vertical(travel, compliance=values["compliance"])
    if motion == "axial":
        step, tilt = values["phase_step"], values["tilt"]
        x, y, z = vector(values["pivot"], 3, "--pivot")
        phase = io.Steps(step).positions(frames or _frames_of_a_turn(step))
        grown = np.arange(1, len(phase) + 1) / len(phase) if values["spiral"] else 1.0
        if values["rock"] is not None:
            towards = np.full(len(phase), values["rock"])
            return twin.Leaning(towards, grown * tilt * np.sin(phase), grown * press, (x, y, z))
        if values["spiral"]:
            return twin.Leaning(phase, grown * tilt, grown * press, (x, y, z))
        return twin.Axial(phase, tilt, press, (x, y, z))
    if motion == "horizontal":
        along = vector(values["displacement_step"], 2, "--displacement-step")
        return twin.Horizontal(np.stack([io.Steps(one).positions(count) for one in along], axis=1), press)
    return twin.Twist(io.Steps(values["twist_step"]).positions(count), press)


def _frames_of_a_turn(step: float) -> int:
    from mirrorskin import io

    # Steps so small that the division overflows are too many as well.
    if 0 < abs(step) < math.tau / FRAMES_MAX:
        raise io.InputError(f"a turn by this --phase-step is more than {FRAMES_MAX} frames: give --frames")
    return max(1, round(math.tau / abs(step))) if step else _FRAMES
