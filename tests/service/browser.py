"""A real browser: the Chromium that is installed (Debian's package), without a window."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from tests.service.servers import PATIENCE

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chromium-browser"))), None)
needed = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed: apt-get install chromium")


@contextlib.contextmanager
def launched() -> Iterator[Browser]:
    """The browser."""
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox"], timeout=1000 * PATIENCE
        )
        yield found
        found.close()


class Tab:
    """A page, everything that it asked for and everything that went wrong in it."""

    def __init__(self, browser: Browser, *, wide: int = 1280, high: int = 800, dark: bool = False) -> None:
        size: Any = {"width": wide, "height": high}
        self.context = browser.new_context(viewport=size, color_scheme="dark" if dark else "light")
        self.context.set_default_timeout(1000 * PATIENCE)
        self.page: Page = self.context.new_page()
        self.asked: list[str] = []
        self.wrong: list[str] = []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("websocket", lambda socket: self.asked.append(socket.url))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("console", lambda m: self.wrong.append(m.text) if m.type == "error" else None)

    def tell(self, expression: str) -> Any:
        """The value of an expression in the page."""
        return self.page.evaluate(f"() => {expression}")

    def until(self, expression: str) -> None:
        """Wait until it is true."""
        deadline = time.monotonic() + PATIENCE
        while not self.tell(f"Boolean({expression})"):
            if time.monotonic() > deadline:
                said = self.tell("document.body.innerText")
                raise AssertionError(f"not true in time: {expression}\n{said}\n{self.wrong}")
            time.sleep(0.05)

    def close(self) -> None:
        """Close it."""
        self.context.close()
