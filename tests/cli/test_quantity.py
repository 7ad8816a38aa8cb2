import contextlib
import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mirrorskin.cli.quantity import (
    angle,
    compliance,
    duration,
    force,
    frame_range,
    frame_size,
    length,
    lengths,
    memory,
    number,
    per_angle,
    pressure,
    segment,
    vector,
)
from mirrorskin.io import InputError


def two(text, option=""):
    return vector(text, 2, option)


def three(text, option=""):
    return vector(text, 3, option)


READERS = [
    *(angle, compliance, duration, force, frame_size, length, lengths, memory, per_angle, pressure),
    *(segment, two, three),
]


@pytest.mark.parametrize(
    ("text", "millimetres"),
    [
        ("0.1mm", 0.1),
        (" 0.1 mm ", 0.1),
        ("-0.1mm", -0.1),
        ("+3mm", 3.0),
        (".5mm", 0.5),
        ("5.mm", 5.0),
        ("1e-3m", 1.0),
        ("2E1 mm", 20.0),
        ("0.1millimeter", 0.1),
        ("0.1 millimetres", 0.1),
        ("4mil", 0.1016),
        ('1"', 25.4),
        ("5 \u00c5", 5e-7),
        ("100um", 0.1),
        ("100\u00b5m", 0.1),
        ("100\u03bcm", 0.1),
        ("1in", 25.4),
        ("0mm", 0.0),
    ],
)
def test_lengths_are_in_millimetres(text, millimetres):
    assert length(text) == pytest.approx(millimetres, rel=1e-12)


def test_millimetres_are_taken_exactly():
    assert length("0.1mm") == 0.1


@pytest.mark.parametrize(
    ("text", "radians"),
    [
        ("2.5deg", math.radians(2.5)),
        ("45\N{DEGREE SIGN}", math.pi / 4),
        ("-0.1 rad", -0.1),
        ("1turn", math.tau),
        ("3'", math.radians(0.05)),
        ('36"', math.radians(0.01)),
        ("2 revolutions", 2 * math.tau),
    ],
)
def test_angles_are_in_radians(text, radians):
    assert angle(text) == pytest.approx(radians, rel=1e-12)


@pytest.mark.parametrize(
    ("read", "text", "value"),
    [
        (force, "5mN", 0.005),
        (force, "5MN", 5e6),
        (force, "100g", 0.980665),
        (force, "100 gram-force", 0.980665),
        (force, "0.1kgf", 0.980665),
        (pressure, "100kPa", 0.1),
        (pressure, "100 kilopascals", 0.1),
        (pressure, "1bar", 0.1),
        (pressure, "145.0377377psi", 1.0),
    ],
)
def test_forces_are_in_newtons_and_pressures_in_megapascals(read, text, value):
    assert read(text) == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("512MB", 512_000_000),
        ("4.1GB", 4_100_000_000),
        ("2GiB", 2**31),
        ("1kB", 1000),
        ("64 byte", 64),
        ("16bit", 2),
    ],
)
def test_memory_is_in_bytes(text, size):
    assert memory(text) == size
    assert isinstance(memory(text), int)


@pytest.mark.parametrize(
    ("text", "sizes"),
    [("0.03mm", (0.03, 0.03)), ("0.03mm,40um", (0.03, 0.04)), ("30um , 0.04mm", (0.03, 0.04))],
)
def test_one_or_two_lengths(text, sizes):
    assert lengths(text) == pytest.approx(sizes, rel=1e-12)


@pytest.mark.parametrize(
    ("read", "text", "millimetres"),
    [
        (two, "0.01mm,-20um", (0.01, -0.02)),
        (two, " 1 mm , 2 mm ", (1, 2)),
        (three, "0mm,-1cm,0.04m", (0, -10, 40)),
        (lambda text, option: vector(text, 1, option), "1in", (25.4,)),
    ],
)
def test_vectors_have_as_many_lengths_as_are_needed(read, text, millimetres):
    vector_read = read(text, "--o")
    assert isinstance(vector_read, tuple)
    assert vector_read == pytest.approx(millimetres, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "millimetres_per_newton"),
    [("0.01mm/N", 0.01), ("10um/N", 0.01), (" 0.01 mm / N ", 0.01), ("0mm/N", 0.0), ("-1e-5m/N", -0.01)],
)
def test_compliance_is_in_millimetres_a_newton(text, millimetres_per_newton):
    assert compliance(text) == pytest.approx(millimetres_per_newton, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "each_radian"),
    [
        ("5.7/deg", 5.7 * 180 / np.pi),
        ("5.7/rad", 5.7),
        (" 5.7 / mrad ", 5700.0),
        ("-2e3/\u00b0", -360000 / np.pi),
        ("10/turn", 10 / (2 * np.pi)),
        ("0/deg", 0.0),
    ],
)
def test_numbers_over_an_angle_are_those_of_a_radian(text, each_radian):
    assert per_angle(text) == pytest.approx(each_radian, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "seconds"), [("10ms", 0.01), ("0s", 0.0), ("250 us", 2.5e-4), ("1min", 60.0), ("-1s", -1.0)]
)
def test_durations_are_in_seconds(text, seconds):
    assert duration(text) == pytest.approx(seconds, rel=1e-12)


def test_frame_sizes_are_columns_and_rows():
    assert frame_size("640x480") == (640, 480)


@pytest.mark.parametrize(
    "text", ["", "640", "640x", "0x480", "-1x5", "1.5x2", "640*480", "1x2x3", "9" * 99 + "x1"]
)
def test_frame_sizes_that_are_none(text):
    with pytest.raises(InputError, match=r"--size.*write e\.g\. 640x480"):
        frame_size(text, "--size")


@pytest.mark.parametrize("text", ["10:10", "10:9", ":0", "0:0"])
def test_a_range_without_frames_is_refused(text):
    with pytest.raises(InputError, match=r"--frames.* a later one that is left out are needed"):
        frame_range(text, "--frames")


ANGLES = "(rad, mrad, deg, arcmin, gon, turn, ...)"


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (length, "0.1", "--o 0.1: a unit is needed; write e.g. 0.1mm"),
        (length, "0.1s", "--o 0.1s: seconds are not a length; write e.g. 0.1mm"),
        (length, "2px", "--o 2px: pixels are not a length; write e.g. 0.1mm"),
        (length, "2pixel", "--o 2pixel: pixels are not a length; write e.g. 0.1mm"),
        (length, "1foo", "--o 1foo: foo is not a known unit (um, mm, cm, m, in, mil, ...); write e.g. 0.1mm"),
        (length, "1NAN", "--o 1NAN: NAN is not a known unit (um, mm, cm, m, in, mil, ...); write e.g. 0.1mm"),
        (
            length,
            "1lambda",
            "--o 1lambda: lambda is not a known unit (um, mm, cm, m, in, mil, ...); write e.g. 0.1mm",
        ),
        (length, "1e400mm", "--o 1e400mm: the number is too large; write e.g. 0.1mm"),
        (length, "1e308km", "--o 1e308km: the number is too large; write e.g. 0.1mm"),
        (
            angle,
            "5percent",
            f"--o 5percent: percent is not a known unit {ANGLES}; write e.g. 2.5deg",
        ),
        (
            angle,
            "5dB",
            f"--o 5dB: dB is not a known unit {ANGLES}; write e.g. 2.5deg",
        ),
        (angle, "5byte", "--o 5byte: bytes are not an angle; write e.g. 2.5deg"),
        (
            angle,
            "3pi",
            f"--o 3pi: pi is not a known unit {ANGLES}; write e.g. 2.5deg",
        ),
        (length, "1psi", "--o 1psi: psi is not a length; write e.g. 0.1mm"),
        (force, "1MM", "--o 1MM: MM is not a known unit (mN, N, gf, kgf, lbf, g, kg, ...); write e.g. 1.5N"),
        (memory, "512", "--o 512: a unit is needed; write e.g. 512MB"),
        (memory, "5rad", "--o 5rad: radians are not an amount of memory; write e.g. 512MB"),
        (memory, "0MB", "--o 0MB: at least one byte is needed; write e.g. 512MB"),
        (memory, "-1MB", "--o -1MB: at least one byte is needed; write e.g. 512MB"),
        (lengths, "1mm,2mm,3mm", "--o 1mm,2mm,3mm: one or two lengths are needed; write e.g. 0.03mm,0.04mm"),
        (lengths, "0.1mm,", "--o: a number and a unit are needed; write e.g. 0.1mm"),
        (two, "1mm", "--o 1mm: 2 lengths are needed; write e.g. 0mm,1mm"),
        (two, "1mm,2mm,3mm", "--o 1mm,2mm,3mm: 2 lengths are needed; write e.g. 0mm,1mm"),
        (three, "1mm,2mm", "--o 1mm,2mm: 3 lengths are needed; write e.g. 0mm,0mm,1mm"),
        (three, "1mm,2mm,3", "--o 3: a unit is needed; write e.g. 0.1mm"),
        (three, "1mm,2mm,3deg", "--o 3deg: degrees are not a length; write e.g. 0.1mm"),
        (three, "", "--o: a number and a unit are needed; write e.g. 0.1mm"),
        (compliance, "0.01mm/kg", "--o 0.01mm/kg: a length for each newton is needed; write e.g. 0.01mm/N"),
        (compliance, "0.01mm/n", "--o 0.01mm/n: a length for each newton is needed; write e.g. 0.01mm/N"),
        (compliance, "", "--o: a length for each newton is needed; write e.g. 0.01mm/N"),
        (compliance, "/N", "--o: a number and a unit are needed; write e.g. 0.1mm"),
        (compliance, "1mm/N/N", "--o 1mm/N: a number and a unit are needed; write e.g. 0.1mm"),
        (per_angle, "5.7deg", "--o 5.7deg: a number over a unit of angle is needed; write e.g. 5.7/deg"),
        (per_angle, "nan/deg", "--o nan/deg: a number over a unit of angle is needed; write e.g. 5.7/deg"),
        (per_angle, "5/2deg", "--o 5/2deg: a number over a unit of angle is needed; write e.g. 5.7/deg"),
        (per_angle, "5/deg/s", "--o 5/deg/s: a number over a unit of angle is needed; write e.g. 5.7/deg"),
        (per_angle, "5/deg**9", "--o 5/deg**9: a number over a unit of angle is needed; write e.g. 5.7/deg"),
        (per_angle, "5V/deg", "--o 5V/deg: a number over a unit of angle is needed; write e.g. 5.7/deg"),
        (
            per_angle,
            "5/foo",
            f"--o 5/foo: foo is not a known unit {ANGLES}; write e.g. 5.7/deg",
        ),
        (per_angle, "1e308/deg", "--o 1e308/deg: the number is too large; write e.g. 5.7/deg"),
        (duration, "10Hz", "--o 10Hz: hertz are not a time; write e.g. 10ms"),
    ],
)
def test_messages_name_the_option_the_value_and_an_example(read, text, message):
    with pytest.raises(InputError) as caught:
        read(text, "--o")
    assert str(caught.value) == message


@pytest.mark.parametrize(
    "text",
    [
        "",
        "mm",
        "'",
        '"',
        "nan mm",
        "inf mm",
        "-inf mm",
        "5 mm mm",
        "2*3mm",
        "1mm**2",
        "1mm/s",
        "1_000mm",
        "0x1mm",
        "--1mm",
        "1e mm 2",
        "5mm\u00b2",
        "\u22121mm",
        "\u0663mm",
        "(1mm)",
        "{1mm}",
        "1 mm # length",
        "1__class__",
        "__import__('os').system('exit 3')",
        "1mm; import os",
    ],
)
@pytest.mark.parametrize("read", [length, angle, duration, memory])
def test_what_is_not_one_number_and_one_unit_is_refused(read, text):
    with pytest.raises(InputError, match="a number and a unit are needed; write e"):
        read(text, "--travel-step")


def test_messages_are_one_line():
    with pytest.raises(InputError) as caught:
        length("1\nmm\r\nmm", "--o")
    assert str(caught.value) == "--o 1 mm mm: a number and a unit are needed; write e.g. 0.1mm"


NUMBERS = st.floats().map(repr) | st.integers().map(str)
WORDS = st.text("abcdefghiklmnoprstuvxyzABCDEGKMNPRTW\u00b5\u03bc", max_size=5) | st.text(max_size=4)
ONE = st.builds("{}{}".format, NUMBERS, WORDS | st.sampled_from(["mm", "deg", "s", "MB"]))


@settings(deadline=None, max_examples=150)
@given(
    st.text(max_size=12)
    | ONE
    | ONE.map("{}/N".format)
    | ONE.map("3/{}".format)
    | st.lists(ONE, max_size=4).map(",".join)
)
def test_any_text_is_a_finite_number_or_an_input_error(text):
    for read in READERS:
        with contextlib.suppress(InputError):
            assert np.all(np.isfinite(np.asarray(read(text), float)))


def test_a_segment_is_two_points():
    assert segment("-2mm,0mm:0.3cm,1mm") == ((-2.0, 0.0), (3.0, 1.0))


@pytest.mark.parametrize(
    "text", ["1mm,1mm", "1mm,1mm:1mm,1mm", "1mm:2mm", "1mm,2mm:3mm,4mm:5mm,6mm", "1,2:3,4"]
)
def test_what_is_not_a_segment_is_refused(text):
    with pytest.raises(InputError, match="--section"):
        segment(text, "--section")


@pytest.mark.parametrize(
    ("read", "text", "written"),
    [
        (length, "0,05mm", "0.05mm"),
        (lengths, "0,05mm", "0.05mm"),
        (lengths, "0,03mm,0,04mm", "0.03mm"),
        (two, "-0,5mm,1,5mm", "-0.5mm"),
        (segment, "-2,5mm,0mm:2mm,0mm", "-2.5mm"),
        (angle, "22,5deg", "22.5deg"),
        (memory, "4,1GB", "4.1GB"),
        (per_angle, "5,7/deg", "5.7/deg"),
        (compliance, "0,01mm/N", "0.01mm"),
        (number, "0,25", "0.25"),
    ],
)
def test_a_decimal_comma_is_named(read, text, written):
    with pytest.raises(
        InputError, match=rf"^--o .*: write the number with a decimal point, {re.escape(written)}$"
    ):
        read(text, "--o")
