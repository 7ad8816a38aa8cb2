"""`mirrorskin calibrate scale` and `board`: from a printed board to a lens in a file."""

import json
import re
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibrations import a_calibration
from commands import done, run
from stacks import MadeUp, record

from mirrorskin import io
from mirrorskin.cli.commands.calibrate.scale import board_command, command
from mirrorskin.engine.calibration import Charuco, Dots, calibrate_lens, paint_board
from mirrorskin.io.model.calibrated import size_facts

CHARUCO = "charuco:7x5:2mm:1.5mm"
TO = ["--board", CHARUCO, "-o", "cal.h5"]
PER_MM = 14
SHOWN = (30 + 0.7 * paint_board(Charuco(7, 5, 2.0, 1.5), 25.4 * PER_MM)).astype(np.uint8)
DOTTED = (30 + 0.7 * paint_board(Dots(7, 6, 1.0), 25.4 * PER_MM)).astype(np.uint8)


@pytest.fixture(autouse=True)
def here():
    cv2.imwrite("a.png", SHOWN)


def recorded(frames, path="rec.h5", camera="lab"):
    header = io.Header("vertical", camera=camera)
    record(MadeUp(frames, header, travel=np.arange(len(frames)) * 0.05), path)


def calibrate(*words):
    return run("calibrate scale", *words)


def test_a_picture_becomes_a_lens_in_a_file():
    ended = calibrate("a.png", *TO)
    assert ended.code == 0, ended.said
    assert ended.said == ""
    assert ended.out.startswith("cal.h5: 71.4")
    assert "24 marks in 1 picture " in ended.out
    calibration = io.open_calibration("cal.h5")
    assert calibration.camera.shape == calibration.lens.shape == SHOWN.shape
    assert calibration.camera.dtype == np.uint8
    assert calibration.lens.pixel_size == pytest.approx((1 / PER_MM,) * 2, rel=1e-3)
    assert 0 < calibration.lens.scale_sigma < 1e-3
    assert calibration.process["scale.board"] == CHARUCO
    assert calibration.process["scale.sources"] == "a.png"


def test_dots_do_as_well_and_json_contains_it():
    cv2.imwrite("dots.png", DOTTED)
    ended = calibrate("dots.png", "dots.png", "--board", "dots:7x6:1mm", "-o", "cal.h5", "--json")
    assert ended.code == 0, ended.said
    report = json.loads(ended.out)
    assert report["pixel_size"] == pytest.approx(1 / PER_MM, rel=1e-3)
    assert [entry["marks"] for entry in report["pictures"]] == [42, 42]
    assert report["pixel_size_sigma"] < 1e-4


def test_a_recording_is_averaged_and_names_its_camera():
    random = np.random.default_rng(0)
    frames = SHOWN.astype(float) + 20 * random.standard_normal((12, *SHOWN.shape))
    recorded(np.clip(np.rint(frames), 0, 255).astype(np.uint8))
    ended = calibrate("rec.h5", *TO)
    assert ended.code == 0, ended.said
    calibration = io.open_calibration("cal.h5")
    assert calibration.camera.name == "lab"
    alone = calibrate_lens([("one", frames[0].astype(np.float32))], Charuco(7, 5, 2.0, 1.5))
    assert calibration.lens.error < alone.lens.error


def test_pictures_may_have_fewer_bits_than_the_camera():
    recorded(np.stack([SHOWN.astype(np.uint16) * 257] * 3))
    assert calibrate("rec.h5", *TO).code == 0
    ended = calibrate("a.png", *TO)
    assert ended.code == 0, ended.said
    calibration = io.open_calibration("cal.h5")
    assert (calibration.camera.name, calibration.camera.dtype) == ("lab", np.uint16)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "no picture of a board is given"),
        (["."], "sequence: name pictures"),
        (["dots.png"], "dots.png shows no board charuco:7x5:2mm:1.5mm"),
        (["white.png"], "saturated"),
        (["pages.tif"], "pages.tif contains several pages"),
        (["a.png", "small.png"], "a.png and small.png differ"),
        (["moving.h5"], "moving.h5 is a sequence in which the picture changes"),
    ],
)
def test_what_is_not_a_picture_of_the_board_is_refused(words, message, tmp_path):
    cv2.imwrite("dots.png", DOTTED)
    cv2.imwrite("white.png", np.full_like(SHOWN, 255))
    cv2.imwrite("small.png", SHOWN[1:])
    cv2.imwritemulti("pages.tif", [SHOWN, SHOWN])
    recorded(np.stack([np.roll(SHOWN, k, 0) for k in range(5)]), "moving.h5")
    # The folder that is given must not be that of the file.
    (tmp_path / "to").mkdir()
    with pytest.raises(io.InputError, match=re.escape(message)):
        command(Path("to/cal.h5"), CHARUCO, [Path(word) for word in words])
    assert not (tmp_path / "to" / "cal.h5").exists()


def test_a_board_is_painted_in_its_true_size():
    ended = done("calibrate board --board", CHARUCO, "-o", "board.png", "--dpi", "508")
    assert "18.00 x 14.00 mm" in ended.out
    data = Path("board.png").read_bytes()
    at = data.index(b"pHYs") + 4
    assert struct.unpack(">IIB", data[at : at + 9]) == (20_000, 20_000, 1)
    shown = cv2.imread("board.png", cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(shown, paint_board(Charuco(7, 5, 2.0, 1.5), 508))


@pytest.mark.parametrize(
    ("path", "dpi", "message"),
    [
        ("board.jpg", 2540, "name it board.png"),
        ("b.png", 0, "pixels per inch of a printer"),
        ("b.png", 50, "dots per inch or more are needed"),
        ("b.png", 90_000, "fewer dots per inch"),
    ],
)
def test_a_board_that_cannot_be_painted_is_refused(path, dpi, message):
    with pytest.raises(io.InputError, match=message):
        board_command(Path(path), CHARUCO, dpi)
    assert not Path(path).exists()


@pytest.mark.parametrize(("before", "again"), [(1 / PER_MM, []), (1.01 / PER_MM, ["zenith", "elastic"])])
def test_what_was_made_with_other_pixels_is_named(before, again):
    facts = size_facts((before, before))
    process = {f"{part}.{key}": value for part in ("zenith", "elastic") for key, value in facts.items()}
    parts = a_calibration(SHOWN.shape, name="", only=["zenith", "gel"])
    io.save_calibration(
        io.Calibration(parts.camera, zenith=parts.zenith, gel=parts.gel, process=process), "cal.h5"
    )
    ended = calibrate("a.png", *TO)
    assert ended.code == 0, ended.said
    text = f"learn {', '.join(again)} again: made with another pixel size\n" if again else ""
    assert ended.said == text
