"""Surfaces of other programs: what is exported comes back, and what instruments write is read or refused."""

from __future__ import annotations

import struct
import zipfile
import zlib
from pathlib import Path

import gsffile
import numpy as np
import pytest
import surfalize
import x3pio
from commands import done, refused, run

from mirrorskin import engine, io
from mirrorskin.io.formats import registry

HEIGHT = np.array([[1.0, 2.0, 3.0, 4.0], [5.0, np.nan, 7.0, 8.0], [9.0, 10.0, 11.5, 12.0]])  # µm
SIZE = 0.02, 0.05  # mm along x and y
OBLONG = pytest.mark.filterwarnings("ignore:The surface has different pixel size in x and y")
DECODED = [form for form in registry.formats(installed=False) if form.decoder]
EXPORTED = [form.suffixes[0] for form in DECODED if form.encoder]


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def press(place=(0.0, 0.0), **changes):
    """Return a result of a press; the picture's centre is at a place."""
    x, y = io.pixel_axes(HEIGHT.shape, SIZE)
    height = (HEIGHT * 1e-3 - 1).astype(np.float32)
    process = {"program": "mirrorskin", "version": "1.2.3", "date": "2026-01-02T03:04:05+00:00"}
    return io.Result(height=height, x=x + place[0], y=y + place[1], process=process).assign(**changes)


def read(path, expected=HEIGHT, *, place=None, size=SIZE, atol=1e-6):
    """Read a surface, whose heights in µm and positions are as expected."""
    result = io.open_result(path)
    np.testing.assert_allclose(1e3 * result.height, expected, atol=1e3 * atol, rtol=1e-6)
    x, y = io.pixel_axes(np.shape(expected), size)
    first = (x[0], y[0]) if place is None else place
    np.testing.assert_allclose(result.x, x - x[0] + first[0], atol=1e-6)
    np.testing.assert_allclose(result.y, y - y[0] + first[1], atol=1e-6)
    return result


def notes(result):
    return result.process.get("notes", "")


# What is exported.


@pytest.mark.parametrize("suffix", EXPORTED)
@pytest.mark.parametrize("place", [(0.0, 0.0), (3.0, -0.5)], ids=["centred", "part"])
def test_what_is_exported_comes_back(suffix, place):
    result = press(place)
    io.export_result(result, f"a{suffix}")
    back = io.open_result(f"a{suffix}")
    np.testing.assert_allclose(back.height, result.height, atol=1e-7)
    np.testing.assert_allclose(back.x, result.x, atol=1e-6)
    np.testing.assert_allclose(back.y, result.y, atol=1e-6)
    assert back.offset_unknown is None
    assert back.process["date"] == result.process["date"]


@pytest.mark.parametrize("suffix", EXPORTED)
@pytest.mark.parametrize("height", [0.0, -0.25])
def test_equal_heights_come_back(suffix, height):
    x, y = io.pixel_axes((2, 3), SIZE)
    io.export_result(io.Result(height=np.full((2, 3), height, np.float32), x=x, y=y), f"a{suffix}")
    np.testing.assert_allclose(io.open_result(f"a{suffix}").height, height, atol=1e-9)


@pytest.mark.parametrize("suffix", EXPORTED)
def test_notes_of_an_export_come_back(suffix):
    filled = np.zeros(HEIGHT.shape, np.uint8)
    filled[0, 0] = 1
    relative = {"component": np.where(np.isnan(HEIGHT), -1, 0), "offset_unknown": np.ones(1, np.uint8)}
    process = {**press().process, "warnings": "the light flickers by 3 %; frame 3: lost"}
    io.export_result(press(filled=filled, process=process, **relative), f"a{suffix}")
    back = io.open_result(f"a{suffix}")
    assert back.offset_unknown.all()
    assert "1 of 11 heights were not measured but filled" in back.process["warnings"]
    assert "the light flickers by 3 %; frame 3: lost" in back.process["warnings"]


@pytest.mark.parametrize("suffix", EXPORTED)
def test_measures_are_those_of_the_result(suffix):
    io.export_result(press(), f"a{suffix}")
    expected, measures = (engine.measure(result).quantities for result in (press(), f"a{suffix}"))
    assert expected.keys() == measures.keys()
    assert "volume below rest plane" in measures
    for name in [*expected][:6]:
        assert measures[name].value == pytest.approx(expected[name].value, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("suffix", EXPORTED)
@pytest.mark.parametrize("line", ["view {} -o a.png", "report {} -o a.html", "export {} -o a.ply -o b.sur"])
def test_commands_take_a_surface(suffix, line):
    io.export_result(press(), f"a{suffix}")
    done(line.format(f"a{suffix}"))


@pytest.mark.parametrize("suffix", EXPORTED)
def test_a_surface_is_described(suffix):
    io.export_result(press(), f"a{suffix}")
    facts = io.describe(f"a{suffix}")
    assert facts["kind"] == f"surface, {suffix[1:].upper()}"
    assert facts["map height"] == "3 x 4 float32 mm"


@pytest.mark.parametrize("suffix", EXPORTED)
def test_a_surface_is_not_taken_for_frames(suffix):
    io.export_result(press(), f"a{suffix}")
    for line in ("check a{}", "fuse a{} a{} -o b.h5", "reconstruct a{} -o b.h5"):
        refused("holds a surface, not frames", line.format(suffix, suffix))


@OBLONG
def test_all_formats_have_the_same_row_at_the_top():
    for suffix in EXPORTED:
        io.export_result(press(), f"a{suffix}")
    pictures = [surfalize.Surface.load(f"a{suffix}").data for suffix in (".x3p", ".sur")]
    pictures.append(gsffile.read_gsf("a.gsf")[0] * 1e6)
    for picture in pictures:
        np.testing.assert_allclose(picture, HEIGHT - 1000, atol=1e-3)


def test_a_content_is_known_whatever_its_name():
    io.export_result(press(), "a.sur")
    Path("a.sur").rename("a.gsf")
    assert io.describe("a.gsf")["kind"] == "surface, SUR"
    Path("a.gsf").rename("a.dat")
    assert io.describe("a.dat")["kind"] == "surface, SUR"


def bumps(x, y):
    """Return a surface without symmetry, mm."""
    return 0.05 * (np.sin(1.1 * x + 0.3 * y) + np.cos(0.7 * y - 0.4 * x) + np.sin(0.5 * x * y))


@pytest.mark.parametrize("suffix", EXPORTED)
def test_surfaces_without_standard_deviations_are_stitched(suffix):
    x, y = io.pixel_axes((60, 80), (0.05, 0.05))
    random = np.random.default_rng(3)
    for name, shift, offset in (("a", 0.0, 0.0), ("b", 1.0, 0.3)):
        height = bumps(x + shift, y[:, None]) + offset + random.normal(0, 1e-3, (60, 80))
        relative = {"component": np.zeros((60, 80), np.int32), "offset_unknown": np.ones(1, np.uint8)}
        io.export_result(io.Result(relative, height=height.astype(np.float32), x=x, y=y), f"{name}{suffix}")
    done("stitch", f"a{suffix}", f"b{suffix}", "-o", "both.h5")
    both = io.open_result("both.h5")
    assert both.height.shape == (60, 100)
    error = both.height - bumps(both.x, both.y[:, None])
    assert np.nanmean(((error - np.nanmean(error)) / both.height_sigma) ** 2) < 2
    assert both.offset_unknown.all()
    assert "a noise of 0.001 mm is estimated from second differences" in both.process["warnings"]


# X3P.


def write_x3p(path="a.x3p", height=HEIGHT, **options):
    options = {"revision": x3pio.Revision.ISO5436_2000, "x_scale": 2e-5, "y_scale": 5e-5, **options}
    x3pio.write(path, np.asarray(height) * 1e-6, **options)


def edit(path, change, name="main.xml"):
    """Change a file in an X3P without its checksum."""
    with zipfile.ZipFile(path) as archive:
        files = {member: archive.read(member) for member in archive.namelist()}
    files[name] = change(files[name])
    with zipfile.ZipFile(path, "w") as archive:
        for member, content in files.items():
            archive.writestr(member, content)


@pytest.mark.parametrize("z_type", x3pio.DataType)
@pytest.mark.parametrize("storage", x3pio.DataStorage)
def test_every_type_of_an_x3p_is_read(z_type, storage):
    write_x3p(z_type=z_type, storage=storage)
    result = read("a.x3p", atol=2e-7)
    assert result.offset_unknown.all()
    assert notes(result) == "ISO5436 - 2000: its first row is the top one"


def test_the_amendment_of_x3p_has_its_first_row_lowest():
    write_x3p(revision=x3pio.Revision.ISO25178_72_2017_DAM1)
    result = read("a.x3p", HEIGHT[::-1])
    assert notes(result) == "ISO25178-72:2017/DAM1: its first row is the lowest one"


@pytest.mark.parametrize("revision", x3pio.Revision)
def test_offsets_of_an_x3p_are_positions(revision):
    placement = x3pio.Placement.translation(1e-3, 2e-3, 4e-6)
    system = x3pio.CoordinateSystem.VIEW
    write_x3p(placement=placement, coordinate_system=system, revision=revision)
    top = revision is x3pio.Revision.ISO5436_2000
    expected = HEIGHT + 4 if top else HEIGHT[::-1] + 4
    read("a.x3p", expected, place=(1.0, -2.0 if top else 2.0 + 2 * SIZE[1]))


def test_a_rotation_of_an_x3p_is_noted():
    placement = x3pio.Placement.from_axis_angle([1, 0, 0], 0.1)
    write_x3p(placement=placement, coordinate_system=x3pio.CoordinateSystem.VIEW)
    assert "the rotation in the file is not applied to heights" in notes(read("a.x3p"))


def write_points(x, y, **options):
    options = {"revision": x3pio.Revision.ISO25178_72_2017_DAM1, **options}
    points = np.stack([*np.broadcast_arrays(1e-3 * x, 1e-3 * y), 1e-6 * HEIGHT], axis=-1)
    x3pio.Surface.from_points(points, **options).save("a.x3p")


@pytest.mark.parametrize("data_type", [x3pio.DataType.FLOAT64, x3pio.DataType.INT32])
def test_absolute_axes_on_a_grid_are_read(data_type):
    x, y = 7 + 0.02 * np.arange(4), 3 - 0.05 * np.arange(3)[:, None]
    write_points(x, y, data_type=data_type)
    read("a.x3p", place=(7.0, 3.0), atol=1e-6)


def test_absolute_axes_off_a_grid_are_refused():
    x, y = 0.02 * np.arange(4) ** 1.3, 0.05 * np.arange(3)[:, None]
    write_points(x, y)
    refused("a.x3p: its positions along x are not on a regular grid: resample it", "measure a.x3p")


def test_other_features_of_an_x3p_are_refused():
    x3pio.write("a.x3p", HEIGHT[0] * 1e-6, x_scale=1e-6)
    refused("it holds a profile, not a surface", "measure a.x3p")
    x3pio.write_points("a.x3p", np.zeros((5, 3)))
    refused("it holds a cloud of points, not a surface", "measure a.x3p")
    x3pio.write("a.x3p", np.zeros((2, 3, 4)), x_scale=1e-6, y_scale=1e-6)
    refused("it has 2 layers", "measure a.x3p")


def test_a_wrong_checksum_of_heights_is_refused():
    write_x3p()
    edit("a.x3p", lambda data: data[::-1], "bindata/data.bin")
    refused("MD5 checksum of 'bindata/data.bin' does not match", "measure a.x3p")


def test_an_edited_description_is_warned_of():
    write_x3p()
    edit("a.x3p", lambda text: text.replace(b"<Comment", b" <Comment").replace(b"<Record4>", b" <Record4>"))
    assert "the checksum of main.xml does not match" in read("a.x3p").process["warnings"]


def test_a_bomb_in_an_x3p_is_refused():
    write_x3p()
    with zipfile.ZipFile("a.x3p", "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("notes.xml", bytes(65 << 20))
    refused("notes.xml in it takes 68157440 bytes of memory", "measure a.x3p")


@OBLONG
def test_an_x3p_of_surfalize_is_read():
    surfalize.Surface(HEIGHT, 20, 50).save("a.x3p")
    read("a.x3p")


# SUR.


def sur(counts, *, comment=b"", private=b"", packed=False, streams=1, **changes):
    """Return a file of Digital Surf; names and places of the fields are those of its specification."""
    counts = np.asarray(counts)
    fields = {
        "signature": (0, "12s", b"DSCOMPRESSED" if packed else b"DIGITAL SURF"),
        "format": (12, "h", 0),
        "objects": (14, "h", 1),
        "version": (16, "h", 1),
        "kind": (18, "h", 2),
        "special": (86, "h", 1),
        "bits": (98, "h", 8 * counts.itemsize),
        "lowest": (100, "i", 1),
        "highest": (104, "i", 30000),
        "columns": (108, "i", counts.shape[1]),
        "rows": (112, "i", counts.shape[0]),
        "points": (116, "i", counts.size),
        "step_x": (120, "f", 20.0),
        "step_y": (124, "f", 0.05),
        "step_z": (128, "f", 0.5),
        "unit_x": (180, "16s", b"\xb5m".ljust(16)),
        "unit_y": (196, "16s", b"mm".ljust(16)),
        "unit_z": (212, "16s", "µm\0".encode()),
        "inverted": (290, "h", 0),
        "comment": (334, "H", len(comment)),
        "private": (336, "H", len(private)),
        "offset_x": (466, "f", 0.0),
        "offset_y": (470, "f", 0.0),
        "offset_z": (474, "f", 0.25),
    }
    head = bytearray(512)
    for name, (place, kind, value) in fields.items():
        struct.pack_into(f"<{kind}", head, place, changes.get(name, value))
    data = counts.tobytes()
    if packed:
        size = -(-len(data) // streams)
        parts = [data[place : place + size] for place in range(0, len(data), size)]
        stored = [zlib.compress(part) for part in parts]
        sizes = np.array([(len(part), len(zipped)) for part, zipped in zip(parts, stored, strict=True)])
        data = b"".join([struct.pack("<I", len(parts)), sizes.astype("<u4").tobytes(), *stored])
    return bytes(head) + comment + private + data


def counts(dtype, hole=-1):
    values = np.where(np.isnan(HEIGHT), hole, 2 * HEIGHT)
    return values.astype(dtype)


EXPECTED = HEIGHT + 0.25  # counts of 0.5 µm above an offset


@pytest.mark.parametrize("dtype", ["<i2", "<i4"])
@pytest.mark.parametrize("packed", [0, 1, 3])
def test_every_kind_of_sur_is_read(dtype, packed):
    content = sur(
        counts(dtype), packed=packed > 0, streams=packed, comment=b"Coin \xb5", private=bytes(40000)
    )
    Path("a.sur").write_bytes(content)
    result = read("a.sur", EXPECTED)
    assert result.process["comment"] == "Coin µ"
    assert result.offset_unknown.all()


def test_offsets_of_a_sur_are_positions():
    Path("a.sur").write_bytes(sur(counts("<i4"), offset_x=1000.0, offset_y=2.0))
    read("a.sur", EXPECTED, place=(1.0, -2.0))


def test_negative_counts_of_a_sur_are_heights():
    Path("a.sur").write_bytes(sur(counts("<i2") - 20000, lowest=-19999, highest=-19970))
    read("a.sur", EXPECTED - 10000)


def test_saturated_points_of_a_sur_are_holes():
    values = counts("<i2")
    values[0, 0], values[2, 3] = 0, 25  # below the lowest count, 1, and above the highest
    Path("a.sur").write_bytes(sur(values, highest=24))
    expected = EXPECTED.copy()
    expected[0, 0] = expected[2, 3] = np.nan
    assert "saturated points left out: 2" in notes(read("a.sur", expected))


def test_a_sur_without_special_points_has_no_holes():
    Path("a.sur").write_bytes(sur(counts("<i2"), special=0))
    expected = np.where(np.isnan(HEIGHT), -0.25, EXPECTED)
    read("a.sur", expected)


def test_notes_tell_what_a_sur_contains_besides():
    Path("a.sur").write_bytes(sur(counts("<i2"), inverted=2, kind=13) + bytes(999))
    result = read("a.sur", EXPECTED)
    assert "inverted or mirrored: they are taken as stored" in notes(result)
    assert "its colours are left out" in notes(result)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"kind": 12}, "it holds an image: save one surface"),
        ({"kind": 21}, "it holds an object of kind 21"),
        ({"objects": 3}, "it holds 3 objects"),
        ({"format": 257}, "byte order of Macintosh"),
        ({"bits": 8}, "its points have 8 bits"),
        ({"points": 5}, "it states 5 points, which are not 4 x 3"),
        ({"rows": -3}, "it states 4 x -3 points"),
        ({"rows": 70000, "columns": 70000, "points": 605032704}, "bytes of memory"),
        ({"rows": 300, "points": 1200}, "it is cut short: 12 of 1200 points are there"),
        ({"unit_z": b"V".ljust(16)}, "its heights are in 'V', and only lengths are read"),
        ({"unit_x": b" " * 16}, "it states no unit of its spacing along x"),
        ({"step_x": 0.0}, "the spacing of its points is 0 x 0.05 mm, which is not positive"),
        ({"step_z": np.nan}, "the spacing of its heights is nan"),
        ({"lowest": 3, "highest": 0}, ""),
    ],
)
def test_what_a_sur_cannot_hold_is_refused(changes, line):
    Path("a.sur").write_bytes(sur(counts("<i2"), **changes))
    if line:
        refused(f"a.sur: {line}" if "bytes" not in line and "byte" not in line else line, "measure a.sur")
    else:
        assert run("measure a.sur").code == 0


def test_damaged_streams_of_a_sur_are_refused():
    content = sur(counts("<i2"), packed=True)
    Path("a.sur").write_bytes(content[:-6])
    refused("its compressed heights are cut short", "measure a.sur")
    Path("a.sur").write_bytes(content[:-12] + bytes(12))
    refused("its compressed heights are", "measure a.sur")
    bomb = sur(np.zeros((1000, 1000), "<i4"), packed=True, columns=4, rows=3, points=12)
    Path("a.sur").write_bytes(bomb)
    refused("its compressed heights are cut short, or too many", "measure a.sur")


@OBLONG
@pytest.mark.parametrize("compressed", [False, True])
def test_a_sur_of_surfalize_is_read(compressed):
    surfalize.Surface(HEIGHT, 20, 50).save("a.sur", compressed=compressed)
    read("a.sur")


# GSF.


def test_a_gsf_of_another_program_is_read():
    fields = {"XReal": 80, "YReal": 150, "XYUnits": "um", "ZUnits": "nm", "Title": "Coin", "Speed": 3}
    gsffile.write_gsf("a.gsf", (1e3 * HEIGHT).astype(np.float32), fields)
    assert read("a.gsf").process["title"] == "Coin"
    gsffile.write_gsf("a.gsf", (1e3 * HEIGHT).astype(np.float32), fields | {"XOffset": 1000, "YOffset": 2e3})
    read("a.gsf", place=(1.0 + SIZE[0] / 2, -2.0 - SIZE[1] / 2))


@pytest.mark.parametrize(
    ("fields", "line"),
    [
        ({"XYUnits": "m", "ZUnits": "m", "YReal": 1}, "it states no XReal"),
        ({"XReal": 1, "YReal": 1, "ZUnits": "m"}, "it states no unit of its positions"),
        ({"XReal": 1, "YReal": 1, "XYUnits": "m"}, "it states no unit of its heights"),
        ({"XReal": 1, "YReal": 1, "XYUnits": "m", "ZUnits": "A"}, "its heights are in 'A'"),
        ({"XReal": "wide", "YReal": 1, "XYUnits": "m", "ZUnits": "m"}, "its XReal is 'wide'"),
        ({"XReal": -1, "YReal": 1, "XYUnits": "m", "ZUnits": "m"}, "the spacing of its points is -250"),
    ],
)
def test_a_gsf_that_lacks_something_is_refused(fields, line):
    head = "".join(f"{name} = {value}\n" for name, value in {"XRes": 4, "YRes": 3, **fields}.items())
    head = f"Gwyddion Simple Field 1.0\n{head}".encode()
    Path("a.gsf").write_bytes(head + bytes(4 - len(head) % 4) + HEIGHT.astype("<f4").tobytes())
    refused(f"a.gsf: {line}", "measure a.gsf")


# GWY.


def component(name, value):
    """Return a component of a file of Gwyddion."""
    head = name.encode() + b"\0"
    if isinstance(value, np.ndarray):
        return head + b"D" + struct.pack("<I", value.size) + value.astype("<f8").tobytes()
    if isinstance(value, bytes):
        return head + b"o" + value
    if isinstance(value, str):
        return head + b"s" + value.encode() + b"\0"
    return head + (
        b"i" + struct.pack("<i", value) if isinstance(value, int) else b"d" + struct.pack("<d", value)
    )


def gwy_object(name, **components):
    data = b"".join(component(key.replace("__", "/"), value) for key, value in components.items())
    return name.encode() + b"\0" + struct.pack("<I", len(data)) + data


def field(values, unit="m", **changes):
    """Return a data field with a pixel size of 20 x 50 µm."""
    units = {"si_unit_xy": "um", "si_unit_z": unit}
    entries = {"xres": 4, "yres": 3, "xreal": 80.0, "yreal": 150.0} | changes
    entries |= {name: gwy_object("GwySIUnit", unitstr=text) for name, text in units.items()}
    return gwy_object("GwyDataField", **entries, data=np.asarray(values))


def write_gwy(path="a.gwy", **channels):
    Path(path).write_bytes(b"GWYP" + gwy_object("GwyContainer", **channels))


def test_the_channel_of_heights_of_a_gwy_is_read():
    height, volts = field(1e-6 * HEIGHT), field(HEIGHT, "V")
    write_gwy(__0__data=volts, __7__data=height, __7__data__title="Topo", __0__data__title="Error")
    result = read("a.gwy")
    assert result.process["title"] == "Topo"
    assert notes(result) == "channels left out: Error"


def test_the_mask_and_the_offsets_of_a_gwy_are_obeyed():
    mask = np.zeros((3, 4))
    mask[0, 1] = 1
    moved = field(1e-6 * HEIGHT, xoff=1000.0, yoff=-500.0)
    write_gwy(__0__data=moved, __0__mask=field(mask, ""))
    expected = np.where(mask > 0, np.nan, HEIGHT)
    result = read("a.gwy", expected, place=(1.0 + SIZE[0] / 2, 0.5 - SIZE[1] / 2))
    assert notes(result) == "masked points left out: 1"


def test_a_gwy_of_several_heights_is_refused():
    height = field(1e-6 * HEIGHT)
    write_gwy(__0__data=height, __1__data=height, __1__data__title="Back")
    refused("a.gwy: it has 2 channels of heights (channel 0, Back): save one of them alone", "measure a.gwy")
    write_gwy(__0__data=field(HEIGHT, "V"))
    refused("a.gwy: it has 0 channels of heights (none)", "measure a.gwy")


# Damage, of every format.


def sample(suffix):
    """Write a sound file, and return its path and content."""
    path = Path(f"a{suffix}")
    if suffix == ".gwy":
        write_gwy(path, __0__data=field(1e-6 * HEIGHT), __0__data__title="Topo")
    else:
        io.export_result(press(), path)
    return path, path.read_bytes()


SUFFIXES = [form.suffixes[0] for form in DECODED]
CONTENT = {
    "empty": b"",
    "a text": b"heights, of which there are none\n" * 20,
    "zeros": bytes(4096),
    "noise": np.random.default_rng(0).bytes(4096),
}


@pytest.mark.parametrize("content", CONTENT)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_that_is_not_of_its_format_is_refused(suffix, content):
    Path(f"a{suffix}").write_bytes(CONTENT[content])
    for line in ("measure", "info"):
        refused(f"a{suffix}: ", f"{line} a{suffix}")


@pytest.mark.parametrize("kept", [0.02, 0.3, 0.6, 0.9, 0.99])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_surface_that_is_cut_is_refused(suffix, kept):
    path, content = sample(suffix)
    path.write_bytes(content[: int(len(content) * kept)])
    refused(f"{path}: ", f"measure {path}")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_flipped_bytes_are_read_or_refused(suffix):
    path, content = sample(suffix)
    for place in np.random.default_rng(1).integers(0, len(content), 60):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :])
        ended = run("info", path)
        assert ended.code in (0, 2), (place, ended)
        if ended.code == 2:
            assert ended.said.startswith("mirrorskin: "), (place, ended)
            assert len(ended.said.splitlines()) == 1, (place, ended)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_surface_without_valid_points_is_refused(suffix):
    nothing = np.full((3, 4), np.nan)
    if suffix == ".x3p":
        write_x3p(height=nothing)
    elif suffix == ".sur":
        Path("a.sur").write_bytes(sur(np.full((3, 4), -1, "<i2")))
    elif suffix == ".gsf":
        fields = {"XReal": 80, "YReal": 150, "XYUnits": "um", "ZUnits": "nm"}
        gsffile.write_gsf("a.gsf", nothing.astype(np.float32), fields)
    else:
        write_gwy(__0__data=field(nothing))
    refused("no point of the surface is valid", f"measure a{suffix}")


def test_absurd_heights_are_refused():
    write_x3p(height=1e20 * HEIGHT)
    refused("its heights are from 1e+17 to 1.2e+18 mm", "measure a.x3p")


def test_a_missing_package_is_one_line(monkeypatch):
    write_x3p()
    monkeypatch.setattr("mirrorskin.io.formats.registry.find_spec", lambda name: None)
    refused("a.x3p needs the package x3pio: pip install 'mirrorskin[metrology]'", "measure a.x3p")


def test_heights_far_from_zero_keep_their_resolution():
    write_x3p(height=HEIGHT + 123456)  # 0.12 m
    result = io.open_result("a.x3p")
    np.testing.assert_allclose(1e3 * result.height, HEIGHT - 1, atol=1e-6)
    assert "heights are above z = 123.457 mm of the file" in notes(result)
