"""A browser that opens pages from disk, and logs their requests and errors."""

from __future__ import annotations

import base64
import os
import shutil
import time
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

# WebGL on a processor; nothing that calls home.
OPTIONS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
PATIENCE = 20.0  # seconds
SCREENSHOTS = os.environ.get("MIRRORSKIN_SCREENSHOTS")  # a folder to keep pictures of the pages in


@pytest.fixture(scope="session")
def browser():
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.fail("no chromium on PATH: install Debian's package chromium", pytrace=False)
    if find_spec("playwright") is None:
        pytest.fail("these tests need Playwright: run them with 'make test-browser'", pytrace=False)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=chromium, args=OPTIONS)
        yield launched
        launched.close()


class Opened:
    """A page that was opened from disk.

    Attributes
    ----------
    page : playwright's Page
    requests, complaints : list of str
        Addresses that were asked for, and what the console and the scripts said.
    """

    def __init__(self, context, path):
        self.page, self.requests, self.complaints = context.new_page(), [], []
        self.address = path.resolve().as_uri()
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.goto(self.address)

    def settle(self):
        """Wait until what is asked to be drawn is drawn."""
        self.page.evaluate(
            """() => new Promise((done, failed) => {
                setTimeout(() => failed(new Error("nothing is drawn in this window")), 20000);
                requestAnimationFrame(() => requestAnimationFrame(done));
            })"""
        )

    def surface(self):
        """The drawn surface, (H, W, 4), blue, green, red and opacity, from above down."""
        self.settle()
        address = self.page.evaluate("() => document.getElementById('surface-canvas').toDataURL()")
        png = np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8)
        return cv2.imdecode(png, cv2.IMREAD_UNCHANGED)

    def until(self, right, what):
        """Look at the surface until it is as it should be, and return it; input takes a while to arrive."""
        deadline = time.monotonic() + PATIENCE
        while not right(surface := self.surface()):
            assert time.monotonic() < deadline, what
            self.page.wait_for_timeout(20)
        return surface

    def box(self):
        """Where the surface is on the screen: left, top, width and height, CSS pixels."""
        self.page.locator("#surface-canvas").scroll_into_view_if_needed()
        canvas = self.page.locator("#surface-canvas").bounding_box()
        return canvas["x"], canvas["y"], canvas["width"], canvas["height"]

    def point(self, across, down):
        """Point at a place on the surface, as shares of its width and height; return what is read."""
        left, top, width, height = self.box()
        self.page.mouse.move(left + across * width, top + down * height)
        self.settle()
        return self.page.locator("#surface-readout").inner_text()

    def keep(self, name):
        """Keep a picture of the whole page, if that is wanted."""
        if SCREENSHOTS:
            Path(SCREENSHOTS).mkdir(parents=True, exist_ok=True)
            self.page.screenshot(path=Path(SCREENSHOTS) / f"{name}.png", full_page=True)


@pytest.fixture
def opening(browser):
    """What opens a page in a context of its own, given how that should be, and closes the one before.

    Only the window in front is sure to be drawn.
    """
    contexts = []

    def opened(path, script="", **how):
        for context in contexts:
            context.close()
        contexts[:] = [browser.new_context(**{"viewport": {"width": 700, "height": 600}, **how})]
        contexts[0].add_init_script(script)
        return Opened(contexts[0], path)

    yield opened
    for context in contexts:
        context.close()
