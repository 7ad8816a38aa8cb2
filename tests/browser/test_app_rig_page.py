"""The application's rig in a real browser, with an emulated rig in another process."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from mirrorskin.hw.base.rig_file import load_rig
from mirrorskin.hw.rig.rig import open_stage
from mirrorskin.io import InputError

PATIENCE = 60.0  # seconds
SCREENSHOTS = os.environ.get("MIRRORSKIN_SCREENSHOTS")  # a folder to keep pictures of the pages in
MIRRORSKIN = [sys.executable, "-m", "mirrorskin.cli.main"]


@pytest.fixture
def rig_file(tmp_path):
    """The file of an emulated rig that runs in another process."""
    folder = tmp_path / "rig"
    with subprocess.Popen([*MIRRORSKIN, "twin", "serve", "-o", str(folder)], stdout=subprocess.PIPE) as twin:
        twin.stdout.readline()
        yield folder / "rig.toml"
        twin.terminate()


@pytest.fixture
def opened(browser, rig_file):
    """The page of the rig, connected, in a context of its own."""
    command = [*MIRRORSKIN, "app", "--rig", str(rig_file), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        context = browser.new_context(viewport={"width": 1440, "height": 900})
        context.set_default_timeout(1000 * PATIENCE)
        page = context.new_page()
        page.goto(server.stdout.readline().strip())
        page.locator("button", has_text="Connect").click()
        page.get_by_text("ready, the stage rests").wait_for()
        yield page
        context.close()
        server.terminate()


def run(page, speed):
    """Start a press, and wait until it is under way."""
    field = page.get_by_label("Speed (mm/s)")
    field.fill(str(speed))
    field.press("Enter")
    page.locator("button", has_text="Start").click()
    page.get_by_text("the stage moves", exact=True).wait_for()
    page.get_by_text("Frames used").wait_for()


def released(rig_file):
    """Open the stage as soon as the application lets it go, and return its state."""
    settings = load_rig(rig_file).stage
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            stage = open_stage(settings, unlock=True)
        except InputError:
            assert time.monotonic() < deadline
            time.sleep(0.1)
            continue
        try:
            return stage.report()
        finally:
            stage.close()


def test_heights_grow_and_the_result_is_shown(opened):
    run(opened, 0.5)
    opened.get_by_text("Contact area", exact=True).wait_for()
    if SCREENSHOTS:
        opened.screenshot(path=f"{SCREENSHOTS}/app-rig.png")
    opened.get_by_text("Show the result").click()
    opened.get_by_text("Measures of the whole map").wait_for()


def test_stop_ends_a_run(opened, rig_file):
    run(opened, 0.05)
    opened.get_by_text("STOP", exact=True).click()
    opened.get_by_text("The stage was stopped.").wait_for()
    assert released(rig_file).state in ("idle", "alarm")


def test_closing_the_page_ends_a_run(opened, rig_file):
    run(opened, 0.05)
    opened.close()
    report = released(rig_file)
    assert report.state in ("idle", "alarm")
    assert report.position.travel < 1.4  # the press to 1.5 mm would have taken half a minute
