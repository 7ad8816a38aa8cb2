"""``mirrorskin simulate``: a recording from the digital twin, with the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli import options
from mirrorskin.cli.commands.sensor import sensor_options, sensor_terms
from mirrorskin.cli.declared import Terms, term
from mirrorskin.cli.groups import Argument, refuse_foreign

if TYPE_CHECKING:
    from mirrorskin.twin import Body, Movement, Twin

FRAMES_MAX = 10**7
_FRAMES = 30


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


TWIN = Terms(
    [
        *sensor_terms("480x480", "0.025mm").terms,
        term(
            "object_shift",
            "centre of the object from the picture's",
            "X,Y",
            "0mm,0mm",
            kind="text",
        ),
        term(
            "frames",
            "frames to record",
            kind="integer",
            least=1,
            most=FRAMES_MAX,
            shown="30; of a rotation one turn",
        ),
        *MOVEMENT.terms,
        term("air_gap", "gap between body and wall", "mm", "0mm"),
        term("asymmetry", "asymmetry of the lamps, as a share of their light", "", "0"),
        term("scatter", "scatter of the sheet's flakes", "rad", "3deg"),
        term("friction", "coefficient between sheet and object", "", "0.8"),
        term("modulus", "Young's modulus of the body, which scales all forces", "MPA", "1.0"),
        term("camera_distance", "pinhole above the sheet", "mm", shown="rays are parallel"),
        term("point_spread", "blur of the lens, one sigma", "pixels", "0"),
        term("dtype", "type of a sample", default="uint8", choices=("uint8", "uint16", "float32")),
        term("bits", "bits of a uint16 sample: 10, 12 or 16", kind="integer", shown="12"),
        term("noise", "read noise, one sigma", "counts", "1.5"),
        term("electrons", "electrons in one count of these bits, for shot noise", shown="no shot noise"),
        term("gain_deviation", "deviation of the pixels' gains, one sigma", "", "0"),
        term("offset_deviation", "deviation of the pixels' offsets, one sigma", "counts", "0"),
        term("frame_rate", "frames a second", "Hz", "30"),
        term("exposure", "time during which the body moves in each frame", "s", "0s"),
        term(
            "references",
            "dark and bright are recorded with a ball, as in a lab, or are exact",
            default="ball",
            choices=("ball", "exact"),
        ),
        term("seed", "the same seed gives the same recording", "", "0", kind="integer"),
    ]
)
_BODY = ("air_gap", "asymmetry", "scatter", "friction", "modulus")
_CAMERA = (
    *("bits", "noise", "gain_deviation", "offset_deviation", "frame_rate", "exposure", "point_spread"),
    "seed",
)


def command(
    context: click.Context,
    motion: Annotated[options.MotionName, Argument(help="How the body moves.")],
    output: options.NewRecording,
    compression: options.Compression = options.CompressionName.raw,
    overwrite: options.Overwrite = False,
    device: options.Device = None,
    **chosen: Annotated[Any, TWIN],
) -> None:
    """Record what the twin sees, with the truth."""
    from mirrorskin import io
    from mirrorskin.cli.output import printable

    values = TWIN.filled(chosen)
    # A name without a suffix is a shape, and not a file to keep.
    files = [source for name in ("object", "pattern") if (source := Path(values[name])).suffix]
    io.check_output(output, *files, replaces="anything" if overwrite else "nothing")
    refuse_foreign(context, motion)
    twin = make_twin(motion, values, device=device)
    for name in ("friction", "modulus"):
        if name in chosen and values["contact"] != "elastic":
            raise io.InputError(f"--{name} needs --contact elastic: a sheet that only conforms has no forces")
    record(twin, output, overwrite, compression)
    count, rows, columns = twin.shape
    click.echo(printable(f"{output}: {count} frames of {columns} x {rows}: {twin.header.title}"))


def make_twin(
    motion: str, values: Mapping[str, Any], body: Body | None = None, device: str | None = None
) -> Twin:
    """Return the twin that values of all options describe, or with another body than that."""
    import numpy as np

    from mirrorskin.cli.quantity import vector
    from mirrorskin.twin import Body, Camera, Twin

    right, up = vector(values["object_shift"], 2, "--object-shift")
    return Twin(
        object=values["object"],
        object_shift=(right, up),
        **sensor_options(values),
        movement=_make_movement(motion, values),
        body=body or Body(**{name: values[name] for name in _BODY}),
        camera=Camera(
            np.dtype(values["dtype"]),
            **{name: values[name] for name in _CAMERA},
            electrons=math.inf if values["electrons"] is None else values["electrons"],
            distance=math.inf if values["camera_distance"] is None else values["camera_distance"],
        ),
        references=values["references"],
        device=device,
    )


def preset(line: str) -> tuple[str, dict[str, Any]]:
    """Return the motion and the values of all options of a command line."""
    motion, *words = line.split()
    context = click.Command("simulate", params=[*TWIN.parameters()]).make_context("simulate", words)
    values = {name: value for name, value in context.params.items() if value is not None}
    return motion, TWIN.filled(values)


def record(
    twin: Twin,
    output: Path,
    overwrite: bool,
    compression: options.CompressionName = options.CompressionName.raw,
    label: str = "simulating",
) -> None:
    """Write the recording of a twin and the truth; the label is that of the progress bar."""
    from mirrorskin import io
    from mirrorskin.cli.output import progress

    with (
        io.Recorder(
            twin, output, compression.value, truth=lambda: twin.truth, overwrite=overwrite
        ) as recorder,
        progress(label, twin.shape[0]) as show,
    ):
        recorder.drain(show)


def _make_movement(motion: str, values: Mapping[str, Any]) -> Movement:
    """Return the twin's movement that options describe."""
    import numpy as np

    from mirrorskin import io, twin
    from mirrorskin.cli.quantity import vector

    frames, press = values["frames"], values["press"]
    count = frames or _FRAMES
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
        return twin.Horizontal(np.stack([io.Steps(step).positions(count) for step in along], axis=1), press)
    return twin.Twist(io.Steps(values["twist_step"]).positions(count), press)


def _frames_of_a_turn(step: float) -> int:
    from mirrorskin import io

    # For very small steps the division overflows: these are too many as well.
    if 0 < abs(step) < math.tau / FRAMES_MAX:
        raise io.InputError(f"a turn by this --phase-step is more than {FRAMES_MAX} frames: give --frames")
    return max(1, round(math.tau / abs(step))) if step else _FRAMES
