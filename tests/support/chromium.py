"""A page in this machine's Chromium, which playwright drives. What it complains of and asks for is kept."""

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest

try:
    from playwright.sync_api import Page, sync_playwright
except ImportError:
    sync_playwright = None

PROGRAM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]  # WebGL without a GPU
MILLISECONDS = 60_000  # that anything may take
in_chromium = pytest.mark.skipif(PROGRAM is None or sync_playwright is None, reason="no Chromium or no playwright here")


@dataclass
class Visit:
    """A page, warnings and errors on its console, and addresses that it asked for."""

    page: Page
    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def wait(self, condition: str) -> None:
        """Until a JavaScript expression is true. Asked from outside: what playwright would run within, pages forbid."""
        end = time.monotonic() + MILLISECONDS / 1000
        while not self.page.evaluate(f"Boolean({condition})"):
            assert time.monotonic() < end, f"never true: {condition}"
            self.page.wait_for_timeout(50)

    def drag(self, selector: str, right: float, down: float) -> None:
        """Press the mouse on the middle of an element, move it by so many pixels in steps, release it."""
        element = self.page.locator(selector)
        element.scroll_into_view_if_needed()
        box = element.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        self.page.mouse.move(x + right, y + down, steps=5)
        self.page.mouse.up()


@contextmanager
def visiting(address: str) -> Iterator[Visit]:
    """An address in a window of 1400 x 1000 pixels."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=PROGRAM, args=FLAGS)
        page = browser.new_page(viewport={"width": 1400, "height": 1000})
        page.set_default_timeout(MILLISECONDS)
        visit = Visit(page)
        page.on("pageerror", lambda error: visit.complaints.append(str(error)))
        page.on("request", lambda request: visit.requests.append(request.url))
        page.on(
            "console",
            lambda said: visit.complaints.append(said.text) if said.type in ("error", "warning", "assert") else None,
        )
        page.goto(address)
        yield visit
        browser.close()
