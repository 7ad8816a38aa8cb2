"""The application's rig in a real browser, with an emulated rig in another process."""

from __future__ import annotations

import os
import re
import signal
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
def server(rig_file):
    """The application with the rig, in another process."""
    command = [*MIRRORSKIN, "app", "--rig", str(rig_file), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        yield process
        process.kill()


@pytest.fixture
def opened(browser, server):
    """The page of the rig, connected, in a context of its own."""
    context = browser.new_context(viewport={"width": 1440, "height": 900})
    context.set_default_timeout(1000 * PATIENCE)
    page = context.new_page()
    page.goto(server.stdout.readline().strip())
    page.locator("button", has_text="Connect").click()
    page.get_by_text("ready, the stage rests").wait_for()
    yield page
    context.close()
    server.send_signal(signal.SIGCONT)
    server.terminate()
    server.wait(PATIENCE)


def run(page, speed):
    """Start a press, and wait until it is under way."""
    field = page.get_by_role("textbox", name="Speed (mm/s)")
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


FIRST = """() => {
    const banner = document.getElementById("lost")
    new MutationObserver(() => { window.first ??= banner.textContent }).observe(banner, {childList: true})
}"""


# Nothing but STOP can be used; what the program had sent before may still arrive.
OFF = '''() => ["head", "body", "stop"].map(part => document.getElementById(part).inert).join()
    === "true,true,false"'''


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGSTOP])
def test_a_dead_program_is_shown_and_a_failed_stop_says_what_to_do(opened, server, ending):
    assert opened.locator("#lost").is_hidden()
    opened.evaluate(FIRST)
    server.send_signal(ending)
    opened.locator("#lost").wait_for(state="visible")
    opened.wait_for_function(OFF)
    age = re.search(r"does not answer. What is shown is (\d) s old", opened.evaluate("() => window.first"))
    assert int(age[1]) <= 2
    opened.get_by_text("STOP", exact=True).click()
    failed = opened.locator("#unstopped", has_text="STOP failed: the program does not answer.")
    failed.wait_for()
    assert "emergency switch" in failed.inner_text()


def test_a_program_that_answers_again_can_be_used_again(opened, server):
    server.send_signal(signal.SIGSTOP)
    opened.locator("#lost").wait_for(state="visible")
    server.send_signal(signal.SIGCONT)
    opened.locator("#lost").wait_for(state="hidden")
    assert not opened.evaluate("() => document.getElementById('body').inert")


NUMBER = "() => [...Bokeh.documents[0].all_models].find(model => model.data?.number).data.number[0]"
BUSY = """() => {
    const end = performance.now() + 4000
    while (performance.now() < end);
    return new Promise(done => setTimeout(done, 100))
}"""


def test_pictures_do_not_queue_while_the_browser_is_busy(opened):
    """While the browser draws nothing for 4 s, 2 pictures at most are sent, not 26."""
    before = opened.evaluate(NUMBER)
    opened.evaluate(BUSY)
    assert opened.evaluate(NUMBER) - before <= 4
