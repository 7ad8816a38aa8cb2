"""`mirrorskin simulate`: recordings are as requested, and impossible requests are refused."""

from __future__ import annotations

import itertools
import math
import re
from pathlib import Path

import cv2
import geometry
import numpy as np
import pytest
from commands import done, refused, run
from stacks import read_all

import mirrorskin.twin
from mirrorskin import io
from mirrorskin.cli.commands.simulate import TWIN
from mirrorskin.io.base.types import MOTIONS
from mirrorskin.twin import OBJECT_NAMES, Body, Camera, SheetTexture, Twin

SMALL = ["--size", "24x18", "--pixel-size", "0.4mm"]
SHAPE, PIXEL = (18, 24), 0.4
EXACT = ["--references", "exact"]


def simulate(motion, *words, size=SMALL):
    """Simulate, and return the recording's frames and positions, and the recording, which is closed."""
    path = f"{next(_NUMBER)}.h5"
    code, out, errors = run("simulate", motion, *size, *words, "-o", path)
    assert (code, errors) == (0, ""), errors
    with io.open_recording(path) as recording:
        block = read_all(recording, 7)
        assert recording.truth is not None  # it is kept
    columns, rows = recording.shape[:0:-1]
    start = f"{path}: {recording.shape[0]} frames of {columns} x {rows}: Digital twin, "
    assert out.startswith(start)
    assert f", {motion} motion" in out
    assert out.count("\n") == 1
    return block, recording


_NUMBER = itertools.count()


# What is given for each motion, and what then must be in the recording.
GIVEN = {
    "vertical": ["--travel-start", "0.5mm", "--travel-step", "200um"],
    "axial": ["--press", "1.5mm", "--tilt", "4deg", "--phase-step=-20deg", "--pivot", "1mm,-2mm,0.03m"],
    "horizontal": ["--press", "0.8mm", "--displacement-step=0.02mm,-0.05mm"],
    "twist": ["--press", "0.8mm", "--twist-step=-0.5deg"],
}
STEPS = np.arange(5.0)
RECORDED = {
    "vertical": ("travel", 0.5 + 0.2 * STEPS),
    "axial": ("phase", np.radians(-20) * STEPS),
    "horizontal": ("displacement", np.stack([0.02 * STEPS, -0.05 * STEPS], axis=1)),
    "twist": ("twist", np.radians(-0.5) * STEPS),
}


def test_strokes_go_up_and_down_as_far_as_the_steps_would():
    block, _ = simulate(
        "vertical", "--travel-start", "0.5mm", "--travel-step", "0.2mm", "--strokes", "2", "--frames", "5"
    )
    np.testing.assert_allclose(block.travel, 0.5 + 0.8 * np.array([0, 0.5, 1, 0.5, 0]), atol=1e-12)
    refused("leave --release out", "simulate vertical --strokes 3 --release -o a.h5")


def test_a_body_rocks_or_spirals_as_requested():
    phases = np.arange(5) * np.pi / 4
    _, rocked = simulate("axial", "--tilt", "4deg", "--rock", "30deg", "--frames", "5")
    np.testing.assert_allclose(rocked.tilt, np.radians(4) * np.sin(phases), atol=1e-12)
    np.testing.assert_allclose(rocked.phase, np.radians(30))
    assert (rocked.header.tilt, rocked.header.press) == (None, 1.0)
    _, wound = simulate("axial", "--tilt", "4deg", "--spiral", "--press", "1.5mm", "--frames", "5")
    np.testing.assert_allclose(wound.tilt, np.radians(4) * np.arange(1, 6) / 5)
    np.testing.assert_allclose(wound.travel, 1.5 * np.arange(1, 6) / 5)
    np.testing.assert_allclose(wound.phase, phases)
    assert wound.header.press is None


@pytest.mark.parametrize("contact", ["conform", "elastic"])
def test_an_object_is_where_it_is_shifted_to(contact):
    words = ["--frames", "2", "--press", "1mm", "--contact", contact, *EXACT]
    centred, shifted = (
        simulate("horizontal", *words, *more)[1].truth for more in ([], ["--object-shift=1.2mm,-0.8mm"])
    )
    right, down = 3, 2  # pixels
    for name in ("height", "zenith", "azimuth", "contact"):
        moved = getattr(shifted, name)[down:, right:]
        np.testing.assert_allclose(moved, getattr(centred, name)[:-down, :-right], atol=1e-5, err_msg=name)
    refused("2 lengths are needed", "simulate vertical --object-shift 1mm -o a.h5")
    refused("larger than the sensor", "simulate vertical --object-shift 50mm,0mm -o a.h5")


@pytest.mark.parametrize("contact", ["conform", "elastic"])
@pytest.mark.parametrize("motion", MOTIONS)
def test_each_motion_is_recorded_as_it_is_given(motion, contact):
    words = [*GIVEN[motion], "--frames", "5", "--contact", contact, *EXACT]
    block, recording = simulate(motion, *words)
    assert block.frames.shape == (5, *SHAPE)
    assert block.frames.dtype == np.uint8
    name, positions = RECORDED[motion]
    for series, values in dict.fromkeys(("travel", "phase", "displacement", "twist")).items():
        expected = positions if series == name else values
        if expected is None:
            assert getattr(block, series) is None
        else:
            np.testing.assert_allclose(getattr(block, series), expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(block.time, STEPS / 30)
    header = recording.header
    assert recording.motion == header.motion == motion
    assert header.pixel_size == (PIXEL, PIXEL)
    press = {"vertical": None, "axial": 1.5, "horizontal": 0.8, "twist": 0.8}[motion]
    assert header.press == press
    assert header.tilt == (pytest.approx(math.radians(4)) if motion == "axial" else None)
    assert header.pivot == (pytest.approx((1, -2, 30)) if motion == "axial" else None)


@pytest.mark.parametrize("motion", ["horizontal", "twist"])
def test_elastic_contact_includes_where_the_sheet_slips(motion):
    words = [*GIVEN[motion], "--frames", "4", "--contact", "elastic", *EXACT]
    slips = [simulate(motion, *words, "--friction", friction)[1].truth for friction in ("0", "0.05", "100")]
    frictionless, some, rough = ((truth.slip, truth.contact) for truth in slips)
    assert frictionless[0][frictionless[1] == 1].all()
    # Even the roughest contact slips at its rim, where there is no pressure.
    assert rough[0].sum() < some[0].sum() <= frictionless[0].sum()
    assert some[0].sum() > 0


def documented():
    """Return the defaults that --help tells, by option."""
    code, out, _ = run("simulate --help")
    assert code == 0
    entries = re.split(r"\n\s+(?=--|-o)", out)
    defaults = {}
    for entry in entries:
        name = re.match(r"(--[a-z-]+)", entry)
        default = re.search(r"\[default:\s+([^\]]*)\]", entry)
        if name and default:
            defaults[name[1]] = " ".join(default[1].strip("()").split())
    return defaults


@pytest.fixture
def asked(monkeypatch):
    """What the twin was asked for, call by call."""
    calls = []
    twin = Twin

    def spy(**options):
        calls.append(options)
        return twin(**options)

    monkeypatch.setattr(mirrorskin.twin, "Twin", spy)
    return calls


def test_without_options_a_press_is_the_documented_one():
    defaults = documented()
    block, _ = simulate("vertical", *EXACT)
    assert len(block.travel) == 30
    assert defaults["--frames"].startswith("30; of a rotation one turn")
    assert defaults["--travel-start"] == defaults["--travel-step"] == "0.1mm"
    np.testing.assert_allclose(block.travel, 0.1 * np.arange(1, 31))
    assert defaults["--frame-rate"] == "30"
    np.testing.assert_allclose(block.time, np.arange(30) / 30)


def test_without_options_a_rotation_is_one_turn_of_the_documented_one():
    defaults = documented()
    block, recording = simulate("axial", *EXACT)
    assert (defaults["--phase-step"], defaults["--tilt"], defaults["--press"]) == ("45deg", "2.5deg", "1mm")
    np.testing.assert_allclose(block.phase, np.arange(8) * np.pi / 4)
    assert recording.header.tilt == pytest.approx(math.radians(2.5))
    assert recording.header.press == 1
    assert defaults["--pivot"] == "0mm,0mm,0mm"
    assert recording.header.pivot == (0, 0, 0)


@pytest.mark.parametrize(("step", "count"), [("45deg", 8), ("-90deg", 4), ("50deg", 7), ("0deg", 30)])
def test_a_turn_has_as_many_frames_as_steps_fit_in_it(step, count):
    assert len(simulate("axial", f"--phase-step={step}", *EXACT)[0].phase) == count


def test_without_options_the_field_is_the_documented_one(asked, monkeypatch):
    defaults = documented()

    def refuse(**options):
        asked.append(options)
        raise io.InputError("enough is known")

    monkeypatch.setattr(mirrorskin.twin, "Twin", refuse)
    refused("enough is known", "simulate vertical -o a.h5")
    rows, columns = asked[0]["shape"]
    assert f"{columns}x{rows}" == defaults["--size"] == "480x480"
    assert asked[0]["pixel_size"] == (0.025, 0.025)
    assert defaults["--pixel-size"] == "0.025mm"


def test_without_options_body_and_camera_are_the_twin_s_own(asked):
    defaults = documented()
    simulate("vertical", "--frames", "2")
    (arguments,) = asked
    assert arguments["body"] == Body()
    assert arguments["camera"] == Camera()
    chosen = {name: arguments[name] for name in ("object", "contact", "optics", "pattern", "references")}
    assert chosen == {name: defaults[f"--{name}"] for name in chosen}
    assert chosen["references"] == "ball"
    assert arguments["texture"] is None
    size, contrast = SheetTexture().size, SheetTexture().contrast
    assert (defaults["--texture-size"], defaults["--texture-contrast"]) == (f"{size:g}mm", str(contrast))
    for option, value in (("--friction", Body().friction), ("--noise", Camera().noise)):
        assert float(defaults[option]) == value
    assert defaults["--scatter"] == f"{math.degrees(Body().scatter):g}deg"
    assert defaults["--bits"] == str(Camera(np.dtype(np.uint16)).bits)
    assert defaults["--dtype"] == Camera().dtype.name


WALL = ["--optics", "cylinder"]


@pytest.mark.parametrize(
    ("words", "part", "expected"),
    [
        (["--object", "cone"], "object", "cone"),
        (["--contact", "elastic"], "contact", "elastic"),
        (WALL, "optics", "cylinder"),
        (["--pattern", "linear"], "pattern", "linear"),
        ([*WALL, "--air-gap", "0.5mm"], "body", Body(air_gap=0.5)),
        ([*WALL, "--asymmetry", "0.2"], "body", Body(asymmetry=0.2)),
        (["--scatter", "5deg"], "body", Body(scatter=math.radians(5))),
        (["--contact", "elastic", "--friction", "0.3"], "body", Body(friction=0.3)),
        (["--contact", "elastic", "--modulus", "0.4"], "body", Body(modulus=0.4)),
        (["--texture", "none"], "texture", None),
        (["--texture", "flakes", "--texture-size", "0.9mm"], "texture", SheetTexture("flakes", 0.9)),
        (
            ["--texture", "random-dots", "--texture-size", "1mm", "--texture-contrast", "0.3"],
            "texture",
            SheetTexture("random-dots", 1.0, 0.3),
        ),
        (["--camera-distance", "20cm"], "camera", Camera(distance=200)),
        (["--point-spread", "0.7"], "camera", Camera(point_spread=0.7)),
        (["--dtype", "uint16"], "camera", Camera(np.dtype(np.uint16), bits=12)),
        (["--dtype", "uint16", "--bits", "16"], "camera", Camera(np.dtype(np.uint16), bits=16)),
        (["--noise", "3", "--seed", "7"], "camera", Camera(noise=3, seed=7)),
        (["--electrons", "40"], "camera", Camera(electrons=40)),
        (["--gain-deviation", "0.02"], "camera", Camera(gain_deviation=0.02)),
        (["--offset-deviation", "0.5"], "camera", Camera(offset_deviation=0.5)),
        (["--frame-rate", "120", "--exposure", "8ms"], "camera", Camera(frame_rate=120, exposure=0.008)),
        (EXACT, "references", "exact"),
        (["--pixel-size", "0.3mm,400um"], "pixel_size", pytest.approx((0.3, 0.4))),
        (["--device", "0"], "device", "0"),
    ],
)
def test_each_option_reaches_the_twin(asked, words, part, expected):
    simulate("vertical", "--frames", "2", *words)
    assert asked[0][part] == expected


def test_compliance_reaches_the_movement(asked):
    simulate("vertical", "--frames", "2", "--contact", "elastic", "--compliance", "20um/N")
    assert asked[0]["movement"].compliance == pytest.approx(0.02)


def test_options_belong_to_their_motions():
    motions = {term.name: term.motions for term in TWIN.terms if term.motions}
    press = dict.fromkeys(("travel_step", "travel_start", "release", "strokes", "compliance"), ("vertical",))
    turn = dict.fromkeys(("tilt", "phase_step", "pivot", "rock", "spiral"), ("axial",))
    others = {"displacement_step": ("horizontal",), "twist_step": ("twist",)}
    assert motions == press | turn | others | {"press": ("axial", "horizontal", "twist")}
    words = ["twist", *SMALL, "--travel-step", "1mm", "-o", "a.h5"]
    refused("--travel-step applies to presses only; this is a twist. Remove it", "simulate", *words)


def points(path):
    """Write an OBJ of points alone."""
    Path(path).write_text("v 0 0 0\nv 1 0 0\nv 0 1 1\n", encoding="ascii")


def wall(path):
    """Write an OBJ of an upright triangle: from above there is nothing to see."""
    Path(path).write_text("v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 3\n", encoding="ascii")


def wide(path):
    """Write a height map of two rods too far apart for the sensor."""
    heights = np.zeros((2, 200))
    heights[:, [0, -1]] = 1
    np.save(path, heights)


def picture(path):
    cv2.imwrite(path, np.full((4, 4), 99, np.uint8))


NO_TRIANGLES = "contains no triangles, only points: export it as a mesh"
BAD = {
    "no tilt": (["axial", "--tilt", "0deg"], "tilt 0 degrees is not possible: give more than 0"),
    "much tilt": (["axial", "--tilt", "31deg"], "tilt 31 degrees is not possible"),
    "tilt back": (["axial", "--tilt=-2deg"], "tilt -2 degrees is not possible"),
    "a deep press": (
        ["twist", "--press", "40mm"],
        "may rise 40 mm into the sensor's body, whose height is 40 mm",
    ),
    "a deep travel": (["vertical", "--travel-step", "2mm"], "may rise 58.1 mm into the sensor's body"),
    "compliance of nothing": (["vertical", "--compliance", "1um/N"], "compliance needs contact 'elastic'"),
    "compliance below zero": (
        ["vertical", "--contact", "elastic", "--compliance=-1um/N"],
        "compliance -0.001 mm/N is not possible",
    ),
    "an unknown object": (["vertical", "--object", "teapot"], f"take {', '.join(OBJECT_NAMES)}, or the path"),
    "a missing object": (["vertical", "--object", "no.stl"], "no.stl: no such file"),
    "a large object": (["vertical", "--object", "wide.npy"], "is larger than the sensor: it needs a circle"),
    "points": (["vertical", "--object", "points.obj"], NO_TRIANGLES),
    "a wall": (["vertical", "--object", "wall.obj"], "wall.obj: has no area seen from above"),
    "no mesh": (["vertical", "--object", "picture.ply"], "is not a readable PLY mesh"),
    "an unknown pattern": (
        ["vertical", "--pattern", "dots"],
        "pattern 'dots' is unknown: take uniform, linear",
    ),
    "a missing pattern": (["vertical", *WALL, "--pattern", "no.png"], "no.png"),
    "a picture for ideal optics": (
        ["vertical", "--pattern", "picture.png"],
        "not support a picture as pattern: use the optics 'cylinder'",
    ),
    "a gap for ideal optics": (["vertical", "--air-gap", "1mm"], "not support an air gap: use the optics"),
    "lamps for ideal optics": (["vertical", "--asymmetry", "0.1"], "not support uneven lamps"),
    "a gap below zero": (["vertical", *WALL, "--air-gap=-1mm"], "air gap -1.0"),
    "scatter below zero": (["vertical", "--scatter=-1deg"], "scatter"),
    "friction without forces": (
        ["horizontal", "--friction", "0.5"],
        "--friction needs --contact elastic: a sheet that only conforms has no forces",
    ),
    "a modulus without forces": (["vertical", "--modulus", "0.5"], "--modulus needs --contact elastic"),
    "friction below zero": (["twist", "--friction=-0.1"], "friction -0.1"),
    "a fine texture": (
        ["vertical", "--texture", "dots"],
        "a texture of 0.1 mm is too fine for pixels of 0.4 mm: use 2 pixels or more",
    ),
    "a texture without a contrast": (
        ["vertical", "--texture", "dots", "--texture-contrast", "0"],
        "contrast 0.0 of the texture",
    ),
    "no modulus": (["vertical", "--modulus", "0"], "modulus 0.0"),
    "9 bits": (["vertical", "--bits", "9"], "frames of uint8 cannot have 9 bits: take 8"),
    "9 bits of 16": (["vertical", "--dtype", "uint16", "--bits", "9"], "cannot have 9 bits: take 10, 12, 16"),
    "bits of a float": (["vertical", "--dtype", "float32", "--bits", "12"], "leave them out"),
    "a long exposure": (["vertical", "--exposure", "40ms"], "exposure 0.04 of the camera is not possible"),
    "an exposure below zero": (["vertical", "--exposure=-1ms"], "exposure -0.001"),
    "no frame rate": (["vertical", "--frame-rate", "0"], "frame rate 0.0"),
    "half a pivot": (["axial", "--pivot", "1mm,2mm"], "--pivot 1mm,2mm: 3 lengths are needed"),
    "noise below zero": (["vertical", "--noise=-1"], "noise -1.0 of the camera is not possible"),
    "noise that is no number": (["vertical", "--noise", "nan"], "noise nan of the camera is not possible"),
    "no electrons": (["vertical", "--electrons", "0"], "electrons 0.0 of the camera is not possible"),
    "a gain of nothing": (["vertical", "--gain-deviation", "1"], "gain deviation 1.0"),
    "offsets below zero": (["vertical", "--offset-deviation=-1"], "offset deviation -1.0"),
    "a point spread below zero": (["vertical", "--point-spread=-1"], "point spread -1.0"),
    "a seed below zero": (["vertical", "--seed=-1"], "seed -1"),
    "a camera in the body": (
        ["vertical", "--camera-distance", "40mm"],
        "a camera 40.0 mm above the sheet is not",
    ),
    "a camera below": (["vertical", "--camera-distance=-1mm"], "distance -1.0 of the camera is not possible"),
    "a travel beyond numbers": (
        ["vertical", "--travel-step", "1e308mm"],
        "travel is 1e+308 at frame 1: every frame needs a finite number, at most 1e+12",
    ),
    "a displacement beyond numbers": (
        ["horizontal", "--displacement-step", "1e308mm,0mm"],
        "displacement is not finite at frame 2",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_impossible_input_is_refused_in_one_line(case):
    points("points.obj")
    wall("wall.obj")
    wide("wide.npy")
    picture("picture.png")
    Path("picture.png").with_suffix(".ply").write_bytes(Path("picture.png").read_bytes())
    words, message = BAD[case]
    size = [] if "--size" in words else SMALL
    refused(message, "simulate", *words, *size, "-o", "a.h5")


def test_a_refusal_leaves_the_recording_that_was_there():
    Path("a.h5").write_bytes(b"as it was")
    refused("tilt", "simulate axial", *SMALL, "--tilt", "0deg", "-o", "a.h5", "--overwrite")


def test_an_input_is_not_overwritten_but_a_name_is_not_an_input():
    picture("wall.png")
    refused("is the input", "simulate vertical", *WALL, "--pattern", "wall.png", "-o", "wall.png")
    Path("sphere").mkdir()
    for again in ([], ["--overwrite"]):
        words = ("simulate", "vertical", *SMALL, "--frames", "2", *EXACT, "-o", "sphere/a.h5")
        code, _, errors = run(*words, *again)
        assert (code, errors) == (0, "")


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_same_seed_gives_the_same_frames(motion):
    words = [*GIVEN[motion], "--frames", "3", *WALL, "--contact", "elastic", "--electrons", "40"]
    deviations = ["--gain-deviation", "0.02", "--offset-deviation", "0.5"]
    first, again, other = (simulate(motion, *words, *deviations, "--seed", seed) for seed in "778")
    for repeated, expected in zip(again[0], first[0], strict=True):
        np.testing.assert_array_equal(repeated, expected)
    for name in ("dark", "bright"):
        reference = getattr(first[1].header, name)
        np.testing.assert_array_equal(getattr(again[1].header, name), reference)
        assert not np.array_equal(getattr(other[1].header, name), reference)
    assert not np.array_equal(other[0].frames, first[0].frames)


def test_a_release_goes_back_by_the_same_steps():
    words = ["--frames", "5", "--travel-start", "0.5mm", "--travel-step", "0.5mm"]
    block, recording = simulate("vertical", *words, "--release", "--noise", "0", *EXACT)
    np.testing.assert_allclose(block.travel, [0.5, 1, 1.5, 2, 2.5, 2, 1.5, 1, 0.5])
    np.testing.assert_array_equal(block.frames, block.frames[::-1])
    assert recording.truth.contact.sum() == np.count_nonzero(geometry.sphere(SHAPE, PIXEL).height >= -2.5)


CLEAR = ["--noise", "0", *EXACT]


@pytest.mark.parametrize(("bits", "scale"), [("10", 4), ("12", 16), ("16", 256), (None, 16)])
def test_bits_set_the_camera_s_levels(bits, scale):
    words = ["--frames", "2", "--travel-start", "3mm", "--travel-step", "0mm", "--dtype", "uint16", *CLEAR]
    block, recording = simulate("vertical", *words, *([] if bits is None else ["--bits", bits]))
    assert block.frames.dtype == np.uint16
    assert (block.frames.min(), block.frames.max()) == (16 * scale, 224 * scale)
    assert recording.header.bright[0, 0] == 224 * scale


def test_a_picture_can_surround_the_body():
    shown = np.zeros((2, 8), np.uint8)
    shown[:, 4:] = 255
    cv2.imwrite("half.png", shown)
    words = ["--travel-start", "3mm", "--travel-step", "0mm", "--frames", "2", *WALL, *CLEAR]
    clear = simulate("vertical", *words)[0].frames[0]
    half = simulate("vertical", *words, "--pattern", "half.png")[0].frames[0]
    # Half of the wall is dark, from azimuth -180 to 0 degrees: that is what the lower half of the ball shows,
    # and the upper half shows the clear one.
    upper, lower = np.s_[:8], np.s_[10:]
    for part, light in ((upper, True), (lower, False)):
        lit = clear[part] > 200
        assert lit.sum() > 20
        assert np.median(half[part][lit] > 120) == light


def test_a_linear_pattern_writes_the_zenith_to_the_header():
    block, recording = simulate("axial", "--pattern", "linear", "--frames", "2", "--dtype", "float32", *CLEAR)
    header, truth = recording.header, recording.truth
    # Between the zeniths that show the wall's rim and the horizon, counts go from dark to bright.
    rim = math.atan2(17.5, 40) / 2
    np.testing.assert_allclose(header.zenith_gain, 208 / (math.pi / 4 - rim))
    np.testing.assert_allclose(header.zenith_offset + header.zenith_gain * rim, 16, rtol=1e-6)
    zenith = (block.frames.mean(axis=0) - header.zenith_offset) / header.zenith_gain
    inside = (truth.contact == 1) & (truth.zenith > math.radians(17)) & (truth.zenith < math.radians(40))
    assert inside.sum() > 10
    # Of a body that is tilted by 2.5 degrees.
    assert np.abs(zenith - truth.zenith)[inside].max() < math.radians(2.6)


def test_objects_come_from_files():
    heights = np.zeros((9, 9))
    heights[2:7, 3:6] = [[1, 2, 1]] * 5
    np.save("ridge.npy", heights)
    truth = simulate("vertical", "--object", "ridge.npy", "--frames", "2", *EXACT)[1].truth
    # The map's samples lie between the picture's pixels: 9 of them, and 18 x 24 pixels.
    np.testing.assert_allclose(truth.height[8, 9:14], [-2, -1.5, -0.5, -0.5, -1.5])
    Path("roof.obj").write_text(
        "v -2 -1 0\nv 2 -1 0\nv 2 1 0\nv -2 1 0\nv 0 0 1\nf 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n",
        encoding="ascii",
    )
    _, recording = simulate("vertical", "--object", "roof.obj", "--frames", "2", *EXACT)
    x, y = geometry.pixel_centres(SHAPE, PIXEL)
    roof = -np.maximum(np.abs(x) / 2, np.abs(y))
    np.testing.assert_allclose(recording.truth.height, np.where(roof < -1, np.nan, roof), atol=1e-6)
    assert recording.header.title.startswith("Digital twin, roof.obj, vertical motion")


@pytest.mark.parametrize("packing", ["raw", "bitshuffle"])
def test_frames_are_packed_as_asked(packing):
    plain, _ = simulate("vertical", "--frames", "3", *EXACT)
    block, recording = simulate("vertical", "--frames", "3", *EXACT, "--compression", packing)
    np.testing.assert_array_equal(block.frames, plain.frames)
    assert (recording.storage == "in one piece") == (packing == "raw")


@pytest.mark.parametrize("motion", ["horizontal", "twist"])
def test_slides_and_twists_report_their_motion_and_press(motion):
    assert run("simulate", motion, *SMALL, "--frames", "3", *EXACT, "-o", "a.h5").code == 0
    facts = done("info a.h5")
    assert re.search(rf"motion +{motion}\n", facts.out)
    assert re.search(r"press +1 mm\n", facts.out)
    io.save_result(io.Result(height=np.zeros((4, 7), np.float32)), "r.h5")
    refused("not of one stack", "score r.h5 --truth a.h5")
