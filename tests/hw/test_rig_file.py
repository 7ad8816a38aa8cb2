"""Rig files: every key arrives in our units, and what cannot be used is told with file, key and remedy."""

import math
import re
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

from mirrorskin.hw.rig.references import read_reference
from mirrorskin.hw.rig_file import KEYS, REQUIRED, TEMPLATE, Axis, CameraSettings, StageSettings, load_rig
from mirrorskin.hw.stage import Limits
from mirrorskin.io import InputError

DOCS = Path(__file__).parents[2] / "docs" / "rig.md"

EVERYTHING = """
name = "bench 2"

[stage]
port = "socket://localhost:23"
baud = 9600
home = false
timeout = 1
report_rate = 10
press = 2
pivot = [0, 1, -10.5]

[stage.travel]
letter = "Z"
direction = -1
zero = -20
unit = "mm"
limits = [-5, 3]
speed = 4

[stage.pitch]
letter = "A"
direction = 1
zero = 7.5
unit = "deg"
limits = [-6.0, 4.0]
speed = 90

[stage.roll]
letter = "C"
direction = -1
zero = 0.25
unit = "deg"
limits = [-5.0, 5.0]
speed = 45

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
        said = str(caught.value)
        assert said.startswith("r.toml")
        assert "\n" not in said
        assert said.isprintable()
        return said

    return read


def test_every_key_arrives_in_millimetres_radians_and_seconds(rig):
    found = rig(EVERYTHING)
    assert found.path == Path("r.toml")
    assert found.name == "bench 2"
    degree = math.pi / 180
    assert found.stage == StageSettings(
        port="socket://localhost:23",
        baud=9600,
        home=False,
        timeout=1.0,
        report_rate=10.0,
        travel=Axis("Z", -1, -20.0, -5.0, 3.0, 4.0, "mm"),
        pitch=Axis("A", 1, 7.5, -6 * degree, 4 * degree, 90 * degree, "deg"),
        roll=Axis("C", -1, 0.25, -5 * degree, 5 * degree, 45 * degree, "deg"),
        press=2.0,
        pivot=(0.0, 1.0, -10.5),
    )
    assert found.camera == CameraSettings(
        source="http://localhost:8000/video",
        shape=(48, 64),
        dtype=np.dtype(np.uint16),
        fourcc="Y16 ",
        exposure=0.004,
        gain=2.0,
        rate=60.0,
        delay=0.03,
        pixel_size=(0.03, 0.04),
        dark=12.0,
        bright=4000.5,
        zenith_gain=pytest.approx(5.7 / degree),
        zenith_offset=10.0,
        name="left",
    )


def test_what_is_not_said_has_its_default(rig):
    found = rig(LEAST)
    assert found.name == "r"
    assert found.stage == StageSettings(
        port="COM3",
        baud=115200,
        home=True,
        timeout=2.0,
        report_rate=20.0,
        travel=Axis("X", 1, 0.0, -5.0, 3.0, 4.0, "mm"),
        pitch=None,
        roll=None,
        press=2.0,
        pivot=None,
    )
    assert found.camera == CameraSettings(source=0, shape=(3, 4), dtype=np.dtype(np.uint8), name="0")


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ('"/dev/video2"', "/dev/video2"),
        ('"rtsp://me:a:secret@10.0.0.7/left"', "rtsp://10.0.0.7/left"),
        ('"rtsp://10.0.0.7/left@2"', "rtsp://10.0.0.7/left@2"),
    ],
)
def test_a_camera_without_a_name_is_called_as_its_source_without_a_password(rig, source, name):
    found = rig(LEAST.replace("source = 0", f"source = {source}")).camera
    assert (found.source, found.name) == (source.strip('"'), name)


def test_one_pixel_size_is_of_both_sides(rig):
    assert rig(LEAST + "pixel_size = 0.25").camera.pixel_size == (0.25, 0.25)


def test_a_source_beside_the_rig_file_is_found_from_anywhere(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "film.avi").touch()
    text = LEAST.replace("source = 0", 'source = "film.avi"')
    (tmp_path / "a" / "r.toml").write_text(text)
    monkeypatch.chdir(tmp_path)
    assert load_rig("a/r.toml").camera.source == str(Path("a", "film.avi"))


def test_a_source_that_is_no_file_there_is_left_as_it_is(rig):
    assert rig(LEAST.replace("source = 0", 'source = "/dev/video7"')).camera.source == "/dev/video7"


# What the stage may do


def test_the_half_angle_is_the_largest_whole_circle_within_the_limits(rig):
    # The half-plane that is nearest to upright: pitch up to 4 degrees.
    assert rig(EVERYTHING).stage.limits == Limits((-5.0, 3.0), pytest.approx(math.radians(4)), 2.0)


def test_a_stage_without_tilts_cannot_lean(rig):
    assert rig(LEAST).stage.limits == Limits((-5.0, 3.0), 0.0, 2.0)


def test_a_press_beyond_the_axis_ends_with_the_axis(rig):
    assert rig(LEAST.replace("press = 2.0", "press = 100")).stage.limits.press == 3.0


def test_axes_are_told_by_their_motion(rig):
    assert {name: axis.letter for name, axis in rig(EVERYTHING).stage.axes.items()} == {
        "travel": "Z",
        "pitch": "A",
        "roll": "C",
    }
    assert list(rig(LEAST).stage.axes) == ["travel"]


# What is refused: a line of EVERYTHING, what it is changed to, and what is said.

WRONG = [
    (
        'name = "bench 2"',
        "name = 5",
        'name is 5: what the rig is called is needed, a text in quotes; write e.g. name = "',
    ),
    ('name = "bench 2"', 'nome = "x"', "nome is not known: did you mean name?"),
    ('name = "bench 2"', 'name = "a\\nb"', 'name is "a?b": what'),
    ('port = "socket://localhost:23"', 'port = ""', 'stage.port is "": a serial port or a URL is needed'),
    ('port = "socket://localhost:23"', "", 'stage.port is missing; write port = "/dev/ttyUSB0" in [stage]'),
    ("baud = 9600", "baud = 9600.0", "stage.baud is 9600.0: a number of bits a second from 300 to"),
    ("baud = 9600", "baud = true", "stage.baud is true: a number of bits"),
    (
        "baud = 9600",
        f"baud = 1{'0' * 60}",
        "stage.baud is 1000000000000000000000000000000000000000...: a number",
    ),
    ("baud = 9600", "bauds = 9600", "stage.bauds is not known: did you mean baud?"),
    ("baud = 9600", "Report-Rate = 9", "stage.Report-Rate is not known: did you mean report_rate?"),
    ("baud = 9600", '"\\u0007" = 9', r"stage.'\x07' is not known: there are port, baud, home"),
    ("home = false", 'home = "no"', 'stage.home is "no": true or false is needed; write e.g. home = true'),
    ("timeout = 1", "timeout = 0", "stage.timeout is 0: a time from 0.1 to 60 s is needed"),
    ("timeout = 1", "timeout = inf", "stage.timeout is inf: a time"),
    ("timeout = 1", "timeout = false", "stage.timeout is false: a time"),
    ("timeout = 1", "timeout = 12:30:00", "stage.timeout is 12:30:00: a time"),
    ("report_rate = 10", "report_rate = 101", "stage.report_rate is 101: a rate from 1 to 100 Hz is needed"),
    (
        "press = 2",
        "press = nan",
        "stage.press is nan: a finite number of mm is needed; write e.g. press = 2.0",
    ),
    (
        "press = 2",
        f"press = 1{'0' * 400}",
        "stage.press is 1000000000000000000000000000000000000000...: a finite",
    ),
    (
        "press = 2",
        "press = -5",
        "stage.press is -5, not above stage.travel.limits' -5; write the greatest travel",
    ),
    ("pivot = [0, 1, -10.5]", "pivot = [0, 1]", "stage.pivot is [0, 1]: x, y and z in mm are needed, in [ ]"),
    (
        "pivot = [0, 1, -10.5]",
        "pivot = [0, 1, nan]",
        "stage.pivot is [0, 1, nan]: each a finite number is needed",
    ),
    ("pivot = [0, 1, -10.5]", "pivot = 0", "stage.pivot is 0: x, y and z in mm are needed"),
    (
        'letter = "Z"',
        'letter = "z"',
        'stage.travel.letter is "z": one of "X", "Y", "Z", "A", "B", "C" is needed',
    ),
    ('letter = "Z"', "letter = 3", "stage.travel.letter is 3: one of"),
    ('letter = "Z"', "letter = {a = 1}", "stage.travel.letter is a table: one of"),
    ('letter = "Z"', "", 'stage.travel.letter is missing; write letter = "Z" in [stage.travel]'),
    ('letter = "C"', 'letter = "A"', 'stage.roll.letter is "A", and so is stage.pitch.letter: each motion'),
    ('letter = "C"', 'letter = "Z"', 'stage.roll.letter is "Z", and so is stage.travel.letter: each motion'),
    ("zero = 7.5\n", "zero = -inf\n", "stage.pitch.zero is -inf: a finite number of degrees is needed"),
    ('zero = -20\nunit = "mm"', 'unit = "deg"', 'stage.travel.unit is "deg": one of "mm" is needed'),
    ('zero = 7.5\nunit = "deg"', 'unit = "mm"', 'stage.pitch.unit is "mm": one of "deg" is needed'),
    (
        "limits = [-5, 3]",
        "limits = [3, -5]",
        "stage.travel.limits are out of order, 3 not below -5: write [least, ",
    ),
    (
        "limits = [-5, 3]",
        "limits = [3, 3]",
        "stage.travel.limits are out of order, 3 not below 3: write [least, ",
    ),
    (
        "limits = [-5, 3]",
        "limits = [-5, nan]",
        "stage.travel.limits is [-5, nan]: a finite number of mm is needed",
    ),
    ("limits = [-5, 3]", "limits = [-5, true]", "stage.travel.limits is [-5, True]: a finite number of mm"),
    (
        "limits = [-5, 3]",
        "limits = 3",
        "stage.travel.limits is 3: the least and the greatest value in mm are",
    ),
    (
        "limits = [-6.0, 4.0]",
        "limits = [0, 4]",
        "stage.pitch.limits [0, 4] do not have 0 (upright) within; set",
    ),
    (
        "limits = [-6.0, 4.0]",
        "limits = [-90, 4]",
        "stage.pitch.limits is [-90, 4]: an angle between -90 and 90",
    ),
    ("speed = 45", "speed = 0", "stage.roll.speed is 0: a speed above 0, in degrees a second, is needed"),
    (
        "speed = 45",
        "speed = 45\naccel = 1",
        "stage.roll.accel is not known: there are letter, direction, zero",
    ),
    ("speed = 4\n", "", "stage.travel.speed is missing; write speed = 5.0 in [stage.travel]"),
    (
        'source = "http://localhost:8000/video"',
        "source = -1",
        "camera.source is -1: a camera's number from 0 on",
    ),
    ('source = "http://localhost:8000/video"', "source = true", "camera.source is true: a camera's number"),
    ('source = "http://localhost:8000/video"', 'source = " "', 'camera.source is " ": a camera\'s number'),
    ("size = [64, 48]", "size = [64, 0]", "camera.size is [64, 0]: each from 1 to 65535 is needed"),
    ("size = [64, 48]", 'size = "64x48"', 'camera.size is "64x48": columns and rows are needed, in [ ]'),
    ("size = [64, 48]", "", "camera.size is missing; write size = [640, 480] in [camera]"),
    (
        'dtype = "uint16"',
        'dtype = "int8"',
        'camera.dtype is "int8": one of "uint8", "uint16", "float32" is needed',
    ),
    (
        'fourcc = "Y16"',
        'fourcc = "GREYS"',
        'camera.fourcc is "GREYS": the two to four letters of a format are',
    ),
    ("exposure = 0.004", "exposure = 0", "camera.exposure is 0: a time above 0, in seconds, is needed"),
    ("gain = 2\n", "gain = nan\n", "camera.gain is nan: a finite number is needed"),
    ("rate = 60", "rate = -60", "camera.rate is -60: a rate above 0, in Hz, is needed"),
    ("delay = 0.03", "delay = -0.03", "camera.delay is -0.03: a time from 0 to 10 s is needed"),
    (
        "pixel_size = [0.03, 0.04]",
        "pixel_size = 0",
        "camera.pixel_size is 0: a length above 0, in mm, is needed",
    ),
    (
        "pixel_size = [0.03, 0.04]",
        "pixel_size = [1]",
        "camera.pixel_size is [1]: a width and a height in mm are",
    ),
    (
        "pixel_size = [0.03, 0.04]",
        "pixel-size = 1",
        "camera.pixel-size is not known: did you mean pixel_size?",
    ),
    ("dark = 12", "dark = true", "camera.dark is true: a number of counts, or a file in quotes, is needed"),
    ("dark = 12", 'dark = "dark.jpg"', 'camera.dark is "dark.jpg": a number of counts or a file (.npy, .png'),
    ("dark = 12", "dark = -1", "camera.dark: it is -1, and counts of uint16 go from 0 to 65535"),
    ("dark = 12", "dark = 4001", "camera.bright is not above camera.dark at most of the pixels"),
    (
        "bright = 4000.5",
        "bright = 70000",
        "camera.bright: it is 70000, and counts of uint16 go from 0 to 65535",
    ),
    (
        "bright = 4000.5",
        'bright = "bright.tif"',
        "camera.bright: bright.tif cannot be read: No such file or directory; put",
    ),
    (
        "zenith_gain = 5.7",
        "zenith_gain = 0",
        "camera.zenith_gain is 0: a number of counts a degree, other than 0,",
    ),
    ("zenith_gain = 5.7", "", "camera.zenith_offset is said and camera.zenith_gain is not"),
    ("[camera]", "[kamera]", "kamera is not known: did you mean camera?"),
    ("[stage.roll]", "[stage.rol]", "stage.rol is not known: did you mean roll?"),
    ("[stage.travel]", "[stage.lift]", "stage.lift is not known: there are port, baud"),
]


@pytest.mark.parametrize(("line", "wrong", "said"), WRONG, ids=[f"{row[0]}-{row[1]}"[:60] for row in WRONG])
def test_what_cannot_be_is_refused_with_its_key(refusal, line, wrong, said):
    assert EVERYTHING.count(line) == 1
    assert refusal(EVERYTHING.replace(line, wrong)).startswith(f"r.toml: {said}")


def test_pitch_without_roll_is_refused_and_roll_without_pitch(refusal):
    before, pitch, rest = re.split(r"(?=\[stage\.pitch\])|(?=\[stage\.roll\])", EVERYTHING)
    roll, camera = re.split(r"(?=\[camera\])", rest)
    assert "there is [stage.pitch] and no [stage.roll]" in refusal(before + pitch + camera)
    assert "there is [stage.roll] and no [stage.pitch]" in refusal(before + roll + camera)


@pytest.mark.parametrize("table", ["stage", "camera", "stage.travel"])
def test_a_missing_table_is_told(refusal, table):
    tables = re.split(r"(?=\n\[)", LEAST)
    assert [one for one in tables if one.startswith(f"\n[{table}]")]
    left = "".join(one for one in tables if not one.startswith(f"\n[{table}"))
    assert f"the table [{table}] is missing; add it" in refusal(left)


@pytest.mark.parametrize("text", ["stage = 5", "[stage]\nport='a'\npress=1\ntravel=[1]"])
def test_what_should_be_a_table_and_is_none_is_told(refusal, text):
    assert re.search(r": write \[[a-z.]+\] alone in a line, and its keys below", refusal(text))


# The file itself


@pytest.mark.parametrize("text", ["", "\n# nothing\n"])
def test_an_empty_file_lacks_its_tables(refusal, text):
    assert "the table [stage] is missing" in refusal(text)


def test_a_syntax_error_is_told_with_its_line(refusal):
    said = refusal(LEAST.replace('"COM3"', '"COM3'))
    assert re.match(r"r\.toml is no TOML: .*line 3", said)


@pytest.mark.parametrize("text", ["a = " + "[" * 5000, f"a = {'1' * 5000}", "a = 1\na = 2", "\ufeffa = 1"])
def test_what_no_reader_of_toml_takes_is_told_too(refusal, text):
    assert refusal(text).startswith("r.toml is no TOML: ")


def test_a_file_that_is_no_text_is_told(tmp_path):
    (tmp_path / "r.toml").write_bytes(b'name = "\xff\xfe"')
    with pytest.raises(InputError, match=r"r\.toml is no text: write a rig in TOML"):
        load_rig(tmp_path / "r.toml")


@pytest.mark.parametrize(("name", "said"), [("none.toml", "No such file"), (".", "Is a directory")])
def test_a_missing_file_or_a_folder_is_told(tmp_path, name, said):
    with pytest.raises(InputError, match=f"cannot be read: {said}.*; name a rig file"):
        load_rig(tmp_path / name)


# References


def save(path, picture):
    if path.suffix == ".npy":
        np.save(path, picture)
    else:
        assert cv2.imwrite(str(path), picture)


def with_reference(name):
    return f'{LEAST}bright = "{name}"\n'


PICTURE = np.arange(100, 112, dtype=np.uint8).reshape(3, 4)


@pytest.mark.parametrize("name", ["b.npy", "b.png", "b.tif", "B.TIFF"])
def test_a_reference_beside_the_rig_file_is_read(rig, tmp_path, name):
    save(tmp_path / name, PICTURE)
    camera = rig(with_reference(name)).camera
    assert camera.bright == Path(name)
    found = read_reference(camera.bright, camera, "r.toml")
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, PICTURE)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_mean_of_frames_may_be_a_reference_and_pixels_may_have_none(rig, tmp_path, dtype):
    counts = PICTURE + dtype(0.25)
    counts[0, 0] = np.nan
    np.save(tmp_path / "b.npy", counts)
    camera = rig(with_reference("b.npy") + "dark = 10").camera
    np.testing.assert_array_equal(read_reference(camera.bright, camera, ""), counts.astype(np.float32))
    np.testing.assert_array_equal(read_reference(camera.dark, camera, ""), np.full((3, 4), 10, np.float32))


def test_a_reference_of_a_camera_of_floats_may_lie_anywhere(rig, tmp_path):
    np.save(tmp_path / "b.npy", np.full((3, 4), -7.5, np.float32))
    text = with_reference("b.npy").replace("[4, 3]", '[4, 3]\ndtype = "float32"')
    camera = rig(text).camera
    assert (read_reference(camera.bright, camera, "") == -7.5).all()


@pytest.mark.parametrize(
    ("picture", "said"),
    [
        (PICTURE.T, r"b.npy is 3 x 4, and the camera's pictures 4 x 3 \(columns x rows\)"),
        (PICTURE[0], "b.npy is 4, and the camera's pictures 4 x 3"),
        (np.uint8(3), "b.npy is a single number, and the camera's pictures"),
        (PICTURE.astype(np.uint16), "b.npy is of uint16, and the camera of uint8; take"),
        (PICTURE > 105, "b.npy is of bool, and the camera of uint8"),
        (PICTURE.astype(np.complex64), "b.npy is of complex64"),
        (PICTURE * np.nan, "b.npy holds nothing but NaN"),
        (PICTURE + 200.0, "b.npy holds 300 to 311, and counts of uint8 go from 0 to 255"),
        (np.where(PICTURE == 105, np.inf, PICTURE), "b.npy holds 100 to inf, and counts of uint8"),
    ],
)
def test_a_reference_that_the_camera_cannot_give_is_refused(refusal, tmp_path, picture, said):
    np.save(tmp_path / "b.npy", picture)
    assert re.match(f"r.toml: camera.bright: {said}", refusal(with_reference("b.npy")))


def test_a_damaged_reference_is_refused(refusal, tmp_path):
    save(tmp_path / "b.png", PICTURE)
    (tmp_path / "b.png").write_bytes((tmp_path / "b.png").read_bytes()[:50])
    assert "camera.bright: b.png is damaged or cut off" in refusal(with_reference("b.png"))
    (tmp_path / "b.npy").write_bytes(b"")
    assert "camera.bright: b.npy is no array" in refusal(with_reference("b.npy"))
    np.save(tmp_path / "b.npy", np.array([{}], object))
    assert "camera.bright: b.npy is no array" in refusal(with_reference("b.npy"))
    with (tmp_path / "b.npy").open("wb") as file:
        np.savez(file, PICTURE, PICTURE)
    assert "camera.bright: b.npy holds several arrays" in refusal(with_reference("b.npy"))
    (tmp_path / "b.tif").mkdir()
    assert "camera.bright: b.tif is no file" in refusal(with_reference("b.tif"))


# The documentation


def documented():
    """Return the rows of the tables of keys: {table: {key: default}}."""
    tables, names = {}, []
    for line in DOCS.read_text().split("## What is checked")[0].splitlines():
        if line.startswith("### "):
            names = re.findall(r"`\[([a-z.]+)\]`", line) or [""]
        elif row := re.match(r"\| `([a-z_]+)` .*\| (.*) \|$", line):
            for name in names:
                tables.setdefault(name, {})[row[1]] = row[2]
    return tables


def test_documentation_and_code_name_the_same_keys():
    assert {table: list(keys) for table, keys in documented().items()} == {
        table: list(keys) for table, keys in KEYS.items()
    }


def test_documentation_and_code_agree_on_what_is_needed_and_on_defaults():
    for table, keys in documented().items():
        for key, default in keys.items():
            known = KEYS[table][key].default
            assert (default == "needed") == (known is REQUIRED), (table, key)
            if isinstance(known, int | float):
                assert tomllib.loads(f"a = {default}") == {"a": known}, (table, key)


def test_every_example_in_a_message_can_be_written():
    for table, keys in KEYS.items():
        for key, known in keys.items():
            known.read(tomllib.loads(f"a = {known.example}")["a"]), (table, key)


def test_the_example_of_the_documentation_is_the_template():
    assert f"```toml\n{TEMPLATE}```" in DOCS.read_text()


def test_the_template_loads_with_all_its_keys_and_says_their_defaults(rig, tmp_path):
    plain = rig(TEMPLATE)
    save(tmp_path / "bright.tif", np.full((480, 640), 200, np.uint8))
    whole = re.sub(r"^# (?=\w+ = )", "", TEMPLATE, flags=re.MULTILINE)
    everything = rig(whole)
    said = tomllib.loads(whole)
    tables = {"": said} | {name: said[name] for name in ("stage", "camera")}
    tables |= {f"stage.{name}": said["stage"][name] for name in ("travel", "pitch", "roll")}
    for table, keys in KEYS.items():
        assert set(keys) <= set(tables[table]), table
    assert everything.stage == StageSettings(
        **{name: getattr(plain.stage, name) for name in plain.stage.__slots__} | {"pivot": (0.0, 0.0, 0.0)}
    )
