"""Texts of a result in text files, or as texts in other files: printable, and each on one line."""

import csv
import json
import struct
import zipfile

import numpy as np
import pytest
import tifffile

from mirrorskin import io
from mirrorskin.io.base.text import one_line, printable
from mirrorskin.io.formats.registry import export_suffixes

ODD = {
    "program": "mirror\x1b]0;owned\x07skin \u5de5\u5177",
    "version": "1\n# forged: line\r\x85\u2028x",
    "source": "a\x00b\x1b[2J\u202e.h5",
    "date": "2026\x7f\udcff",
}
SECTION = {"distance": np.arange(3.0), "height": np.array([0.0, np.nan, 1.0])}
SUFFIXES = export_suffixes()


@pytest.fixture
def odd(slope):
    """A result whose texts hold control codes, line ends and letters beyond ASCII."""
    return slope.assign(process={**slope.process, **ODD})


def texts_of(path):
    """Return what a file says in words."""
    data = path.read_bytes()
    if path.suffix in (".csv", ".obj", ".xyz"):
        return data.decode()
    if path.suffix == ".ply":
        return data.partition(b"end_header")[0].decode("ascii")
    if path.suffix == ".stl":
        return data[:80].decode("ascii")
    if path.suffix == ".png":
        return "\n".join(png_texts(data))
    with tifffile.TiffFile(path) as file:
        tags = file.pages[0].tags
        return "\n".join([tags["ImageDescription"].value, tags["Software"].value])


def png_texts(data):
    at = 8
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        if kind in (b"tEXt", b"iTXt"):
            body = data[at + 8 : at + 8 + size]
            yield body.replace(b"\0", b" ").decode("utf-8" if kind == b"iTXt" else "latin-1")
        at += 12 + size


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj", ".xyz", ".png", ".tif", ".tiff", ".csv"])
def test_no_control_code_of_a_result_gets_into_a_text(odd, tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    io.export_result(odd, path, section=SECTION)
    texts = texts_of(path)
    assert [letter for letter in texts if letter != "\n" and not letter.isprintable()] == []
    assert not any(line.startswith(("forged", "# forged")) for line in texts.splitlines())


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_takes_any_text(odd, tmp_path, suffix):
    assert io.export_result(odd, tmp_path / f"a{suffix}", section=SECTION)


def test_a_program_beyond_ascii_is_escaped_in_a_tiff(slope, tmp_path):
    io.export_result(slope.assign(process={**slope.process, "program": "\u5de5\u5177"}), tmp_path / "a.tif")
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert file.pages[0].tags["Software"].value.startswith(r"\u5de5\u5177")


def test_arrays_keep_texts_as_they_are_in_json(odd, tmp_path):
    io.export_result(odd, tmp_path / "a.npz")
    with zipfile.ZipFile(tmp_path / "a.npz") as archive, archive.open("process.npy") as member:
        assert json.loads(str(np.load(member)))["program"] == ODD["program"]


def test_a_table_has_as_many_rows_as_values(odd, tmp_path):
    io.export_result(odd, tmp_path / "a.csv", section=SECTION)
    lines = (tmp_path / "a.csv").read_text(encoding="utf-8").splitlines()
    rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    assert [len(row) for row in rows] == [2, 2, 2, 2]


def test_what_prints():
    assert printable("a\x1b[2J\n\u5de5") == "a?[2J?\u5de5"
    assert one_line(" a\n\tb\u2028c\udcff ") == "a b c?"
