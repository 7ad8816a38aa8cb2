"""Tables of the travel of each frame, as spreadsheets and stages write them."""

from __future__ import annotations

import math

import pytest

from mirrorskin.cli.stack import read_phases, read_travel
from mirrorskin.cli.table import read_table, unit_of
from mirrorskin.io import InputError

TRAVEL = (0.0, 0.05, 0.1)


def read(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "travel.csv"
    path.write_bytes(text.encode(encoding))
    return read_travel(path).values


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le"])
def test_a_byte_order_mark_is_not_part_of_the_first_number(tmp_path, encoding):
    mark = "\ufeff" if encoding == "utf-16-le" else ""
    assert read(tmp_path, mark + "0\r\n0.05\r\n0.1\r\n", encoding) == pytest.approx(TRAVEL)


@pytest.mark.parametrize(
    "text",
    [
        "travel [um]\n0\n50\n100",
        "z_um\n0\n50\n100",
        "position/\u00b5m\n0\n50\n100",
        "travel (mm)\n0\n0.05\n0.1",
        "travel\n0\n0.05\n0.1",
        "travel, mm\n0\n0.05\n0.1",
        "travel [m]\n0\n5e-5\n1e-4",
        "travel [um]\n0\n50\n0.1mm",
        "# travel [um]\n0\n50\n100",
        "# of the stage\n0 0.05 0.1",
        "0,0.05,0.1",
        "travel [um]\n0 50 100",
        "0mm 0.05mm\n0.1mm",
        "0 mm\n50 um\n0.1 mm",
        "frame,time [s],z [um]\n0,0,0\n1,0.1,50\n2,0.2,100",
        "frame;travel [um]\n0;0\n1;50\n2;100",
        "frame\ttravel [um]\n0\t0\n1\t50\n2\t100",
        "frame travel [um]\n0 0\n1 50\n2 100",
        '"frame","travel, smoothed [um]"\n0,0\n1,50\n2,100',
        "# frame, position [um]\n0,0\n1,50\n2,100",
        "sep=;\nframe;travel [um]\n0;0\n1;50\n2;100",
        "z [um],travel [mm]\n7,0\n8,0.05\n9,0.1",
    ],
)
def test_the_heading_states_the_unit_and_the_column(tmp_path, text):
    assert read(tmp_path, text) == pytest.approx(TRAVEL, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("travel [s]\n0\n1", "the heading 'travel [s]' states the unit 's': seconds are not a length"),
        (
            "travel [steps]\n0\n1",
            "states the unit 'steps': steps is not a known unit (um, mm, cm, m, in, mil, ...); write",
        ),
        ("travel_deg\n0\n1", "states the unit 'deg': degrees are not a length"),
        ("0,05\n0,10\n0,15", "travel.csv, line 1: 0,05: write the number with a decimal point, 0.05"),
        ("travel [mm]\n0,05\n0,10", "line 2: 0,05: write the number with a decimal point, 0.05"),
        ("frame;travel\n0;0,05\n1;0,10", "line 2: 0,05: write the number with a decimal point, 0.05"),
        ("0,05 0,10 0,15", "line 1: 0,05: write the number with a decimal point, 0.05"),
        ("0,05mm\n0,1mm", "line 1: 0,05mm: write the number with a decimal point, 0.05mm"),
        (
            "0 0.05\n1 0.1",
            "has 2 columns without names: name them in a first line, such as frame,",
        ),
        ("0,0.05\n1,0.1", "has 2 columns without names"),
        ("frame,load\n0,1\n1,2", "has the columns frame, load, and none of travels: name one travel"),
        (
            "z_set,z_true\n0,1\n1,2",
            "has several columns of travels, 'z_set' and 'z_true'",
        ),
        ("a,b,travel\n0,1\n1,2", "has 2 columns and 3 names in its first line"),
        ("frame,travel\n0,0.05\n1", "line 3:: a number and a unit are needed"),
    ],
)
def test_what_does_not_state_one_travel_of_each_frame_is_refused(tmp_path, text, message):
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "frame,travel,unit\n0,0,um\n1,50,um\n2,0.1,mm",
        "frame;Unit;travel\n0;\u00b5m;0\n1;\u00b5m;50\n2;\u00b5m;100",
        "frame,travel,travel unit,force,force unit\n0,0,um,1,N\n1,50,um,2,N\n2,100,um,3,N",
        "# travel in um\nframe,travel\n0,0\n1,50\n2,100",
        "# units: um\ntravel\n0\n50\n100",
        "# All lengths are in micrometers.\n# of the stage\nframe,travel\n0,0\n1,50\n2,100",
        "# time in ms, travel in um, pixel size in nm\nframe,travel\n0,0\n1,50\n2,100",
        "# through the lens of 5 mm\n# Unit = um\ntravel\n0\n50\n100",
        "# lens of 5 mm, 0.3 um pixels\nframe,travel\n0,0\n1,0.05\n2,0.1",
        "# pixel size in um\nframe,travel [mm]\n0,0\n1,0.05\n2,0.1",
        "# pixel size in um\nframe,travel\n0,0mm\n1,50um\n2,0.1mm",
        "Position log\nUnits: um\nframe\ttravel\n0\t0\n1\t50\n2\t100",
        "frame,travel\n-,um\n0,0\n1,50\n2,100",
        "frame\ttravel\n[]\t[um]\n0\t0\n1\t50\n2\t100",
        "travel\num\n0\n50\n100",
        "travel in micrometers\n0\n50\n100",
        "Travel (in \u00b5m)\n0\n50\n100",
        "travel_micrometres\n0\n50\n100",
        "frame,travel in um from contact\n0,0\n1,50\n2,100",
        "travel (um, relative)\n0\n50\n100",
    ],
)
def test_a_unit_that_is_stated_elsewhere_is_obeyed(tmp_path, text):
    assert read(tmp_path, text) == pytest.approx(TRAVEL, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "frame,travel [mm],unit\n0,0,um\n1,50,um",
            "states several units, 'mm' ('travel [mm]') and 'um' ('um')",
        ),
        ("frame,travel [mm]\n-,um\n0,0\n1,50", "states several units, 'mm' ('travel [mm]') and 'um' ('um')"),
        (
            "frame,travel,unit\n0,0,um\n1,50,steps",
            "line 3: states the unit 'steps': steps is not a known unit",
        ),
        ("frame,travel,unit\n0,0,s\n1,50,s", "line 2: states the unit 's': seconds are not a length"),
        ("travel in degrees\n0\n1", "states the unit 'degrees': degrees are not a length"),
        (
            "# pixel size in um\nframe,travel\n0,0\n1,50",
            "'pixel size in um' states the unit 'um', but not of which numbers: write travel [um] or",
        ),
        ("# lengths in um\n# positions in mm\ntravel\n0\n50", "states several units, 'um'"),
    ],
)
def test_units_that_contradict_each_other_or_may_be_of_others_are_refused(tmp_path, text, message):
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "text", ["# phases in degrees\nframe,phase\n0,0\n1,90", "phase\ndeg\n0\n90", "phase in degrees\n0\n90"]
)
def test_the_unit_of_phases_is_stated_elsewhere_too(tmp_path, text):
    path = tmp_path / "phases.csv"
    path.write_text(text)
    assert read_phases(path).values == pytest.approx((0.0, math.pi / 2))


@pytest.mark.parametrize("encoding", ["latin-1", "cp1252", "utf-16-be", "mac-roman"])
def test_another_encoding_is_refused_with_the_one_that_is_expected(tmp_path, encoding):
    with pytest.raises(InputError, match=r"is not text in UTF-8: .* Save it in UTF-8"):
        read(tmp_path, "frame;travel [\u00b5m]\n0;0\n1;50", encoding)


def test_a_heading_without_unit_has_none():
    assert unit_of("s", "length", "here") == ""
    assert unit_of("travel", "length", "here") == ""


def test_the_cells_of_a_table_are_without_blanks(tmp_path):
    path = tmp_path / "forces.csv"
    path.write_text("name ; force [mN]\na.h5; 5 \n")
    table = read_table(path, "write it")
    assert (table.heading, [row.cells for row in table.rows]) == (("name", "force [mN]"), [("a.h5", "5")])
