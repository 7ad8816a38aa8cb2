"""The application in a real browser: open the sample, click, change an option, save, compare."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest
from commands import done

from mirrorskin import engine, io
from mirrorskin.engine.metrology import Quantity

PATIENCE = 60.0  # seconds
SCREENSHOTS = os.environ.get("MIRRORSKIN_SCREENSHOTS")  # a folder to keep pictures of the pages in
SIZE = {"width": 1440, "height": 900}
CANVASES = """count => {
    const canvases = root => [...root.querySelectorAll("*")].flatMap(
        element => [element, ...(element.shadowRoot ? canvases(element.shadowRoot) : [])])
    const shown = canvases(document).filter(
        element => element.classList.contains("bk-Canvas") && element.checkVisibility())
    return shown.length === count
}"""
DROP = """bytes => {
    const data = new DataTransfer()
    data.items.add(new File([new Uint8Array(bytes)], "dropped.h5"))
    window.dispatchEvent(new DragEvent("drop", {dataTransfer: data, bubbles: true, cancelable: true}))
}"""
BESIDE = 0.68, 0.5  # a place in the picture where the ball is touched, shares of its width and height


@pytest.fixture(scope="module")
def press(tmp_path_factory):
    path = tmp_path_factory.mktemp("app") / "press.h5"
    done("sample press -o", path)
    return path


@contextmanager
def serving(*files):
    """Run the application in a separate process; yield this and the address."""
    command = [sys.executable, "-m", "mirrorskin.cli.main", "app", *map(str, files), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            yield server, server.stdout.readline().strip()
        finally:
            server.kill()


@pytest.fixture(scope="module")
def address(press):
    """The address of the application."""
    with serving(press) as (_, place):
        yield place


class Page:
    """The application in a window of its own; what it asks for and complains of is kept."""

    def __init__(self, browser, address):
        self.context = browser.new_context(
            viewport=SIZE, accept_downloads=True, permissions=["clipboard-read", "clipboard-write"]
        )
        self.context.set_default_timeout(1000 * PATIENCE)
        self.page, self.requests, self.complaints = self.context.new_page(), [], []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("console", self._heard)
        self.command = self.page.locator("textarea").first
        self.page.goto(address)
        self.page.get_by_text("Click a pixel to see its brightness.").wait_for()

    def _heard(self, message):
        if message.type in ("error", "warning"):
            self.complaints.append(message.text)

    def show(self, tab):
        """Open a tab, and wait until what it shows is there."""
        self.page.locator(".bk-tab", has_text=tab).click()
        {
            "Recording": self.page.get_by_text("Click a pixel to see its brightness."),
            "Result": self.page.get_by_text("highest point", exact=True),
            "Surface": self.page.frame_locator("iframe[title=Surface]").locator("#surface.drawn"),
            "Save and copy": self.command,
        }[tab].wait_for()

    def click(self, across, down):
        """Click at a place of the frame."""
        box = self.page.locator(".bk-Canvas:visible").first.bounding_box()
        self.page.mouse.click(box["x"] + across * box["width"], box["y"] + down * box["height"])

    def fact(self, name):
        """Return what the table next to the graph says."""
        row = self.page.locator("tr", has=self.page.get_by_text(name, exact=True))
        return row.locator("td").inner_text()

    def set_threshold(self, value):
        field = self.page.get_by_role("textbox", name="Threshold (share)")
        field.fill(str(value))
        field.press("Enter")

    def expect_command(self, text):
        """Wait until the command contains a text."""
        from playwright.sync_api import expect

        expect(self.command).to_have_value(re.compile(re.escape(text)), timeout=1000 * PATIENCE)

    def keep(self, name):
        if SCREENSHOTS:
            self.page.screenshot(path=f"{SCREENSHOTS}/{name}.png")


@pytest.fixture
def opened(browser, address):
    page = Page(browser, address)
    yield page
    page.context.close()


def by_command(press, folder, *options):
    """Return the result of the command line."""
    path = folder / "command.h5"
    done("reconstruct", press, *options, "-o", path)
    return io.open_result(path)


def test_a_click_shows_the_numbers_of_the_command_line(opened, press, tmp_path):
    opened.click(*BESIDE)
    opened.page.get_by_text("Travel at the onset").wait_for()
    row, column = map(int, re.fullmatch(r"row (\d+), column (\d+)", opened.fact("Pixel")).groups())
    result = by_command(press, tmp_path)
    height, sigma = result.height[row, column], result.height_sigma[row, column]
    opened.keep("app-recording")
    assert opened.fact("Travel at the onset") == str(Quantity(-float(height), float(sigma), "mm"))


def test_a_new_threshold_is_saved_as_the_command_line_saves_it(opened, press, tmp_path):
    opened.set_threshold(0.37)
    opened.show("Save and copy")
    opened.expect_command("--threshold=0.37")
    with opened.page.expect_download() as download:
        opened.page.get_by_text("Save press-result.h5").click()
    saved = tmp_path / "saved.h5"
    download.value.save_as(saved)
    result, expected = io.open_result(saved), by_command(press, tmp_path, "--threshold", "0.37")
    assert {*result} == {*expected}
    for name in expected:
        np.testing.assert_array_equal(result[name], expected[name])


def test_the_command_is_copied(opened):
    opened.show("Save and copy")
    opened.expect_command("mirrorskin reconstruct")
    command = opened.command.input_value()
    opened.page.get_by_text("Copy the command").click()
    opened.page.wait_for_function("async text => await navigator.clipboard.readText() === text", arg=command)


def test_the_previous_result_is_shown_next_to_the_new_one(opened):
    opened.show("Result")
    opened.page.wait_for_function(CANVASES, arg=2)
    opened.set_threshold(0.4)
    opened.page.wait_for_function(CANVASES, arg=3)
    opened.keep("app-result")


def test_an_option_beyond_its_limits_says_why_next_to_the_field(opened):
    opened.set_threshold(1.7)
    note = opened.page.get_by_text("threshold 1.7: a share from 0 to 1 is needed, such as 0.5")
    note.wait_for()
    field = opened.page.get_by_role("textbox", name="Threshold (share)").bounding_box()
    assert 0 < note.bounding_box()["y"] - field["y"] < 100
    opened.set_threshold(0.5)
    note.wait_for(state="hidden")


def test_a_file_that_is_dropped_on_the_page_opens(opened, press, tmp_path):
    done("reconstruct", press, "-o", tmp_path / "dropped.h5")
    opened.page.evaluate(DROP, list((tmp_path / "dropped.h5").read_bytes()))
    opened.page.get_by_text("dropped.h5; height at").wait_for()
    opened.page.get_by_text("highest point", exact=True).wait_for()
    with opened.page.expect_download() as download:
        opened.page.get_by_text("Save measures.csv").click()
    download.value.save_as(tmp_path / "measures.csv")
    first = engine.measure(io.open_result(tmp_path / "dropped.h5")).quantities["highest point"]
    assert f"highest point,{first.value!r},{first.sigma!r},mm" in (tmp_path / "measures.csv").read_text()


def test_measures_are_copied(opened):
    opened.show("Result")
    opened.page.get_by_text("Copy measures").click()
    opened.page.wait_for_function("async () => (await navigator.clipboard.readText()).includes('Sq\\t')")


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGSTOP])
def test_a_program_that_does_not_answer_is_shown(browser, press, ending):
    with serving(press) as (server, address):
        page = Page(browser, address)
        server.send_signal(ending)
        page.page.get_by_text("The program does not answer.").wait_for()
        assert page.page.evaluate("() => document.getElementById('body').inert")
        page.context.close()


def test_a_section_is_drawn_by_dragging(opened):
    opened.show("Result")
    box = opened.page.locator(".bk-Canvas:visible").first.bounding_box()
    places = [
        (box["x"] + fraction * box["width"], box["y"] + 0.4 * box["height"]) for fraction in (0.3, 0.5, 0.6)
    ]
    opened.page.mouse.move(*places[0])
    opened.page.mouse.down()
    for place in places[1:]:
        opened.page.mouse.move(*place, steps=4)
    opened.page.mouse.up()
    opened.page.get_by_text("from (").wait_for()


def test_a_region_is_measured_by_dragging(opened):
    opened.show("Result")
    opened.page.get_by_text("Region to measure", exact=True).click()
    whole = opened.page.get_by_text("Measures of the whole map")
    whole.wait_for()
    box = opened.page.locator(".bk-Canvas:visible").first.bounding_box()
    opened.page.mouse.move(box["x"] + 0.35 * box["width"], box["y"] + 0.3 * box["height"])
    opened.page.mouse.down()
    opened.page.mouse.move(box["x"] + 0.55 * box["width"], box["y"] + 0.6 * box["height"], steps=5)
    opened.page.mouse.up()
    opened.page.get_by_text("Measures of the region").wait_for()


def test_the_surface_is_drawn(opened):
    opened.show("Surface")
    opened.keep("app-surface")


@pytest.mark.parametrize("width", [800, SIZE["width"]])
@pytest.mark.parametrize("tab", ["Recording", "Result", "Surface", "Save and copy"])
def test_nothing_needs_to_be_scrolled_sideways(opened, tab, width):
    opened.page.set_viewport_size({"width": width, "height": SIZE["height"]})
    opened.show(tab)
    opened.page.wait_for_function("width => document.scrollingElement.scrollWidth <= width", arg=width)


CONTROLS = {"button", "checkbox", "combobox", "listbox", "radio", "slider", "spinbutton", "tab", "textbox"}


def unnamed(page):
    """Return the roles of controls that have no name for those who cannot see the page."""
    nodes = page.context.new_cdp_session(page).send("Accessibility.getFullAXTree")["nodes"]
    roles = [(node.get("role", {}).get("value"), node.get("name", {}).get("value", "")) for node in nodes]
    return [role for role, name in roles if role in CONTROLS and not name.strip()]


@pytest.mark.parametrize("tab", ["Recording", "Result", "Save and copy"])
def test_every_control_has_a_name(opened, tab):
    opened.show(tab)
    opened.page.get_by_role("button", name="wheel zoom").or_(opened.command).first.wait_for()
    deadline = time.monotonic() + PATIENCE
    while roles := unnamed(opened.page):  # names are set when a control is drawn
        assert time.monotonic() < deadline, roles
        opened.page.wait_for_timeout(50)


def test_it_asks_no_other_machine_and_complains_of_nothing(opened, address):
    for tab in ("Result", "Surface", "Save and copy"):
        opened.show(tab)
    origin = address.rpartition("/")[0]
    assert [url for url in opened.requests if not url.startswith((origin, "data:", "about:", "blob:"))] == []
    assert opened.complaints == []
