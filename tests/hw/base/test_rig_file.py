"""Rig files: every key is read in base units, and errors name file, key and remedy."""

import json
import math
import re
import tomllib
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from msgspec import structs

from mirrorskin.hw.base.references import read_reference
from mirrorskin.hw.base.rig_file import (
    TEMPLATE,
    CameraSettings,
    RigFile,
    ShiftAxis,
    StageSettings,
    TiltAxis,
    TravelAxis,
    TwistAxis,
    load_rig,
)
from mirrorskin.hw.base.stage import Limits
from mirrorskin.io import InputError
from mirrorskin.io.base.types import PROPERTIES

DOCS = Path(__file__).parents[3] / "docs" / "rig.md"

EVERYTHING = """
name = "bench 2"

[stage]
port = "socket://localhost:23"
firmware = "lab:Stage"
baud = 9600
home = false
timeout = 1
report_rate = 10
silence = 0.25
press = 2
travel_sigma = 0.002
tilt_sigma = 0.003
phase_sigma = 0.004
pivot = [0, 1, -10.5]

[stage.travel]
letter = "Z"
direction = -1
zero = -20
unit = "mm"
limits = [-5, 3]
speed = 4
steps = 100.0

[stage.pitch]
letter = "A"
direction = 1
zero = 7.5
unit = "deg"
limits = [-6.0, 4.0]
speed = 90
steps = 200.0

[stage.roll]
letter = "C"
direction = -1
zero = 0.25
unit = "deg"
limits = [-5.0, 5.0]
speed = 45
steps = 300.0

[stage.x]
letter = "X"
direction = -1
zero = 0.5
unit = "mm"
limits = [-1.5, 2.5]
speed = 0.75
steps = 400.0

[stage.y]
letter = "Y"
direction = 1
zero = 0.0
unit = "mm"
limits = [-3.5, 3.5]
speed = 1.25
steps = 500.0

[stage.twist]
letter = "B"
direction = 1
zero = 180.0
unit = "deg"
limits = [-30.0, 60.0]
speed = 12.5
steps = 600.0

[camera]
source = "http://localhost:8000/video"
size = [64, 48]
name = "left"
dtype = "uint16"
fourcc = "Y16"
exposure = 0.004
gain = 2
rate = 60
delay = 0.03
stall = 0.2
trigger = "spindle"
trigger_input = "Line2"
line_time = 2e-5
exposure_ratio = 0.5
gamma = 1.05
gamma_sigma = 0.01
frame_gain_sigma = 0.002
drift_sigma = 0.003
lag_sigma = 0.004
pixel_gain_sigma = 0.005
uneven_light_sigma = 0.006
blur_sigma = 0.07
zenith_gain_sigma = 0.008
zenith_offset_sigma = 0.9
pixel_size = [0.03, 0.04]
dark = 12
bright = 4000.5
zenith_gain = 5.7
zenith_offset = 10
"""

LEAST = """
[stage]
port = "COM3"
press = 2.0
[stage.travel]
letter = "X"
limits = [-5.0, 3.0]
speed = 4.0
[camera]
source = 0
size = [4, 3]
"""


@pytest.fixture
def rig(tmp_path, monkeypatch):
    """Read a rig of a text, from a file that is called r.toml."""
    monkeypatch.chdir(tmp_path)

    def read(text):
        (tmp_path / "r.toml").write_text(text, encoding="utf-8")
        return load_rig(Path("r.toml"))

    return read


@pytest.fixture
def refusal(rig):
    """Tell how a rig of a text is refused."""

    def read(text):
        with pytest.raises(InputError) as caught:
            rig(text)
        message = str(caught.value)
        assert message.startswith("r.toml")
        assert "\n" not in message
        assert message.isprintable()
        return message

    return read


def test_every_key_arrives(rig):
    actual = rig(EVERYTHING)
    assert (actual.path, actual.name) == (Path("r.toml"), "bench 2")
    keys = tomllib.loads(EVERYTHING)
    keys["camera"]["fourcc"] = "Y16 "
    stage, camera = (json.loads(msgspec.json.encode(result)) for result in (actual.stage, actual.camera))
    assert stage == keys["stage"]
    assert camera == keys["camera"]
    degree = math.pi / 180
    pitch, travel = actual.stage.pitch, actual.stage.travel
    assert (pitch.low, pitch.high, pitch.top_speed) == pytest.approx((-6 * degree, 4 * degree, 90 * degree))
    assert (travel.low, travel.high, travel.top_speed) == (-5.0, 3.0, 4.0)
    assert pitch.coordinate(2 * degree) == pytest.approx(9.5)
    assert travel.value(-21.0) == 1.0
    assert actual.camera.shape == (48, 64)
    assert actual.camera.counts_per_radian == pytest.approx(5.7 / degree)


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("0", "0"),
        ('"/dev/video2"', "/dev/video2"),
        ('"rtsp://me:a:secret@10.0.0.7/left@2"', "rtsp://10.0.0.7/left@2"),
    ],
)
def test_a_camera_without_a_name_is_called_as_its_source_without_a_password(rig, source, name):
    actual = rig(LEAST.replace("source = 0", f"source = {source}"))
    assert (str(actual.camera.source), actual.camera.name, actual.name) == (source.strip('"'), name, "r")


def test_one_pixel_size_is_of_both_sides(rig):
    assert rig(LEAST + "pixel_size = 0.25").camera.pixel_sides == (0.25, 0.25)


def test_a_source_next_to_the_rig_file_is_found_from_anywhere(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "film.avi").touch()
    text = LEAST.replace("source = 0", 'source = "film.avi"')
    (tmp_path / "a" / "r.toml").write_text(text)
    monkeypatch.chdir(tmp_path)
    assert load_rig("a/r.toml").camera.source == str(Path("a", "film.avi"))


# What the stage may do


def test_the_half_angle_is_the_largest_whole_circle_within_the_limits(rig):
    # The half-plane that is nearest to upright: pitch up to 4 degrees.
    limits = rig(EVERYTHING).stage.limits
    assert (limits.travel, limits.tilt, limits.press) == ((-5.0, 3.0), pytest.approx(math.radians(4)), 2.0)


def test_x_y_and_twist_have_the_limits_of_the_file(rig):
    limits = rig(EVERYTHING).stage.limits
    assert (limits.x, limits.y) == ((-1.5, 2.5), (-3.5, 3.5))
    assert limits.twist == pytest.approx((math.radians(-30), math.radians(60)))
    assert rig(LEAST).stage.limits.x == rig(LEAST).stage.limits.twist == (0.0, 0.0)


def test_a_stage_without_tilts_cannot_lean(rig):
    assert rig(LEAST).stage.limits == Limits((-5.0, 3.0), 0.0, 2.0)


def test_a_press_beyond_the_axis_ends_with_the_axis(rig):
    assert rig(LEAST.replace("press = 2.0", "press = 100")).stage.limits.press == 3.0


# What is refused: a line of EVERYTHING, what it is changed to, and what is said.

WRONG = [
    (
        'name = "bench 2"',
        "name = 5",
        "name is 5: what the rig is called, in quotes, is needed; write e.g. name =",
    ),
    ('name = "bench 2"', 'nome = "x"', "nome is not known: did you mean name?"),
    ('name = "bench 2"', 'name = "a\\nb"', 'name is "a?b": what'),
    (
        'port = "socket://localhost:23"',
        'port = ""',
        'stage.port is "": a serial port or a URL, in quotes, is',
    ),
    ('port = "socket://localhost:23"', "", 'stage.port is missing: add port = "/dev/ttyUSB0" in [stage]'),
    ("baud = 9600", "baud = true", "stage.baud is true: a number of bits a second, from 300 to 10000000, is"),
    ("baud = 9600", '"\\u0007" = 9', r"stage.'\x07' is not known: there are port, firmware, baud, home"),
    ("home = false", 'home = "no"', 'stage.home is "no": true or false is needed; write e.g. home = true'),
    ("timeout = 1", "timeout = 0", "stage.timeout is 0: a time from 0.1 to 60 s is needed"),
    ("timeout = 1", "timeout = inf", "stage.timeout is inf: a time"),
    ("report_rate = 10", "report_rate = 101", "stage.report_rate is 101: a rate from 1 to 100 Hz is needed"),
    ("press = 2", "press = nan", "stage.press is nan: a finite number of mm is needed; write e.g. press = 2"),
    ("press = 2", f"press = 1{'0' * 400}", "stage.press is 1000000000000000000000000000000000000000...: a"),
    (
        "press = 2",
        "press = -5",
        "[stage] press is -5, not above travel.limits' -5; write the greatest travel",
    ),
    ("pivot = [0, 1, -10.5]", "pivot = [0, 1]", "stage.pivot is [0, 1]: a list of x, y and z, in mm, is"),
    ("pivot = [0, 1, -10.5]", "pivot = [0, 1, nan]", "stage.pivot is [0, 1, nan]: a list of"),
    ('letter = "Z"', 'letter = "z"', 'stage.travel.letter is "z": one of X, Y, Z, A, B, C, in quotes, is'),
    ('letter = "Z"', "letter = {a = 1}", "stage.travel.letter is a table: one of"),
    ('letter = "C"', 'letter = "A"', '[stage] roll.letter is "A", and so is pitch.letter: each motion'),
    ("zero = 7.5\n", "zero = -inf\n", "stage.pitch.zero is -inf: a finite number of degrees is needed"),
    ('zero = -20\nunit = "mm"', 'unit = "deg"', 'stage.travel.unit is "deg": one of "mm" is needed'),
    ("limits = [-5, 3]", "limits = [3, 3]", "[stage.travel] limits are in the wrong order, 3 is not below 3"),
    ("limits = [-5, 3]", "limits = [-5, true]", "stage.travel.limits is [-5, True]: a list of the least and"),
    ("limits = [-6.0, 4.0]", "limits = [0, 4]", "[stage.pitch] limits [0, 4] do not include 0 (upright)"),
    (
        "limits = [-1.5, 2.5]",
        "limits = [1, 2]",
        "[stage.x] limits [1, 2] do not include 0 (where the body is",
    ),
    ("limits = [-30.0, 60.0]", "limits = [-400, 4]", "stage.twist.limits is [-400, 4]: a list of the least"),
    ("speed = 0.75", "speed = 0", "stage.x.speed is 0: a speed above 0, in mm a second, is needed"),
    ('letter = "B"', 'letter = "Y"', '[stage] twist.letter is "Y", and so is y.letter: each motion'),
    ("limits = [-6.0, 4.0]", "limits = [-90, 4]", "stage.pitch.limits is [-90, 4]: a list of the least and"),
    ("speed = 45", "speed = 0", "stage.roll.speed is 0: a speed above 0, in degrees a second, is needed"),
    (
        'source = "http://localhost:8000/video"',
        "source = -1",
        "camera.source is -1: a camera's number from 0",
    ),
    ('source = "http://localhost:8000/video"', 'source = " "', 'camera.source is " ": a camera\'s number'),
    (
        "size = [64, 48]",
        "size = [64, 0]",
        "camera.size is [64, 0]: a list of columns and rows, each from 1 to",
    ),
    ('dtype = "uint16"', 'dtype = "int8"', 'camera.dtype is "int8": one of "uint8", "uint16", "float32" is'),
    (
        'trigger = "spindle"',
        'trigger = "lamp"',
        'camera.trigger is "lamp": one of "coolant", "spindle" is needed',
    ),
    (
        'trigger = "spindle"',
        "",
        "[camera] trigger_input is given without trigger: add trigger",
    ),
    ('fourcc = "Y16"', 'fourcc = "Mono12"', '[camera] fourcc is "Mono12": this source needs'),
    (
        'fourcc = "Y16"',
        'fourcc = "GREYS"',
        'camera.fourcc is "GREYS": a format of two to four letters, or Mono8',
    ),
    ("exposure = 0.004", "exposure = 0", "camera.exposure is 0: a time above 0, in seconds, is needed"),
    ("gain = 2\n", "gain = nan\n", "camera.gain is nan: a finite number is needed"),
    ("delay = 0.03", "delay = -0.03", "camera.delay is -0.03: a time from 0 to 10 s is needed"),
    (
        "pixel_size = [0.03, 0.04]",
        "pixel_size = [1]",
        "camera.pixel_size is [1]: a length above 0, in mm, or",
    ),
    (
        "dark = 12",
        'dark = "dark.gif"',
        'camera.dark is "dark.gif": a number of counts, or a file (.npy, .png',
    ),
    ("dark = 12", "dark = -1", "camera.dark: it is -1, but counts of uint16 are 0 to 65535"),
    ("dark = 12", "dark = 4001", "camera.bright is not above camera.dark at most of the pixels"),
    ("bright = 4000.5", 'bright = "b.tif"', "camera.bright: b.tif cannot be read: No such file or directory"),
    ("zenith_gain = 5.7", "zenith_gain = 0", "[camera] zenith_gain is 0: write the counts per degree"),
    ("zenith_gain = 5.7", "", "[camera] zenith_offset is given without zenith_gain"),
    ("[stage.roll]", "[stage.rol]", "stage.rol is not known: did you mean roll?"),
    ("[camera]", "[kamera]", "kamera is not known: did you mean camera?"),
]


@pytest.mark.parametrize(
    ("line", "wrong", "message"), WRONG, ids=[f"{row[0]}-{row[1]}"[:60] for row in WRONG]
)
def test_impossible_input_is_refused_with_its_key(refusal, line, wrong, message):
    assert EVERYTHING.count(line) == 1
    assert refusal(EVERYTHING.replace(line, wrong)).startswith(f"r.toml: {message}")


def test_pitch_without_roll_is_refused_and_roll_without_pitch(refusal):
    before, pitch, rest = re.split(r"(?=\[stage\.pitch\])|(?=\[stage\.roll\])", EVERYTHING)
    roll, camera = re.split(r"(?=\[camera\])", rest)
    assert "there is [stage.pitch] but no [stage.roll]" in refusal(before + pitch + camera)
    assert "there is [stage.roll] but no [stage.pitch]" in refusal(before + roll + camera)


@pytest.mark.parametrize("table", ["stage", "camera", "stage.travel"])
def test_a_missing_table_is_reported(refusal, table):
    tables = re.split(r"(?=\n\[)", LEAST)
    others = "".join(item for item in tables if not item.startswith(f"\n[{table}"))
    assert f"{table} is missing: add table [{table}]" in refusal(others)


def test_what_is_no_table_or_no_toml_is_reported(refusal, tmp_path):
    assert ": write [stage] alone in a line, and its keys below" in refusal("stage = 5")
    assert re.match(r"r\.toml is not TOML: .*line 3", refusal(LEAST.replace('"COM3"', '"COM3')))
    with pytest.raises(InputError, match=r"cannot be read: No such file.* 'mirrorskin rig new'"):
        load_rig(tmp_path / "none.toml")


# References


def save(path, picture):
    if path.suffix == ".npy":
        np.save(path, picture)
    else:
        assert cv2.imwrite(str(path), picture)


def with_reference(name):
    return f'{LEAST}bright = "{name}"\n'


PICTURE = np.arange(100, 112, dtype=np.uint8).reshape(3, 4)


@pytest.mark.parametrize("name", ["b.npy", "b.png", "B.TIFF"])
def test_a_reference_next_to_the_rig_file_is_read(rig, tmp_path, name):
    save(tmp_path / name, PICTURE)
    camera = rig(with_reference(name)).camera
    assert camera.bright == name
    actual = read_reference(camera, "bright", "r.toml")
    assert actual.dtype == np.float32
    np.testing.assert_array_equal(actual, PICTURE)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_mean_of_frames_may_be_a_reference_and_pixels_may_have_none(rig, tmp_path, dtype):
    counts = PICTURE + dtype(0.25)
    counts[0, 0] = np.nan
    np.save(tmp_path / "b.npy", counts)
    camera = rig(with_reference("b.npy") + "dark = 10").camera
    np.testing.assert_array_equal(read_reference(camera, "bright", "r.toml"), counts.astype(np.float32))
    np.testing.assert_array_equal(read_reference(camera, "dark", "r.toml"), np.full((3, 4), 10, np.float32))


def test_a_reference_of_a_camera_of_floats_may_lie_anywhere(rig, tmp_path):
    np.save(tmp_path / "b.npy", np.full((3, 4), -7.5, np.float32))
    text = with_reference("b.npy").replace("[4, 3]", '[4, 3]\ndtype = "float32"')
    camera = rig(text).camera
    assert (read_reference(camera, "bright", "r.toml") == -7.5).all()


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (PICTURE.T, r"b.npy is 3 x 4, but the camera's pictures are 4 x 3 \(columns x rows\)"),
        (PICTURE[0], "b.npy is 4, but the camera's pictures are 4 x 3"),
        (np.uint8(3), "b.npy is a single number, but the camera's pictures"),
        (PICTURE.astype(np.uint16), "b.npy contains uint16, but the camera delivers uint8; take"),
        (PICTURE > 105, "b.npy contains bool, but the camera delivers uint8"),
        (PICTURE.astype(np.complex64), "b.npy is not a NumPy array of numbers .it contains complex64."),
        (PICTURE * np.nan, "b.npy contains only NaN"),
        (PICTURE + 200.0, "b.npy contains 300 to 311, but counts of uint8 are 0 to 255"),
        (np.where(PICTURE == 105, np.inf, PICTURE), "b.npy contains 100 to inf, but counts of uint8"),
    ],
)
def test_a_reference_that_the_camera_cannot_give_is_refused(refusal, tmp_path, picture, message):
    np.save(tmp_path / "b.npy", picture)
    assert re.match(f"r.toml: camera.bright: {message}", refusal(with_reference("b.npy")))


def test_a_damaged_reference_is_refused(refusal, tmp_path):
    save(tmp_path / "b.png", PICTURE)
    (tmp_path / "b.png").write_bytes((tmp_path / "b.png").read_bytes()[:50])
    assert "camera.bright: b.png is damaged or cut off" in refusal(with_reference("b.png"))
    (tmp_path / "b.npy").write_bytes(b"")
    assert "camera.bright: b.npy is not a NumPy array" in refusal(with_reference("b.npy"))
    np.save(tmp_path / "b.npy", np.array([{}], object))
    assert "camera.bright: b.npy is not a NumPy array" in refusal(with_reference("b.npy"))
    with (tmp_path / "b.npy").open("wb") as file:
        np.savez(file, PICTURE, PICTURE)
    assert "camera.bright: b.npy is not a NumPy array" in refusal(with_reference("b.npy"))
    (tmp_path / "b.tif").mkdir()
    assert "camera.bright: b.tif cannot be read: Is a directory" in refusal(with_reference("b.tif"))


# The documentation


def documented():
    """Return the rows of the tables of keys: {table: {key: default}}."""
    tables, names = {}, []
    for line in DOCS.read_text().split("## Checks")[0].splitlines():
        if line.startswith("### "):
            names = re.findall(r"`\[([a-z.]+)\]`", line) or [""]
        elif row := re.match(r"\| `([a-z_]+)` .*\| (.*) \|$", line):
            for name in names:
                tables.setdefault(name, {})[row[1]] = row[2]
    return tables


TABLES = {
    "": RigFile,
    "stage": StageSettings,
    "stage.travel": TravelAxis,
    "stage.pitch": TiltAxis,
    "stage.roll": TiltAxis,
    "stage.x": ShiftAxis,
    "stage.y": ShiftAxis,
    "stage.twist": TwistAxis,
    "camera": CameraSettings,
}


def test_documentation_and_code_agree_on_keys_and_defaults():
    tables = documented()
    assert set(tables) == set(TABLES)
    for table, model in TABLES.items():
        fields = {field.encode_name: field for field in structs.fields(model)}
        keys = {key for key in fields if not (f"stage.{key}" in TABLES or key in TABLES)}
        assert keys == set(tables[table]), table
        for key in keys:
            field, default = fields[key], tables[table][key]
            assert (default == "required") == field.required, (table, key)
            if isinstance(field.default, int | float):
                assert tomllib.loads(f"a = {default}") == {"a": field.default}, (table, key)


def test_the_example_of_the_documentation_is_the_template():
    assert f"```toml\n{TEMPLATE}```" in DOCS.read_text()


def test_the_template_has_all_keys_with_their_defaults(rig, tmp_path):
    plain = rig(TEMPLATE)
    save(tmp_path / "bright.tif", np.full((480, 640), 200, np.uint8))
    whole = re.sub(r"^# (?=\w+ = |\[)", "", TEMPLATE, flags=re.MULTILINE)
    keys = tomllib.loads(whole)
    tables = {"": keys} | {name: keys[name] for name in ("stage", "camera")}
    tables |= {f"stage.{name}": keys["stage"][name] for name in keys["stage"] if f"stage.{name}" in TABLES}
    for table, model in TABLES.items():
        assert {field.encode_name for field in structs.fields(model)} == set(tables[table]), table
    axes = {name: structs.replace(axis, steps=250.0) for name, axis in plain.stage.axes.items()}
    axes |= {name: getattr(rig(whole).stage, name) for name in ("x", "y", "twist")}
    stated = {name: float(prop.example) for name, prop in PROPERTIES.items() if prop.of == "stage"}
    assert rig(whole).stage == structs.replace(plain.stage, pivot=(0.0, 0.0, 0.0), **stated, **axes)
