"""The page of a result in a real browser: it opens from disk, shows everything, and requests nothing."""

from __future__ import annotations

import re
import time

import numpy as np
import pytest

from mirrorskin import io
from mirrorskin.view.report import contents, write_report
from mirrorskin.view.report.words import picture_texts

SHAPE = (61, 81)
PIXEL = 0.1
PEAK = 2.0, 1.5  # x and y of the highest place, mm
HOLE = -2.0, -1.5  # the middle of a hole of 1 mm
LOW, HIGH = -1.5, -0.25  # mm


def height_at(x, y):
    """A hill to the upper right, on a slope that falls to the left."""
    hill = np.exp(-((x - PEAK[0]) ** 2 + (y - PEAK[1]) ** 2) / 0.5)
    return -1.45 + 0.02 * x + (HIGH + 1.45 - 0.02 * PEAK[0]) * hill


def a_result(shape=SHAPE, pixel=PIXEL):
    x, y = io.pixel_axes(shape, (pixel, pixel))
    grid = np.meshgrid(x, y)
    height = height_at(*grid)
    height[np.hypot(grid[0] - HOLE[0], grid[1] - HOLE[1]) < 0.5] = np.nan
    finite = np.isfinite(height)
    slopes = np.gradient(height, y, x)
    normals = np.stack([-slopes[1], -slopes[0], np.ones(shape)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    filled = np.hypot(grid[0] - 2, grid[1] + 2) < 0.6
    maps = {
        "height": height.astype(np.float32),
        "height_sigma": np.where(finite & ~filled, 0.002, np.nan).astype(np.float32),
        "normals": normals.astype(np.float32),
        "zenith": np.arccos(normals[..., 2]).astype(np.float32),
        "azimuth": np.arctan2(normals[..., 1], normals[..., 0]).astype(np.float32),
        "normals_sigma": np.full(shape, 0.01, np.float32),
        "status": np.where(finite, 1, 2).astype(np.uint8),
        "edges": (np.abs(np.hypot(grid[0] - HOLE[0], grid[1] - HOLE[1]) - 0.6) < 0.05).astype(np.uint8),
        "contact": finite.astype(np.uint8),
        "filled": filled.astype(np.uint8),
        "component": np.where(finite, 0, -1).astype(np.int32),
        "offset_unknown": np.zeros(1, np.uint8),
    }
    process = {
        "program": "mirrorskin",
        "version": "0",
        "date": "2026-01-01T00:00:00",
        "source": "<b>x</b>.h5",
    }
    return io.Result(**maps, x=x, y=y, process=process)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """A page of a small result with all there is, under a name that means harm."""
    target = tmp_path_factory.mktemp("report") / "page.html"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contents, "FINENESS", 130)
        write_report(a_result(), target, name="<img src=x onerror=alert(1)>.h5")
    return target


def upright(opened):
    """Look from straight above, with x to the right; return what is drawn."""
    opened.page.locator("#surface-canvas").focus()
    for _ in range(18):
        opened.page.keyboard.press("ArrowUp")
    for _ in range(6):
        opened.page.keyboard.press("ArrowLeft")
    return opened.surface()


def read(text):
    """The numbers of a readout: x, y and z."""
    match = re.match(r"x (\S+) mm\s+y (\S+) mm\s+z (\S+) mm", text)
    assert match, text
    return [float(number.replace("\N{MINUS SIGN}", "-")) for number in match.groups()]


def drawn(surface):
    """Where the surface is drawn, and not its outline: colours, not greys."""
    colours = surface[..., :3].astype(int)
    return (surface[..., 3] > 250) & (colours.max(axis=-1) - colours.min(axis=-1) > 40)


def test_nothing_is_asked_for_but_the_page(opening, path):
    opened = opening(path)
    opened.page.wait_for_timeout(300)
    assert {address for address in opened.requests if not address.startswith("data:")} == {opened.address}
    assert opened.complaints == []


def test_all_is_shown(opening, path):
    page = opening(path).page
    assert page.title() == page.locator("h1").inner_text() == "<img src=x onerror=alert(1)>.h5"
    sizes = page.evaluate("() => [...document.images].map((one) => [one.naturalWidth, one.naturalHeight])")
    assert len(sizes) == 8
    assert min(min(size) for size in sizes) > 0
    alternatives = page.evaluate("() => [...document.images].map((image) => image.alt)")
    assert picture_texts(a_result(), "normals_sigma")[1] in alternatives
    numbers = page.locator("#numbers table")
    assert "height range" in numbers.inner_text()
    assert page.locator("#provenance").inner_text().count("<b>x</b>.h5") == 1
    assert page.locator(".without").is_hidden()
    assert "filled" in page.locator("#surface .legend").inner_text()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_page_fits_every_screen(opening, path, scheme):
    opened = opening(path, color_scheme=scheme)
    for width in (320, 390, 800, 1280):
        opened.page.set_viewport_size({"width": width, "height": 850})
        wide, content_width = opened.page.evaluate(
            "() => ['scrollWidth', 'clientWidth'].map((name) => document.documentElement[name])"
        )
        assert (wide, content_width) == (width, width)
        _, _, across, down = opened.box()
        assert across > 0.6 * width
        assert down < 850
        opened.keep(f"{scheme}-{width}")


def test_letters_have_contrast_in_light_and_dark_themes(opening, path):
    for scheme, dark in (("light", False), ("dark", True)):
        page = opening(path, color_scheme=scheme).page
        ink, paper = page.evaluate(
            "() => ['color', 'backgroundColor'].map((name) => getComputedStyle(document.body)[name])"
        )
        lightness = [
            np.mean([int(part) for part in re.findall(r"\d+", colour)[:3]]) for colour in (ink, paper)
        ]
        assert (lightness[0] > lightness[1]) == dark
        assert abs(lightness[0] - lightness[1]) > 150


def test_the_surface_is_drawn_right_side_up(opening, path):
    opened = opening(path)
    surface = upright(opened)
    pixels = drawn(surface)
    rows, columns = np.nonzero(pixels)
    assert pixels.mean() > 0.1
    # From above: x to the right, y up, and a millimetre as long along both.
    scale = (np.ptp(columns) + 1) / ((SHAPE[1] - 1) * PIXEL)
    assert (np.ptp(rows) + 1) / ((SHAPE[0] - 1) * PIXEL) == pytest.approx(scale, rel=0.02)
    left, top = (columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2

    def at(x, y):
        return surface[round(top - y * scale), round(left + x * scale)].astype(int)

    assert at(*HOLE)[3] == 0
    blue, green, red, _ = at(*PEAK)
    assert min(green, red) > blue + 60  # yellow
    blue, green, red, _ = at(-3, 2)
    assert blue > green  # violet
    blue, green, red, _ = at(2, -2)
    assert red > green + 40 > blue + 80  # orange: filled


def test_what_one_points_at_is_read(opening, path):
    opened = opening(path)
    surface = upright(opened)
    rows, columns = np.nonzero(drawn(surface))
    middle = [(part.min() + part.max()) / 2 for part in (columns, rows)]
    scale = (np.ptp(columns) + 1) / ((SHAPE[1] - 1) * PIXEL)
    high, wide = surface.shape[:2]
    for x, y in ((0.0, 0.0), PEAK, (-3.0, 2.0)):
        position = read(opened.point((middle[0] + x * scale) / wide, (middle[1] - y * scale) / high))
        np.testing.assert_allclose(position, [x, y, height_at(x, y)], atol=0.03)
    hole = opened.point((middle[0] + HOLE[0] * scale) / wide, (middle[1] - HOLE[1] * scale) / high)
    assert hole == ""
    filled = opened.point((middle[0] + 2 * scale) / wide, (middle[1] + 2 * scale) / high)
    assert filled.endswith("filled")
    assert opened.point(0.002, 0.002) == ""


def test_what_one_points_at_from_the_side_is_on_the_surface(opening, path):
    opened = opening(path)
    positions = []
    for across in np.linspace(0.35, 0.65, 4):
        for down in (0.45, 0.6):
            text = opened.point(across, down)
            if text:
                positions.append(read(text))
    assert len(positions) > 4
    for x, y, z in positions:
        assert z == pytest.approx(height_at(x, y), abs=0.02)


def test_drag_keys_wheel_and_slider_change_the_view_and_a_double_click_brings_it_back(opening, path):
    opened = opening(path)
    page, mouse = opened.page, opened.page.mouse
    left, top, width, height = opened.box()
    middle = left + width / 2, top + height / 2
    before = opened.surface()
    assert drawn(before).mean() > 0.05

    def same(surface):
        return np.array_equal(surface, before)

    def other(surface):
        return not same(surface)

    def drag():
        mouse.move(*middle)
        mouse.down()
        mouse.move(middle[0] + 80, middle[1] + 30, steps=3)
        mouse.up()

    def wheel():
        mouse.move(*middle)
        mouse.wheel(0, -400)

    def press(key):
        page.locator("#surface-canvas").focus()
        page.keyboard.press(key)

    acts = [drag, wheel, *((lambda key=key: press(key)) for key in ("ArrowLeft", "ArrowDown", "+"))]
    for act in acts:
        act()
        opened.until(other, f"{act.__name__} changes nothing")
        mouse.dblclick(*middle)
        opened.until(same, "a double click does not bring the view back")
    press("+")
    opened.until(other, "+ changes nothing")
    press("Home")
    opened.until(same, "Home does not bring the view back")
    page.locator("#surface-factor").fill("20")
    assert page.locator("#surface-times").inner_text() == "20\N{MULTIPLICATION SIGN}"
    opened.until(other, "the slider changes nothing")
    assert opened.complaints == []


def test_what_is_under_the_pointer_stays_there_when_one_zooms(opening, path):
    opened = opening(path)
    before, shown = read(opened.point(0.55, 0.5)), opened.surface()
    opened.page.mouse.wheel(0, -700)
    opened.until(lambda surface: drawn(surface).sum() > 1.5 * drawn(shown).sum(), "the wheel does not zoom")
    assert opened.point(0.1, 0.1) != opened.point(0.9, 0.9)
    np.testing.assert_allclose(read(opened.point(0.55, 0.5)), before, atol=0.02)


def test_the_wheel_scrolls_the_page_where_there_is_nothing_to_zoom_out_of(opening, path):
    opened = opening(path)
    opened.point(0.5, 0.5)
    before = opened.page.evaluate("() => scrollY")
    opened.page.mouse.wheel(0, 300)
    deadline = time.monotonic() + 10
    while opened.page.evaluate("() => scrollY") < before + 100:
        assert time.monotonic() < deadline
        opened.page.wait_for_timeout(50)


def test_fingers_turn_and_zoom(opening, path):
    opened = opening(path, viewport={"width": 390, "height": 844}, has_touch=True, device_scale_factor=2)
    left, top, width, height = opened.box()
    x, y = left + width / 2, top + height / 2
    session = opened.page.context.new_cdp_session(opened.page)

    def touch(kind, *points):
        session.send(
            "Input.dispatchTouchEvent",
            {"type": kind, "touchPoints": [{"x": px, "y": py, "id": k} for k, (px, py) in enumerate(points)]},
        )

    before = opened.surface()
    assert before.shape[1] == pytest.approx(2 * width, abs=2)
    touch("touchStart", (x, y))
    touch("touchMove", (x + 40, y))
    touch("touchEnd")
    turned = opened.until(lambda surface: np.any(surface != before), "a finger does not turn it")
    touch("touchStart", (x - 20, y), (x + 20, y))
    touch("touchMove", (x - 60, y), (x + 60, y))
    touch("touchEnd")
    larger = 1.5 * drawn(turned).sum()
    opened.until(lambda surface: drawn(surface).sum() > larger, "fingers do not zoom")


def test_nothing_is_drawn_while_nothing_changes(opening, path):
    opened = opening(path)
    opened.settle()
    opened.page.evaluate(
        "() => { window.drawn = 0; const ask = requestAnimationFrame.bind(window);"
        " window.requestAnimationFrame = (act) => { window.drawn += 1; return ask(act); }; }"
    )
    opened.page.wait_for_timeout(300)
    assert opened.page.evaluate("() => window.drawn") == 0
    opened.page.locator("#surface-canvas").press("ArrowLeft")
    assert opened.page.evaluate("() => window.drawn") == 1


def test_a_lost_context_comes_back(opening, path):
    opened = opening(path)
    before = opened.surface()
    opened.page.evaluate(
        """() => new Promise((done) => {
            const canvas = document.getElementById("surface-canvas");
            const lost = canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
            canvas.addEventListener("webglcontextlost", () => setTimeout(() => lost.restoreContext()));
            canvas.addEventListener("webglcontextrestored", () => setTimeout(done));
            lost.loseContext();
        })"""
    )
    opened.until(lambda surface: np.array_equal(surface, before), "the surface does not come back")
    opened.page.locator("#surface-canvas").press("ArrowLeft")
    opened.until(lambda surface: np.any(surface != before), "the surface can no longer be turned")


@pytest.mark.parametrize(
    "how",
    [{"script": "HTMLCanvasElement.prototype.getContext = () => null"}, {"java_script_enabled": False}],
    ids=["no WebGL", "no scripts"],
)
def test_if_a_surface_cannot_be_drawn_pictures_are_shown_with_the_reason(opening, path, how):
    page = opening(path, **how).page
    assert "WebGL 2" in page.locator(".without").inner_text()
    assert page.locator(".without").is_visible()
    assert page.locator("#surface-canvas").is_hidden()
    assert page.locator("#surface-factor").is_hidden()
    assert page.locator("#pictures img").first.is_visible()


def test_the_page_s_policy_lets_nothing_out(opening, path):
    opened = opening(path)
    refused = opened.page.evaluate(
        """async () => {
            const refused = [];
            const keep = (event) => refused.push(event.violatedDirective);
            document.addEventListener("securitypolicyviolation", keep);
            new Image().src = "http://example.invalid/a.png";
            const script = document.createElement("script");
            script.textContent = "window.intruded = true";
            document.body.append(script);
            await fetch("http://example.invalid/").catch(() => null);
            await new Promise((done) => setTimeout(done, 100));
            return [refused.sort(), Boolean(window.intruded)];
        }"""
    )
    assert refused == [["connect-src", "img-src", "script-src-elem"], False]


def test_a_page_prints(opening, path):
    page = opening(path).page
    assert page.pdf().startswith(b"%PDF")
    page.emulate_media(media="print")
    assert page.locator("nav").is_hidden()
    assert page.locator("#numbers table").is_visible()


def test_a_million_pixels_make_a_page_of_five_megabytes_at_most(opening, tmp_path):
    result = a_result((1000, 1050), 0.008)
    noise = np.random.default_rng(1).normal(0, 0.02, result.height.shape).astype(np.float32)
    result.height[:] += noise
    result.normals[..., 0] += noise
    result.height_sigma[:] += np.abs(noise) / 10
    write_report(result, tmp_path / "page.html", name="large.h5")
    assert (tmp_path / "page.html").stat().st_size < 5e6
    opened = opening(tmp_path / "page.html")
    assert drawn(opened.surface()).mean() > 0.05
    assert opened.complaints == []
    opened.keep("large")
