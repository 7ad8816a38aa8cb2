"""Files of phases: accepted forms, and refusals in one line."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.cli.stack import read_phases
from mirrorskin.io import InputError
from mirrorskin.io.model.positions import Positions

MEASURED = [178.1, 220.8, 280.5, 316.5, 7.6, 48.0, 96.3, 136.4]


@pytest.mark.parametrize(
    ("text", "degrees"),
    [
        ("\n".join(f"{angle}deg" for angle in MEASURED), MEASURED),
        (" ".join(f"{angle}deg" for angle in MEASURED) + "\n", MEASURED),
        ("# lights, as measured\n\n 10deg 20deg # two\n#30deg\n\t40deg\r\n", [10, 20, 40]),
        ("10deg, 20deg", [10, 20]),
        ("10 deg\n20 deg", [10, 20]),
        ("frame;phase [deg]\n0;10\n1;20.5", [10, 20.5]),
        ("0rad 3.141592653589793rad 1turn -90\u00b0", [0, 180, 360, -90]),
    ],
)
def test_angles_are_separated_by_blanks_in_any_unit(tmp_path, text, degrees):
    path = tmp_path / "phases.txt"
    path.write_bytes(text.encode())
    phases_read = read_phases(path)
    assert isinstance(phases_read, Positions)
    phases = phases_read.positions(len(degrees))
    assert phases.dtype == np.float64
    np.testing.assert_allclose(np.degrees(phases), degrees, rtol=1e-14, atol=1e-12)


def test_another_number_of_phases_than_of_frames_is_refused(tmp_path):
    path = tmp_path / "phases.txt"
    path.write_text("10deg 20deg 30deg")
    for count in (2, 4):
        with pytest.raises(InputError) as caught:
            read_phases(path).positions(count)
        assert str(caught.value) == f"{path} lists 3 phases for {count} frames: one a frame is needed"


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (b"10deg\n20deg\n\n# three\n30\n", ", line 5: 30: a unit is needed; write e.g. 2.5deg"),
        (b"10,5deg\n20deg", ", line 1: 10,5deg: write the number with a decimal point, 10.5deg"),
        (b"10mm", ", line 1: 10mm: millimeters are not an angle; write e.g. 2.5deg"),
        (b"nandeg", ", line 1: nandeg: a number and a unit are needed; write e.g. 2.5deg"),
        (b"x" * 9999, f", line 1: {'x' * 40}...: a number and a unit are needed; write e.g. 2.5deg"),
        (b"1e999deg", ", line 1: 1e999deg: the number is too large; write e.g. 2.5deg"),
        (b"", " lists no phases: write one angle a frame in it, such as 178.1deg"),
        (b"# 10deg\n", " lists no phases: write one angle a frame in it, such as 178.1deg"),
        (
            b"\x89HDF\r\n\xff",
            " is not text in UTF-8: line 1 contains the byte 0x89. Save it in UTF-8, as Excel's"
            " 'CSV UTF-8' is; write one angle a frame in it, such as 178.1deg",
        ),
        (None, " cannot be read: No such file or directory; write one angle a frame in it, such as 178.1deg"),
    ],
)
def test_a_file_that_lists_no_angles_is_one_line(tmp_path, content, line):
    path = tmp_path / "phases.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_phases(path)
    assert str(caught.value) == f"{path}{line}"


def test_a_folder_is_not_a_file_of_phases(tmp_path):
    with pytest.raises(InputError, match="cannot be read: Is a directory; write one angle"):
        read_phases(tmp_path)
