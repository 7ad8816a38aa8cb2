"""``mirrorskin sample``: example data like those of a real sensor."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from mirrorskin.cli.groups import Argument, Option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mirrorskin.io.storage.existing import Replaces
    from mirrorskin.twin import Axial, Camera, Movement, Twin

_SHAPE, _PIXEL = (320, 320), 0.0375  # rows and columns, and mm: a field of 12 mm
_SEED = 11
_STEP, _FRAMES = 0.1, 31  # of the press: mm, from 0, where the skin touches the top of the ball
_PIVOT = (0.3, -0.2, 2.0)  # mm
_AT = ((0.0, 0.0), (-2.2, -2.2), (2.2, -2.2), (-2.2, 2.2), (2.2, 2.2))  # mm, where the balls lie
_FLAT_FRAMES = 16
_BOARD, _DPI = "dots:7x5:1mm", 1200  # as the README prints it
_LEAN = 2e-5  # how obliquely the board's camera looks, 1/pixel
_QUALITY = 3  # quantiser of the video, 2 to 31: the smaller, the better
_BLUR, _NOISE = 0.5, 1.0  # of its picture: pixels and counts, one sigma


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

    replaces: Replaces = "anything" if overwrite else "nothing"
    if name in _FILES and not output.is_dir():
        try:
            output.mkdir()
        except OSError as error:
            raise io.InputError(
                f"{output}: the folder cannot be created: {error.strerror}. Choose another with -o"
            ) from error
    for path in [output / file for file in _FILES[name]] if name in _FILES else [output]:
        io.check_output(path, replaces=replaces)
    _MAKERS[name](output, replaces)
    click.echo(f"{output}: {_HOLDS[name]}")


_FILES = {
    SampleName.calibration: (
        *("dark.h5", "flat.h5", "photo.png", "press-ball.h5", "other.h5"),
        *(f"ball-{number}.h5" for number in range(1, len(_AT) + 1)),
    ),
    SampleName.pictures: [f"frame{number:02d}.png" for number in range(_FRAMES)],
}


_PRESS = f"{_FRAMES} frames from travel 0 to {_STEP * (_FRAMES - 1):g} mm in steps of {_STEP:g} mm"
_HOLDS = {
    SampleName.press: f"a 10 mm ball, {_PRESS}, with the ground truth",
    SampleName.turn: "the same ball in a rotation, 8 phases at a tilt of 2.5 degrees, with the ground truth",
    SampleName.slide: "a 10 mm ball under a textured sheet, 30 frames in steps of 0.01 mm",
    SampleName.calibration: "dark.h5, flat.h5, photo.png, ball-1.h5 to ball-5.h5 (rotations of a 4 mm ball),"
    " press-ball.h5 (a press of a 4 mm ball with 3 N), other.h5 (a rotation of a 6 mm ball)",
    SampleName.stack: f"the frames of 'sample press' as dataset /raw/images without metadata; {_PRESS}",
    SampleName.pictures: f"the frames of 'sample press' as numbered PNG files; {_PRESS}",
    SampleName.video: f"the frames of 'sample press' as a video; {_PRESS}",
}


def _twin(diameter: float, movement: Movement, at: tuple[float, float] = (0.0, 0.0), **more: Any) -> Twin:
    """Return a ball under a sensor whose camera has noise of both kinds, uneven pixels and a lens."""
    from mirrorskin.twin import Camera, Sphere, Twin

    camera = Camera(
        noise=1.0, electrons=40.0, gain_deviation=0.02, offset_deviation=0.5, point_spread=0.5, seed=_SEED
    )
    known: dict[str, Any] = {"shape": _SHAPE, "pixel_size": _PIXEL, "camera": camera, "movement": movement}
    return Twin(object=Sphere(diameter), object_shift=at, **known | more)


def _record(twin: Twin, path: Path, replaces: Replaces) -> None:
    from mirrorskin import io
    from mirrorskin.cli.output import progress

    with (
        io.Recorder(twin, path, truth=lambda: twin.truth, overwrite=replaces == "anything") as recorder,
        progress(f"making {path.name}", twin.shape[0]) as show,
    ):
        recorder.drain(show)


def _pressed() -> Twin:
    from mirrorskin import io
    from mirrorskin.twin import Vertical

    return _twin(10.0, Vertical(io.Steps(_STEP).positions(_FRAMES)))


def _make_press(path: Path, replaces: Replaces) -> None:
    _record(_pressed(), path, replaces)


def _make_turn(path: Path, replaces: Replaces) -> None:
    _record(_twin(10.0, _turn(1.5), pattern="linear"), path, replaces)


def _turn(press: float) -> Axial:
    from mirrorskin import io
    from mirrorskin.twin import Axial

    return Axial(io.Steps(math.pi / 4).positions(8), math.radians(2.5), press, _PIVOT)


def _make_slide(path: Path, replaces: Replaces) -> None:
    import numpy as np

    from mirrorskin.twin import Horizontal, SheetTexture

    way = np.stack([0.01 * np.arange(30), np.zeros(30)], axis=1)
    small: dict[str, Any] = {"shape": (96, 96), "pixel_size": 0.05, "contact": "elastic"}
    _record(_twin(10.0, Horizontal(way, 0.5), texture=SheetTexture("flakes"), **small), path, replaces)


def _frames() -> NDArray[np.uint8]:
    import numpy as np

    twin = _pressed()
    frames = np.empty(twin.shape, np.uint8)
    twin.read(frames)
    return frames


def _make_stack(path: Path, replaces: Replaces) -> None:
    from mirrorskin.io.storage.atomic import new_hdf5

    with new_hdf5(path, replaces) as new:
        new.root["raw/images"] = _frames()


def _make_pictures(folder: Path, replaces: Replaces) -> None:
    for name, frame in zip(_FILES[SampleName.pictures], _frames(), strict=True):
        _write_picture(folder / name, frame, replaces)


def _write_picture(path: Path, picture: NDArray[np.uint8], replaces: Replaces) -> None:
    from mirrorskin.io.formats.pictures import encode_png
    from mirrorskin.io.storage.atomic import write_new

    size = _PIXEL * 1e-3  # m
    write_new(path, encode_png(picture, (size, size)), replaces)


def _make_video(path: Path, replaces: Replaces) -> None:
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
    write_new(path, [file.getvalue()], replaces)


def _make_calibration(folder: Path, replaces: Replaces) -> None:
    """Record the calibration frames of a sensor with a real wall, uneven lamps and a lens near the sheet."""
    import numpy as np

    from mirrorskin.twin import Body, Camera, Vertical

    camera = Camera(noise=1.5, gain_deviation=0.05, distance=200.0, seed=_SEED)
    body = Body(asymmetry=0.05, asymmetry_azimuth=0.7)
    real: dict[str, Any] = {"optics": "cylinder", "pattern": "linear", "body": body, "camera": camera}
    for name, light in (("dark", 0.0), ("flat", 1.0)):
        _record_flat(folder / f"{name}.h5", camera, light, replaces)
    for number, at in enumerate(_AT, 1):
        _record(_twin(4.0, _turn(0.4), at, **real), folder / f"ball-{number}.h5", replaces)
    _record(_twin(6.0, _turn(0.8), (0.5, -0.4), **real), folder / "other.h5", replaces)
    travel = Vertical(np.arange(0.0, 1.21, 0.04))
    _record(_twin(4.0, travel, contact="elastic", **real), folder / "press-ball.h5", replaces)
    _write_picture(folder / "photo.png", _photograph(), replaces)


def _record_flat(path: Path, camera: Camera, light: float, replaces: Replaces) -> None:
    """Record a uniform field."""
    import numpy as np

    from mirrorskin import io
    from mirrorskin.io.files.arrays import ArrayRecording
    from mirrorskin.twin.camera import Sensor

    sensor, field = Sensor(camera, _SHAPE), np.full(_SHAPE, light, np.float32)
    frames = np.empty((_FLAT_FRAMES, *_SHAPE), sensor.dtype)
    for number, frame in enumerate(frames):
        sensor.expose(field, number + round(light) * _FLAT_FRAMES, frame)
    header = {"title": f"flat field, light {light:g}", "pixel_size": (_PIXEL, _PIXEL)}
    phase = np.linspace(0, math.tau, _FLAT_FRAMES, endpoint=False)
    source = ArrayRecording(frames, {"phase": phase}, header)
    with io.Recorder(source, path, overwrite=replaces == "anything") as recorder:
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
    seen = cv2.warpPerspective(smooth, lean @ place, _SHAPE[::-1], borderValue=255)
    noisy = 30 + 0.7 * seen + _NOISE * np.random.default_rng(_SEED).standard_normal(_SHAPE)
    return np.rint(noisy).astype(np.uint8)


_MAKERS: dict[SampleName, Callable[[Path, Replaces], None]] = {
    SampleName.press: _make_press,
    SampleName.turn: _make_turn,
    SampleName.slide: _make_slide,
    SampleName.calibration: _make_calibration,
    SampleName.stack: _make_stack,
    SampleName.pictures: _make_pictures,
    SampleName.video: _make_video,
}
