"""The page of a result: it needs no other file, shows true values, and executes no foreign code."""

from __future__ import annotations

import base64
import hashlib
import importlib.util
import json
import re
from html.parser import HTMLParser

import calibrations
import cv2
import numpy as np
import pytest

from mirrorskin import engine, io
from mirrorskin.io.model.maps import IN_PIXELS
from mirrorskin.view import report
from mirrorskin.view.report import contents
from mirrorskin.view.report.contents import align
from mirrorskin.view.report.surface import sample, surface_data
from mirrorskin.view.report.words import picture_texts, split_process

SHAPE = (23, 31)
HOSTILE = '"><script>alert(1)</script>&$x'
PROCESS = {
    "program": "mirrorskin",
    "version": "0.1.0",
    "date": "2026-11-22T08:12:51+00:00",
    "source": HOSTILE,
    "device": "a device",
    "threshold": 0.5,
    "subframe": True,
}
VOID = {"meta", "link", "img", "input", "br"}


def cap(shape=SHAPE, pixel=0.2, radius=10.0):
    """The top of a ball, in a hole beyond 2.2 mm from its middle, of which the inmost part was filled."""
    x, y = io.pixel_axes(shape, (pixel, pixel))
    away = np.hypot(x, y[:, np.newaxis])
    height = np.sqrt(np.maximum(radius**2 - away**2, 0)) - radius
    height[away > 2.2] = np.nan
    filled = (away < 0.5).astype(np.uint8)
    maps = {
        "height": height.astype(np.float32),
        "height_sigma": np.where(filled, np.nan, 0.002).astype(np.float32),
        "filled": filled,
        "component": np.where(np.isnan(height), -1, 0).astype(np.int32),
        "offset_unknown": np.zeros(1, np.uint8),
    }
    return io.Result(**maps, x=x, y=y, process=PROCESS)


class Page(HTMLParser):
    """What a browser would find in a page; elements that do not match are an error."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.elements, self.open, self.texts = [], [], {}
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        names = [name for name, _ in attributes]
        assert len(names) == len(set(names))
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open:
            self.texts.setdefault(self.open[-1], []).append(data)

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]

    @property
    def words(self):
        spoken = [texts for tag, texts in self.texts.items() if tag not in ("script", "style")]
        return " ".join(text for texts in spoken for text in texts)

    @property
    def surface(self):
        """What the script is told, if there is a surface."""
        scripts = [text for text in self.texts.get("script", []) if text.startswith("{")]
        return json.loads(scripts[0]) if scripts else None


def written(folder, result, name="a.h5", **asked):
    report.write_report(result, folder / "page.html", name=name, **asked)
    return Page((folder / "page.html").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A page with all there is, of a file and a source that mean harm."""
    result = cap().assign(
        status=np.ones(SHAPE, np.uint8), calibration=calibrations.a_calibration(name=HOSTILE)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contents, "FINENESS", 70)  # quick to draw
        return written(tmp_path_factory.mktemp("page"), result, name=f"{HOSTILE}.h5")


@pytest.fixture
def quick(monkeypatch):
    """Pages without pictures, which take longest."""
    monkeypatch.setattr(contents, "pictures_of", lambda *_: [])


def test_everything_the_page_needs_is_in_it(page):
    addresses = [
        element[key]
        for _, element in page.elements
        for key in ("src", "href", "srcset", "data")
        if key in element
    ]
    assert len(addresses) > 5
    assert {address[:5] if address[0] == "d" else address[0] for address in addresses} == {"data:", "#"}
    styles = "".join(page.texts["style"])
    assert "url(" not in styles
    assert "@import" not in styles


def test_the_policy_allows_the_page_s_own_script_and_style_alone(page):
    (policy,) = [element["content"] for element in page.all("meta") if "http-equiv" in element]
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules["default-src"] == "'none'"
    assert rules["img-src"] == "data:"
    for tag, rule in (("script", "script-src"), ("style", "style-src")):
        content = page.texts[tag][-1].encode()
        assert rules[rule] == f"'sha256-{base64.b64encode(hashlib.sha256(content).digest()).decode()}'"
    # These would need leave of their own.
    assert not [
        key for _, element in page.elements for key in element if key == "style" or key.startswith("on")
    ]


def test_a_page_is_well_made(page):
    names = [element["id"] for _, element in page.elements if "id" in element]
    assert len(names) == len(set(names))
    targets = [element["href"][1:] for element in page.all("a")]
    targets += [
        element[key] for _, element in page.elements for key in ("for", "aria-describedby") if key in element
    ]
    assert len(targets) > 8
    assert set(targets) <= set(names)
    headings = [tag for tag, _ in page.elements if re.fullmatch("h[1-6]", tag)]
    assert headings == ["h1", *["h2"] * (len(headings) - 1)]
    assert page.all("html") == [{"lang": "en"}]
    assert all(element["scope"] for element in page.all("th"))


def test_each_picture_is_there_in_words_too(page):
    pictures = page.all("img")
    assert len(pictures) >= 4
    assert len({picture["alt"] for picture in pictures} - {""}) == len(pictures)
    for element in pictures:
        head, _, data = element["src"].partition(",")
        assert head in ("data:image/png;base64", "data:image/webp;base64")
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape[:2] == (int(element["height"]), int(element["width"]))
        assert picture.std() > 1


def test_a_caption_that_repeats_the_title_is_left_out():
    caption, _ = picture_texts(cap(), "height_sigma")
    assert caption == "Standard deviation of the height."


@pytest.mark.parametrize("filled", [None, np.zeros(SHAPE, np.uint8)])
def test_a_caption_mentions_filled_heights_only_if_there_are_some(filled):
    assert "orange was filled" in picture_texts(cap(), "height")[0]
    assert "orange" not in picture_texts(cap().assign(filled=filled), "height")[0]


def test_names_are_shown_and_never_run(page):
    assert [element.get("type") for element in page.all("script")] == ["application/json", "module"]
    assert page.texts["h1"] == [f"{HOSTILE}.h5"]
    assert HOSTILE in "".join(page.texts["td"])
    assert HOSTILE in "".join(page.texts["q"])


def test_a_page_contains_numbers_parameters_and_their_origin(page):
    measured = engine.measure(cap())
    for name in measured.quantities:
        assert name in page.texts["th"]
    assert "yes" in page.texts["td"]
    assert "0.5" in page.texts["td"]
    assert "2026-11-22T08:12:51+00:00" in page.texts["td"]
    assert {"height", "filled", "status"} <= set(page.texts["code"])
    assert "zenith" not in page.texts["code"]


def test_every_built_in_map_has_a_caption():
    assert [name for name, declared in io.model.maps.TABLE.items() if not declared.caption] == []


def decoded(data):
    """Heights, pieces from 1 on, and what was filled, as the script reads them."""
    shape = len(data["y"]), len(data["x"])
    codes, marks = (
        np.frombuffer(base64.b64decode(data[key]), "<u2").reshape(shape) for key in ("heights", "marks")
    )
    height = data["lowest"] + codes / 65535 * (data["highest"] - data["lowest"])
    return np.where(marks > 0, height, np.nan), marks & 0x7FFF, marks >> 15


def test_the_script_gets_heights_holes_and_filled_pixels(tmp_path, quick):
    result = cap()
    height, piece, filled = decoded(written(tmp_path, result).surface)
    rows, columns = (np.flatnonzero(np.isfinite(result.height).any(axis=axis)) for axis in (1, 0))
    inner = np.ix_(rows, columns)
    np.testing.assert_allclose(height, result.height[inner], atol=np.nanmax(-result.height) / 65535)
    np.testing.assert_array_equal(piece > 0, np.isfinite(result.height[inner]))
    np.testing.assert_array_equal(filled, result.filled[inner] * (piece > 0))
    assert filled.any()


def test_a_surface_is_drawn_as_high_as_it_is_unless_that_is_too_flat_to_see():
    assert surface_data(cap(radius=3.0))["factor"] == 1
    assert 2 < surface_data(cap())["factor"] < 10
    assert surface_data(cap(radius=1000.0))["factor"] == 20


def test_level_ground_is_a_surface():
    x, y = io.pixel_axes((3, 4), (0.1, 0.1))
    data = surface_data(io.Result(height=np.full((3, 4), -0.5, np.float32), x=x, y=y))
    np.testing.assert_allclose(decoded(data)[0], -0.5)
    assert np.isfinite(data["factor"])
    assert data["filled"] is None


@pytest.mark.parametrize("shape", [(1, 1), (1, 30), (30, 1)])
def test_a_row_a_column_and_a_pixel_make_no_surface(tmp_path, quick, shape):
    x, y = io.pixel_axes(shape, (0.1, 0.1))
    page = written(tmp_path, io.Result(height=np.zeros(shape, np.float32), x=x, y=y))
    assert page.surface is None
    assert "make no surface" in page.words
    assert not page.all("canvas")
    assert not page.all("script")


def test_heights_of_which_none_is_known_make_no_surface(tmp_path, quick):
    page = written(tmp_path, cap().assign(height=np.full(SHAPE, np.nan, np.float32)))
    assert page.surface is None
    assert "make no surface" in page.words


def test_a_result_without_heights_reports_it(tmp_path, monkeypatch):
    monkeypatch.setattr(contents, "FINENESS", 70)
    result = io.Result(
        azimuth=np.linspace(-3, 3, 35, dtype=np.float32).reshape(5, 7),
        modulation=np.ones((5, 7), np.float32),
    )
    page = written(tmp_path, result)
    assert "has no heights" in page.words
    assert len(page.all("img")) == 2


def test_without_a_pixel_size_places_are_pixels(tmp_path, quick):
    page = written(tmp_path, cap().assign(x=None, y=None))
    assert page.surface["unit"] == "px"
    assert (
        page.surface["y"][0]
        == -page.surface["y"][-1]
        == 11 - np.flatnonzero(np.isfinite(cap().height).any(1))[0]
    )
    assert "pixel size of this result is unknown" in page.words
    assert "--pixel-size" in page.words  # what measuring would take


@pytest.mark.parametrize(
    ("unknown", "message"), [([1], "The height is relative"), ([1, 0, 1], "2 of 3 pieces")]
)
def test_what_is_relative_is_reported(tmp_path, quick, unknown, message):
    result = cap().assign(offset_unknown=np.array(unknown, np.uint8))
    assert message in written(tmp_path, result).words
    assert "relative" not in written(tmp_path, cap()).texts["p"]


def test_one_turn_of_several_is_shown(tmp_path, quick):
    turn = cap()
    each = {name: np.stack([values, values]) for name, values in turn.maps().items()}
    each["height"][1] += np.float32(0.25)
    each["component"][1][each["component"][1] >= 0] += 1
    turns = turn.assign(each, offset_unknown=np.array([0, 1], np.uint8))
    page = written(tmp_path, turns, turn=1)
    assert page.texts["h1"] == ["a.h5, turn 1"]
    assert page.surface["highest"] == pytest.approx(float(np.nanmax(turn.height)) + 0.25)
    assert "The height is relative" in page.words
    with pytest.raises(io.InputError, match="--turn"):
        written(tmp_path, turns)


def test_a_calibration_is_described_if_there_is_one(tmp_path, quick, page):
    assert "half-angle" in page.texts["th"]
    assert "calibration" in [element.get("id") for element in page.all("section")]
    assert "calibration" not in [element.get("id") for element in written(tmp_path, cap()).all("section")]


def test_a_fused_process_is_listed_by_movement():
    process = {
        "program": "mirrorskin",
        "method": "fusion",
        "vertical_source": "a.h5",
        "vertical_threshold": 0.5,
        "axial_source": "b.h5",
        "axial_tilt": 0.0436332313,
    }
    parameters, provenance = split_process(process)
    assert parameters == {
        "": [("method", "fusion")],
        "Press": [("threshold", "0.5")],
        "Rotation": [("tilt", "0.0436332 rad")],
    }
    assert provenance == {
        "": [("program", "mirrorskin")],
        "Press": [("source", "a.h5")],
        "Rotation": [("source", "b.h5")],
    }


def test_points_are_listed_below_each_other():
    figure, point = "\N{FIGURE SPACE}", "\N{PUNCTUATION SPACE}"
    assert align(["1.25", "10", "", "0.5"]) == ["1.25", f"10{point}{figure * 2}", "", f"0.5{figure}"]
    assert align(["1", "20"]) == ["1", "20"]
    assert align([]) == []


def blocks_of(shape, limit):
    """Yield each sample's place, and the pixels that it is of."""
    steps = [-(-size // limit) for size in shape]
    for row in range(-(-shape[0] // steps[0])):
        for column in range(-(-shape[1] // steps[1])):
            yield (
                (row, column),
                tuple(
                    slice(start * step, (start + 1) * step)
                    for start, step in zip((row, column), steps, strict=True)
                ),
            )


@pytest.mark.parametrize(("shape", "limit"), [((7, 9), 9), ((7, 9), 4), ((11, 3), 5), ((13, 17), 2)])
def test_a_sample_is_the_mean_of_its_pixels(shape, limit):
    height = np.random.default_rng(1).normal(size=shape).astype(np.float32)
    x, y = io.pixel_axes(shape, (0.1, 0.3))
    grid = sample(io.Result(height=height, x=x, y=y), limit)
    assert max(grid.height.shape) <= limit
    pixels = 0
    for (row, column), (rows, columns) in blocks_of(shape, limit):
        assert grid.height[row, column] == pytest.approx(float(height[rows, columns].astype(float).mean()))
        assert (grid.x[column], grid.y[row]) == pytest.approx((x[columns].mean(), y[rows].mean()))
        pixels += 1
    assert pixels == grid.height.size
    assert not grid.filled.any()
    assert not grid.piece.any()


def test_a_sample_of_which_less_than_half_is_known_is_a_hole():
    height = np.ones((4, 6), np.float32)
    height[:2, :2] = [[1, np.nan], [np.nan, np.nan]]
    height[:2, 2:4] = [[1, np.nan], [3, np.nan]]
    grid = sample(io.Result(height=height), 3)
    np.testing.assert_array_equal(grid.height, [[np.nan, 2, 1], [1, 1, 1]])
    np.testing.assert_array_equal(grid.piece, [[-1, 0, 0], [0, 0, 0]])


def test_pieces_and_what_was_filled_are_never_averaged_together():
    rng = np.random.default_rng(2)
    component = rng.integers(0, 3, (12, 15)).astype(np.int32)
    filled = rng.integers(0, 2, (12, 15)).astype(np.uint8)
    height = (10 * component + 100 * filled).astype(np.float32)
    grid = sample(io.Result(height=height, component=component, filled=filled), 5)
    assert {0, 1, 2} == set(grid.piece.ravel())
    np.testing.assert_array_equal(grid.height, 10 * grid.piece + 100 * grid.filled)


def test_only_the_part_that_holds_heights_is_reported():
    height = np.full((9, 8), np.nan, np.float32)
    height[2:5, 3:7] = np.arange(12).reshape(3, 4)
    grid = sample(io.Result(height=height))
    np.testing.assert_array_equal(grid.height, height[2:5, 3:7])
    np.testing.assert_array_equal(grid.x, [-0.5, 0.5, 1.5, 2.5])
    np.testing.assert_array_equal(grid.y, [2, 1, 0])


def test_pictures_of_noise_stay_small(monkeypatch):
    noise = np.random.default_rng(3).integers(0, 255, (200, 160, 3), np.uint8)
    for limit, kind, size in ((100_000, "png", 160), (50_000, "webp", 160), (9_000, "webp", 80)):
        monkeypatch.setattr(contents, "MOST_BYTES", limit)
        packed, data = contents.packed(noise)
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert (packed, picture.shape[1]) == (kind, size)
        assert len(data) <= limit
        if kind == "png":
            np.testing.assert_array_equal(picture, noise)


def test_a_surface_of_a_million_pixels_stays_small():
    height = np.random.default_rng(4).normal(size=(1024, 1000)).astype(np.float32)
    data = surface_data(io.Result(height=height, component=np.zeros(height.shape, np.int32)))
    surface = len(json.dumps(data))
    assert surface < 1e6
    most_pictures = 7 * contents.MOST_BYTES * 4 / 3
    assert surface + most_pictures < 5e6 - 2e5  # of which all words take less


def test_the_same_result_makes_the_same_page(tmp_path, monkeypatch):
    monkeypatch.setattr(contents, "FINENESS", 40)
    small = io.Result(azimuth=np.arange(20, dtype=np.float32).reshape(4, 5))
    pages = []
    for name in ("first.html", "second.html"):
        report.write_report(small, tmp_path / name, name="a.h5")
        pages.append((tmp_path / name).read_bytes())
    assert pages[0] == pages[1]


def test_what_is_missing_is_reported_before_any_work(tmp_path, monkeypatch):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        "mirrorskin.view.report.page.find_spec", lambda name: None if name == "jinja2" else find_spec(name)
    )
    with pytest.raises(io.InputError, match=r"Jinja2: pip install 'mirrorskin\[view\]'"):
        written(tmp_path, cap())
    assert not list(tmp_path.iterdir())


def test_a_name_that_is_not_text_does_no_harm(tmp_path, quick):
    assert written(tmp_path, cap(), name="a\udcff.h5").texts["h1"] == ["a?.h5"]


def test_a_page_that_cannot_be_written_is_one_line(tmp_path, quick):
    with pytest.raises(io.InputError, match="no folder"):
        report.write_report(cap(), tmp_path / "nowhere" / "page.html", name="a.h5")


def test_warnings_are_at_the_top_of_the_page(tmp_path, quick):
    doubtful = cap().assign(process={**PROCESS, "warnings": "frame 3: lost"})
    page = written(tmp_path, doubtful)
    assert "Frame 3: lost." in " ".join(page.texts["p"])
    assert page.texts["strong"] == ["Warning:"]


def test_a_surface_in_pixels_is_in_pixels_everywhere():
    found = cap().assign(x=None, y=None, declarations=IN_PIXELS)
    surface = surface_data(found)
    assert (surface["unit"], surface["unit_of_height"], surface["stretch"]) == ("px", "px", 1.0)
    shown = contents.contents_of(found, "surface", None, None)
    assert shown["texts"]["highest"].endswith(" px")
    assert shown["units"][0].startswith("Lengths are in pixels")
    assert {row.unit for row in shown["numbers"].rows} <= {"px", "px²", "px³", "px³/px²", "", "%", "°"}
