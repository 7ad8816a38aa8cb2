"""``mirrorskin simulate``: a recording from the digital twin, with the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options, sensor
from mirrorskin.cli.groups import Argument, Option

if TYPE_CHECKING:
    from mirrorskin.hw.twin import Movement

# The options that each motion has, and what they are if they are not given.
DEFAULTS: dict[options.MotionName, dict[str, str]] = {
    options.MotionName.vertical: {"travel-step": "0.1mm", "travel-start": "0.1mm", "compliance": "0mm/N"},
    options.MotionName.axial: {
        "press": "1mm",
        "tilt": "2.5deg",
        "phase-step": "45deg",
        "pivot": "0mm,0mm,0mm",
    },
    options.MotionName.horizontal: {"press": "1mm", "displacement-step": "0.01mm,0mm"},
    options.MotionName.twist: {"press": "1mm", "twist-step": "0.2deg"},
}
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


def _of(motion: options.MotionName, name: str, metavar: str, text: str) -> Any:
    """Make an option that only one motion, or all but the vertical one, have."""
    return Option(metavar=metavar, help=text, show_default=DEFAULTS[motion][name])


_VERTICAL, _AXIAL = options.MotionName.vertical, options.MotionName.axial
_HORIZONTAL, _TWIST = options.MotionName.horizontal, options.MotionName.twist


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
    travel_step: Annotated[
        str | None,
        _of(_VERTICAL, "travel-step", "LENGTH", "Vertical: from frame to frame; below zero it is lifted."),
    ] = None,
    travel_start: Annotated[
        str | None, _of(_VERTICAL, "travel-start", "LENGTH", "Vertical: travel of the first frame.")
    ] = None,
    release: Annotated[
        bool, Option("--release", help="Vertical: then lift it by the same steps, frames - 1 more.")
    ] = False,
    strokes: Annotated[
        int | None,
        Option(
            min=2, metavar="N", help="Vertical: N strokes down and up like a cosine, as deep as those steps."
        ),
    ] = None,
    compliance: Annotated[
        str | None,
        _of(
            _VERTICAL,
            "compliance",
            "LENGTH/N",
            "Vertical, elastic: how far the stage gives way.",
        ),
    ] = None,
    press: Annotated[
        str | None, _of(_AXIAL, "press", "LENGTH", "All but vertical: how far the body is lowered.")
    ] = None,
    tilt: Annotated[str | None, _of(_AXIAL, "tilt", "ANGLE", "Axial: half-angle of the precession.")] = None,
    phase_step: Annotated[
        str | None, _of(_AXIAL, "phase-step", "ANGLE", "Axial: from frame to frame.")
    ] = None,
    pivot: Annotated[
        str | None, _of(_AXIAL, "pivot", "X,Y,Z", "Axial: what it turns about, from the sheet's centre.")
    ] = None,
    rock: Annotated[
        str | None,
        Option(
            metavar="ANGLE",
            help="Axial: rock towards this phase, --tilt far, as a sine of the phases of --phase-step.",
        ),
    ] = None,
    spiral: Annotated[
        bool, Option("--spiral", help="Axial: tilt and press grow from nothing, frame by frame.")
    ] = False,
    displacement_step: Annotated[
        str | None, _of(_HORIZONTAL, "displacement-step", "X,Y", "Horizontal: from frame to frame.")
    ] = None,
    twist_step: Annotated[
        str | None, _of(_TWIST, "twist-step", "ANGLE", "Twist: from frame to frame.")
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
    given = {name: context.params[name.replace("-", "_")] for own in DEFAULTS.values() for name in own}
    columns, rows = frame_size(size, "--size")
    along = vector(object_shift, 2, "--object-shift")
    twin = hw.Twin(
        object=thing,
        object_shift=(along[0], along[1]),
        shape=(rows, columns),
        pixel_size=lengths(pixel_size, "--pixel-size"),
        movement=make_movement(motion, frames, release, given, strokes, rock, spiral),
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


def make_movement(
    motion: options.MotionName,
    frames: int | None,
    release: bool,
    given: Mapping[str, str | None],
    strokes: int | None = None,
    rock: str | None = None,
    spiral: bool = False,
) -> Movement:
    """Return the twin's movement that options describe; those not given have the values of ``DEFAULTS``."""
    import numpy as np

    from mirrorskin import io
    from mirrorskin.cli.quantity import angle, compliance, length, vector
    from mirrorskin.hw import twin

    own = DEFAULTS[motion]
    foreign = [f"--{name}" for name, value in given.items() if value is not None and name not in own]
    own_of = {"--release": _VERTICAL, "--strokes": _VERTICAL, "--rock": _AXIAL, "--spiral": _AXIAL}
    special = zip(own_of.items(), (release, strokes, rock, spiral), strict=True)
    foreign += [option for (option, own_motion), value in special if value and own_motion != motion]
    if foreign:
        raise io.InputError(
            f"{foreign[0]} says nothing of a motion that is {motion.value}: leave it out, or choose another"
        )
    words = own | {name: value for name, value in given.items() if value is not None}
    count = frames or _FRAMES
    if motion == options.MotionName.vertical:
        step, start = (length(words[name], f"--{name}") for name in ("travel-step", "travel-start"))
        down = io.Steps(step, start).positions(count)
        if strokes is not None:
            if release:
                raise io.InputError("--strokes go up as well: leave --release out")
            down = twin.oscillating_travel(down[0], down[-1], strokes, count)
        travel = np.concatenate([down, down[-2::-1]]) if release else down
        return twin.Vertical(travel, compliance=compliance(words["compliance"], "--compliance"))
    press = length(words["press"], "--press")
    if motion == options.MotionName.axial:
        step = angle(words["phase-step"], "--phase-step")
        x, y, z = vector(words["pivot"], 3, "--pivot")
        tilt = angle(words["tilt"], "--tilt")
        phase = io.Steps(step).positions(frames or _frames_of_a_turn(step))
        grown = np.arange(1, len(phase) + 1) / len(phase) if spiral else 1.0
        if rock is not None:
            towards = np.full(len(phase), angle(rock, "--rock"))
            return twin.Leaning(towards, grown * tilt * np.sin(phase), grown * press, (x, y, z))
        if spiral:
            return twin.Leaning(phase, grown * tilt, grown * press, (x, y, z))
        return twin.Axial(phase, tilt, press, (x, y, z))
    if motion == options.MotionName.horizontal:
        along = vector(words["displacement-step"], 2, "--displacement-step")
        return twin.Horizontal(np.stack([io.Steps(one).positions(count) for one in along], axis=1), press)
    step = angle(words["twist-step"], "--twist-step")
    return twin.Twist(io.Steps(step).positions(count), press)


def _frames_of_a_turn(step: float) -> int:
    from mirrorskin import io

    # Steps so small that the division overflows are too many as well.
    if 0 < abs(step) < math.tau / FRAMES_MAX:
        raise io.InputError(f"a turn by this --phase-step is more than {FRAMES_MAX} frames: give --frames")
    return max(1, round(math.tau / abs(step))) if step else _FRAMES
