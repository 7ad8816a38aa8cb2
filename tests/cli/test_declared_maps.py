"""A map declared by a user is treated like a built-in one by everything that reads results."""

from __future__ import annotations

import csv
import json
import pickle

import boards
import cv2
import numpy as np
import pytest
import tifffile
from commands import run
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from shown import panel
from stacks import assert_same

from mirrorskin import engine, io
from mirrorskin.engine.base.summary import summarise
from mirrorskin.engine.base.undistort import undistort
from mirrorskin.view.report.words import map_rows, picture_texts
from mirrorskin.view.result import overview

SHAPE = (24, 32)
X, Y = io.pixel_axes(SHAPE, (0.1, 0.1))
ACROSS, UP = np.meshgrid(X, Y)
BALL = (np.sqrt(25 - ACROSS**2 - UP**2) - 5).astype(np.float32)
BALL[:3, :4] = np.nan
SIGMA = np.full(SHAPE, 0.002, np.float32)

MATERIAL = (np.arange(SHAPE[1]) // 11 + np.zeros(SHAPE, int)).astype(np.uint16)
FLOW = np.dstack([0.003 * ACROSS, -0.003 * UP]).astype(np.float32)
STRESS = np.where(ACROSS > 1, np.float32(-1), (ACROSS**2 / 100).astype(np.float32))

DECLARED = {
    "wear": io.Map("depth of the wear", "mm", quantity="height", displayed="µm"),
    "material": io.Map(
        "material under the pixel",
        dtype="uint16",
        codes={0: "unknown", 1: "steel & tin", 2: "glass"},
        undefined=0,
        title="Materials",
    ),
    "flow": io.Map("flow of the skin", "mm", components=("x", "y"), displayed="µm"),
    "stress": io.Map("stress in the skin", "MPa", undefined=-1, colours="positive", displayed="kPa"),
}
MAPS = {"wear": BALL, "wear_sigma": SIGMA, "material": MATERIAL, "flow": FLOW, "stress": STRESS}
EACH = pytest.mark.parametrize("name", [*DECLARED, "wear_sigma"])


def of(name):
    """Return a result with one declared map, and its standard deviation if it has one."""
    maps = {key: MAPS[key] for key in MAPS if key.removesuffix("_sigma") == name.removesuffix("_sigma")}
    process = {"program": "mirrorskin", "source": "own.h5"}
    return io.Result(maps, x=X, y=Y, process=process, declarations=DECLARED)


@EACH
@pytest.mark.parametrize("suffix", ["h5", "zarr"])
def test_a_declared_map_is_read_as_it_was_written(name, suffix, tmp_path):
    io.save_result(of(name), tmp_path / f"own.{suffix}")
    result = io.open_result(tmp_path / f"own.{suffix}")
    assert_same(result, of(name))
    assert result.declaration(name) == of(name).declaration(name)


@EACH
def test_a_declared_map_survives_xarray(name):
    dataset = of(name).to_xarray()
    declared = of(name).declaration(name)
    assert dataset[name].attrs.get("units", "") == declared.unit
    assert dataset[name].attrs["long_name"] == declared.caption
    if declared.components:
        assert dataset[name].dims == ("y", "x", "direction")
    assert_same(io.Result.from_xarray(dataset), of(name))


@EACH
def test_an_npz_has_units_and_legends(name, tmp_path):
    assert run("export", saved(name, tmp_path), "-o", tmp_path / "own.npz").code == 0
    with np.load(tmp_path / "own.npz") as arrays:
        np.testing.assert_array_equal(arrays[name], MAPS[name], strict=True)
        units, legends = (json.loads(str(arrays[key])) for key in ("units", "legends"))
    declared = of(name).declaration(name)
    assert units.get(name, "") == declared.unit
    assert legends.get(name, {}) == {str(code): text for code, text in declared.codes.items()}


def saved(name, folder):
    io.save_result(of(name), folder / "own.h5")
    return folder / "own.h5"


@pytest.mark.parametrize(
    ("name", "range_of"),
    [
        ("wear", " mm, 98% known"),
        ("wear_sigma", "0.002 to 0.002 mm"),
        ("material", "0 to 2"),
        ("flow", "0.00465 mm"),
        ("stress", "MPa, 81% known"),
    ],
)
def test_text_and_html_show_the_unit_and_the_share_with_an_answer(name, range_of):
    result = of(name)
    lines = [line for line in repr(result).splitlines() if line.split()[0] == name]
    assert [line.endswith(range_of) for line in lines] == [True]
    assert range_of in result._repr_html_()


@EACH
def test_info_lists_the_map_with_its_unit(name, tmp_path):
    ended = run("info", saved(name, tmp_path), "--json")
    fact = json.loads(ended.out)[f"map {name}"]
    size = " x ".join(map(str, MAPS[name].shape))
    assert fact == f"{size} {MAPS[name].dtype} {of(name).declaration(name).unit}".rstrip()


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("wear", "wear at 756 of 768 pixels, from "),
        ("material", "material at 504 of 768 pixels, from 1.000 to 2.000"),
        ("flow", "flow at 768 of 768 pixels, from "),
        ("stress", "stress at 624 of 768 pixels, from "),
    ],
)
def test_the_summary_is_about_the_declared_map(name, line):
    assert str(summarise(of(name))).startswith(line)


def test_the_range_in_json_has_as_many_digits_as_float32():
    values = np.full(SHAPE, np.float32(-2.9941936))
    facts = summarise(of("wear").assign(wear=values)).as_dict()
    assert (facts["lowest"], facts["highest"], facts["unit"]) == (-2994.19355, -2994.19355, "µm")


@pytest.mark.parametrize(
    ("name", "title", "label"),
    [
        ("wear", "Wear", "wear (µm)"),
        ("wear_sigma", "Standard deviation of the wear", "standard deviation (µm)"),
        ("flow", "Flow", "length (µm)"),
        ("stress", "Stress", "stress (kPa)"),
    ],
)
def test_the_overview_has_the_declared_title_and_unit(name, title, label):
    axes = panel(overview(of(name), name="own.h5"), title)
    assert axes.child_axes[0].get_ylabel() == label


def test_values_are_drawn_in_the_displayed_unit_and_without_undefined_ones():
    axes = panel(overview(of("stress"), name="own.h5"), "Stress")
    shown = np.ma.filled(axes.images[0].get_array(), np.nan)
    np.testing.assert_allclose(shown, np.where(STRESS == -1, np.nan, 1000 * STRESS), rtol=1e-6)


def test_the_overview_has_the_legend_of_the_codes():
    axes = panel(overview(of("material"), name="own.h5"), "Materials")
    text = [text.get_text().splitlines()[0] for text in axes.get_legend().get_texts()]
    assert text == ["unknown", "steel & tin", "glass"]


def test_texts_with_dollar_signs_are_not_read_as_formulas(tmp_path):
    declared = io.Map("price in $", codes={0: "$1", 1: "$\\frac$"}, title="Costs $a_$")
    result = io.Result(costs=MATERIAL % 2, declarations={"costs": declared})
    io.save_result(result, tmp_path / "$a_$.h5")
    assert run("view", tmp_path / "$a_$.h5", "-o", tmp_path / "costs.png").code == 0


@EACH
def test_view_draws_the_map_by_its_name(name, tmp_path):
    path = saved(name, tmp_path)
    assert run("view", path, "--map", name, "-o", tmp_path / "map.png").code == 0
    assert cv2.imread(str(tmp_path / "map.png")).shape[0] > 300
    ended = run("view", path, "--map", "nothing", "-o", tmp_path / "other.png")
    assert (ended.code, name in ended.said) == (2, True)


@EACH
def test_a_report_has_the_caption_the_unit_and_the_legend(name, tmp_path):
    result = of(name)
    declared = result.declaration(name)
    caption, alternative = picture_texts(result, name)
    assert declared.caption.casefold() in caption.casefold()
    assert declared.figure_unit in alternative
    (row,) = (row for row in map_rows(result) if row[0] == name)
    assert row[1] == declared.unit
    assert all(text in row[2] for text in (declared.caption, *declared.codes.values()))
    assert run("report", saved(name, tmp_path), "-o", tmp_path / "own.html").code == 0
    assert f"<code>{name}</code>" in (tmp_path / "own.html").read_text(encoding="utf-8")


def bent_lens():
    view = boards.View(SHAPE, 0.1, 20.0, tilt=8.0, towards=40.0, distortion=(-0.1, 0.05, 0.01, -0.01, 0.0))
    matrix = np.array([[view.focal, 0, (SHAPE[1] - 1) / 2], [0, view.focal, (SHAPE[0] - 1) / 2], [0, 0, 1]])
    camera = np.linalg.inv(matrix @ view.plane())
    return io.Lens((0.1, 0.1), camera, np.array(view.distortion), matrix, SHAPE, 0.0)


@EACH
def test_a_declared_map_is_undistorted_like_a_built_in_one(name):
    built_in = io.Result(
        height=BALL,
        height_sigma=SIGMA,
        status=MATERIAL.astype(np.uint8),
        displacement=FLOW,
        growth=np.where(STRESS == -1, np.float32(np.nan), STRESS),
    )
    twin = {
        "wear": "height",
        "wear_sigma": "height_sigma",
        "material": "status",
        "flow": "displacement",
        "stress": "growth",
    }
    corrected, expected = undistort(of(name), bent_lens())[name], undistort(built_in, bent_lens())[twin[name]]
    assert not np.array_equal(corrected, MAPS[name])
    if name == "stress":
        expected = np.where(np.isnan(expected), np.float32(-1), expected)
    np.testing.assert_array_equal(corrected, expected)
    assert corrected.dtype == MAPS[name].dtype


def test_measure_takes_the_map_that_is_a_height():
    measured = engine.measure(of("wear"))
    built_in = engine.measure(io.Result(height=BALL, height_sigma=SIGMA, x=X, y=Y))
    assert repr(measured.quantities) == repr(built_in.quantities)


def test_score_takes_the_map_that_is_a_height():
    flat = np.zeros(SHAPE, np.float32)
    truth = io.Truth(BALL, flat, flat, np.ones(SHAPE, np.uint8))
    assert engine.score(of("wear"), truth).height.rms == 0
    with pytest.raises(io.InputError, match="no heights"):
        engine.score(of("stress"), truth)


def test_poses_are_estimated_from_the_map_that_is_a_height():
    bumps = (0.2 * np.sin(2 * ACROSS) * np.cos(3 * UP)).astype(np.float32)
    worn = of("wear").assign(height=bumps)
    assert list(worn) == ["wear", "wear_sigma"]
    built_in = io.Result(height=bumps, height_sigma=SIGMA, x=X, y=Y)
    pose, expected = (engine.pose.estimate_pose(height, height) for height in (worn, built_in))
    np.testing.assert_array_equal(pose.translation, expected.translation)


def test_the_heights_of_a_fusion_may_be_the_map_that_is_a_height(tmp_path):
    np.testing.assert_array_equal(io.open_heights(saved("wear", tmp_path)), BALL)


def test_a_table_of_a_section_has_the_map_that_is_a_height(tmp_path):
    section = "-1mm,0.05mm:1mm,0.05mm"
    out = tmp_path / "cut.csv"
    assert run("export", saved("wear", tmp_path), "-o", out, "--section", section).code == 0
    lines = out.read_text(encoding="utf-8").splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    heights = np.array([float(row["height [mm]"]) for row in rows])
    assert heights.max() == pytest.approx(BALL[11:13, 15:17].max(), abs=1e-3)


def test_pictures_surfaces_and_messages_have_the_map_that_is_a_height(tmp_path):
    path = saved("wear", tmp_path)
    for name in ("own.tif", "own.ply", "own.mcap"):
        ended = run("export", path, "-o", tmp_path / name)
        assert (ended.code, ended.said) == (0, "")
    counts = tifffile.imread(tmp_path / "own.tif")
    np.testing.assert_array_equal(counts == 0, np.isnan(BALL))
    assert f"element vertex {np.isfinite(BALL).sum()}".encode() in (tmp_path / "own.ply").read_bytes()
    with (tmp_path / "own.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        heights = [message for *_, message in reader.iter_decoded_messages(topics=["/height"])]
    np.testing.assert_allclose(np.frombuffer(heights[0].data, "<f4").reshape(SHAPE), BALL / 1000, rtol=1e-6)


class Worn(engine.Operation):
    """A user's operation with declared maps."""

    wear, material, flow, stress = DECLARED.values()
    ratio = io.Map("share of worn pixels", "%", axes="none", dtype="float64")

    def push(self, frames):
        pass

    def result(self):
        maps = {"wear": BALL.astype(float), "wear_sigma": SIGMA.astype(float), "ratio": 12.5, "note": "new"}
        return maps | {"material": MATERIAL.astype(int), "flow": FLOW, "stress": STRESS, "status": MATERIAL}


def test_an_operation_declares_its_maps(tmp_path):
    result = engine.run(np.zeros((2, *SHAPE), np.uint8), Worn)
    for name, values in MAPS.items():
        np.testing.assert_array_equal(result[name], values, strict=True)
    assert (result.numbers(), result.process["note"]) == ({"ratio": 12.5}, "new")
    io.save_result(result, tmp_path / "own.h5")
    assert_same(io.open_result(tmp_path / "own.h5"), result)
    assert result.declaration("status").codes == {}, "a legend is not guessed from the name"
    assert io.open_result(tmp_path / "own.h5").declaration("status").codes == {}


@pytest.mark.parametrize(
    ("maps", "result", "message"),
    [
        ({"a": io.Map(codes={1: "b"})}, {"a": MATERIAL + 300}, "values from 300 to 302, which uint8 cannot"),
        ({"a": io.Map(codes={1: "b"})}, {"a": BALL}, "which uint8 cannot hold. Declare another dtype"),
        ({"a": io.Map(components=("x", "y"))}, {"a": BALL}, r"map a is float32 \(24, 32\): numbers"),
    ],
)
def test_a_declaration_that_does_not_fit_is_one_line(maps, result, message):
    methods = {"push": lambda self, frames: None, "result": lambda self: result}
    wrong = type("Wrong", (engine.Operation,), {**maps, **methods})
    with pytest.raises(io.InputError, match=rf"^Wrong\.result\(\): .*{message}") as caught:
        engine.run(np.zeros((2, *SHAPE), np.uint8), wrong)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("maps", [DECLARED, {"a": "mm"}, {}])
def test_declarations_in_a_mapping_are_refused_in_one_line(maps):
    with pytest.raises(io.InputError, match=r"^Wrong assigns maps: declare each map as a class") as caught:
        type("Wrong", (engine.Operation,), {"maps": maps, "a": io.Map(unit="mm")})
    assert "\n" not in str(caught.value)


@EACH
def test_a_result_with_declared_maps_can_be_pickled(name):
    assert_same(pickle.loads(pickle.dumps(of(name))), of(name))
