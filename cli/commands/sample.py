"""``mirrorskin sample``: example data like those of a real sensor; see `mirrorskin.cli.commands.simulate`."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from mirrorskin.cli.commands.simulate import make_twin, preset, record
from mirrorskin.cli.groups import Argument, Option
from mirrorskin.cli.output import make_folder

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


_SHAPE, _PIXEL = (320, 320), 0.0375  # rows and columns, and mm: a field of 12 mm
_SEED = 11
_STEP, _FRAMES = 0.1, 31  # of the press: mm, from 0, where the skin touches the top of the ball
_FLAT_FRAMES = 16
_BOARD, _DPI = "dots:7x5:1mm", 1200  # as the README prints it
_LEAN = 2e-5  # how obliquely the board's camera looks, 1/pixel
_QUALITY = 3  # quantiser of the video, 2 to 31: the smaller, the better
_BLUR, _NOISE = 0.5, 1.0  # of the board's picture: pixels and counts, one sigma

# Motions and options of 'simulate'.
_FIELD = f"--size 320x320 --pixel-size {_PIXEL}mm --references exact --seed {_SEED}"
_SENSOR = f"{_FIELD} --noise 1 --electrons 40 --gain-deviation 0.02 --offset-deviation 0.5 --point-spread 0.5"
_TURN = "--frames 8 --tilt 2.5deg --pivot 0.3mm,-0.2mm,2mm --pattern linear"
PRESS = f"vertical {_SENSOR} --frames {_FRAMES} --travel-start 0mm --travel-step {_STEP}mm"
TURN = f"axial {_SENSOR} {_TURN} --press 1.5mm"
_SLIDE = (
    f"horizontal {_SENSOR} --size 96x96 --pixel-size 0.05mm --contact elastic --texture flakes"
    " --frames 30 --displacement-step 0.01mm,0mm --press 0.5mm"
)
# The sensor of 'calibration' has a real wall, uneven lamps and a lens near the sheet.
_REAL = f"{_FIELD} --optics cylinder --pattern linear --gain-deviation 0.05 --camera-distance 200mm"
_AT = ("0mm,0mm", "-2.2mm,-2.2mm", "2.2mm,-2.2mm", "-2.2mm,2.2mm", "2.2mm,2.2mm")  # where the balls are
_BALLS = {  # the diameter of the ball, mm, and the recording
    **{
        f"ball-{number}.h5": (4.0, f"axial {_REAL} {_TURN} --press 0.4mm --object-shift {at}")
        for number, at in enumerate(_AT, 1)
    },
    "other.h5": (6.0, f"axial {_REAL} {_TURN} --press 0.8mm --object-shift 0.5mm,-0.4mm"),
    "press-ball.h5": (
        4.0,
        f"vertical {_REAL} --frames 31 --travel-start 0mm --travel-step 0.04mm --contact elastic",
    ),
}


class SampleName(StrEnum):
    """The samples."""

    press = "press"
    turn = "turn"
    slide = "slide"
    calibration = "calibration"
    stack = "stack"
    pictures = "pictures"
    video = "video"


def command(
    name: Annotated[SampleName, Argument(help="Sample to write.")],
    output: Annotated[
        Path,
        Option("--output", "-o", metavar="FILE-OR-FOLDER", help="Folder for calibration and pictures."),
    ],
    overwrite: Annotated[bool, Option("--overwrite", help="Replace existing files of these names.")] = False,
) -> None:
    """Write example data.

    press: frames of a 10 mm ball under a press from 0 to 3 mm, with the ground truth (.h5). turn: the same
    ball in a rotation. slide: a textured sheet that slides (.h5). calibration: every recording that the
    calibration of a sensor needs. stack, pictures and video: the frames of 'press' as other programs store
    them, an HDF5 stack without metadata, numbered PNG files, and an AVI file. Light, lens and pixels are
    those of a real camera; the sensor of 'calibration' also has a real wall and uneven lamps. 'simulate' has
    an option for each of these properties.
    """
    from mirrorskin import io

    files = _FILES.get(name)
    if files:
        make_folder(output)
    for path in [output / file for file in files] if files else [output]:
        io.check_output(path, replaces="anything" if overwrite else "nothing")
    holds, write = _SAMPLES[name]
    write(output, overwrite)
    click.echo(f"{output}: {holds}")


def _recorder(line: str) -> Callable[[Path, bool], None]:
    """Return a function that records a preset."""

    def write(path: Path, overwrite: bool) -> None:
        record(make_twin(*preset(line)), path, overwrite, label=f"making {path.name}")

    return write


def _frames() -> NDArray[np.uint8]:
    import numpy as np

    twin = make_twin(*preset(PRESS))
    frames = np.empty(twin.shape, np.uint8)
    twin.read(frames)
    return frames


def _write_stack(path: Path, overwrite: bool) -> None:
    from mirrorskin.io.storage.atomic import new_hdf5

    with new_hdf5(path, "anything" if overwrite else "nothing") as new:
        new.root["raw/images"] = _frames()


def _write_pictures(folder: Path, overwrite: bool) -> None:
    for name, frame in zip(_FILES[SampleName.pictures], _frames(), strict=True):
        _write_picture(folder / name, frame, overwrite)


def _write_picture(path: Path, picture: NDArray[np.uint8], overwrite: bool) -> None:
    from mirrorskin.io.formats.pictures import encode_png
    from mirrorskin.io.storage.atomic import write_new

    size = _PIXEL * 1e-3  # m
    write_new(path, encode_png(picture, (size, size)), "anything" if overwrite else "nothing")


def _write_video(path: Path, overwrite: bool) -> None:
    from io import BytesIO

    from mirrorskin.io import InputError
    from mirrorskin.io.formats.video import load_av
    from mirrorskin.io.storage.atomic import write_new

    if path.suffix.lower() != ".avi":
        raise InputError(f"{path}: cannot be written as a video. Choose a name that ends in .avi")
    av, file = load_av(path), BytesIO()
    with av.open(file, "w", format="avi") as film:
        stream = film.add_stream("mjpeg", rate=10)
        stream.height, stream.width, stream.pix_fmt = *_SHAPE, "yuvj420p"
        stream.codec_context.qmin = stream.codec_context.qmax = _QUALITY
        for frame in _frames():
            film.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "gray").reformat(format="yuvj420p")))
        film.mux(stream.encode(None))
    write_new(path, [file.getvalue()], "anything" if overwrite else "nothing")


def _write_calibration(folder: Path, overwrite: bool) -> None:
    """Write what the calibration of a sensor needs."""
    from mirrorskin.twin import Body, Sphere

    for number, name in enumerate(_FLATS):
        _record_flat(folder / name, number, overwrite)
    body = Body(asymmetry=0.05, asymmetry_azimuth=0.7)
    for name, (diameter, line) in _BALLS.items():
        motion, values = preset(line)
        twin = make_twin(motion, values | {"object": Sphere(diameter)}, body)
        record(twin, folder / name, overwrite, label=f"making {name}")
    _write_picture(folder / "photo.png", _photograph(), overwrite)


def _record_flat(path: Path, light: int, overwrite: bool) -> None:
    """Record a uniform field, dark (0) or bright (1)."""
    import numpy as np

    from mirrorskin import io
    from mirrorskin.io.files.arrays import ArrayRecording
    from mirrorskin.twin import Camera
    from mirrorskin.twin.camera import Sensor

    camera = Camera(noise=1.5, gain_deviation=0.05, distance=200.0, seed=_SEED)
    sensor, field = Sensor(camera, _SHAPE), np.full(_SHAPE, light, np.float32)
    frames = np.empty((_FLAT_FRAMES, *_SHAPE), sensor.dtype)
    for number, frame in enumerate(frames):
        sensor.expose(field, number + light * _FLAT_FRAMES, frame)
    header = {"title": f"flat field, light {light}", "pixel_size": (_PIXEL, _PIXEL)}
    phase = np.linspace(0, math.tau, _FLAT_FRAMES, endpoint=False)
    source = ArrayRecording(frames, {"phase": phase}, header)
    with io.Recorder(source, path, overwrite=overwrite) as recorder:
        recorder.drain()


def _photograph() -> NDArray[np.uint8]:
    """Return a picture of the printed board on the sheet, seen a little obliquely."""
    import cv2
    import numpy as np

    from mirrorskin.cli.commands.calibrate.scale import board_of
    from mirrorskin.engine.calibration.board import paint_board

    print_ = paint_board(board_of(_BOARD), _DPI)
    scale = 25.4 / _DPI / _PIXEL
    middle = (np.array(_SHAPE[::-1]) - 1) / 2 - scale * (np.array(print_.shape[::-1]) - 1) / 2
    place = np.array([[scale, 0, middle[0]], [0, scale, middle[1]], [0, 0, 1.0]])
    lean = np.array([[1, 0, 0], [0, 1, 0], [_LEAN, -_LEAN, 1.0]])
    smooth = cv2.GaussianBlur(print_, (0, 0), _BLUR / scale)
    picture = cv2.warpPerspective(smooth, lean @ place, _SHAPE[::-1], borderValue=255)
    noisy = 30 + 0.7 * picture + _NOISE * np.random.default_rng(_SEED).standard_normal(_SHAPE)
    return np.rint(noisy).astype(np.uint8)


_FLATS = ("dark.h5", "flat.h5")
_FILES = {
    SampleName.calibration: [*_FLATS, "photo.png", "press-ball.h5", *_BALLS],
    SampleName.pictures: [f"frame{number:02d}.png" for number in range(_FRAMES)],
}
_PRESSED = f"{_FRAMES} frames from travel 0 to {_STEP * (_FRAMES - 1):g} mm in steps of {_STEP:g} mm"
# What the command prints of each sample, and the function that writes it.
_SAMPLES: dict[SampleName, tuple[str, Callable[[Path, bool], None]]] = {
    SampleName.press: (f"a 10 mm ball, {_PRESSED}, with the ground truth", _recorder(PRESS)),
    SampleName.turn: (
        "the same ball in a rotation, 8 phases at a tilt of 2.5 degrees, with the ground truth",
        _recorder(TURN),
    ),
    SampleName.slide: (
        "a 10 mm ball under a textured sheet, 30 frames in steps of 0.01 mm",
        _recorder(_SLIDE),
    ),
    SampleName.calibration: (
        "dark.h5, flat.h5, photo.png, ball-1.h5 to ball-5.h5 (rotations of a 4 mm ball),"
        " press-ball.h5 (a press of a 4 mm ball with 3 N), other.h5 (a rotation of a 6 mm ball)",
        _write_calibration,
    ),
    SampleName.stack: (
        f"the frames of 'sample press' as dataset /raw/images without metadata; {_PRESSED}",
        _write_stack,
    ),
    SampleName.pictures: (f"the frames of 'sample press' as numbered PNG files; {_PRESSED}", _write_pictures),
    SampleName.video: (f"the frames of 'sample press' as a video; {_PRESSED}", _write_video),
}
