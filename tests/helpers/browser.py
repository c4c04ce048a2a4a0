"""A browser for tests of pages: Chromium where there is one."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

# WebGL in software, and no sandbox, which a container may not allow
ARGUMENTS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
NAMES = ("chromium", "google-chrome", "chromium-browser")


def chromium() -> str:
    """Path of the browser. Without one, and without playwright, the test is skipped; on CI (CI=true) it fails."""
    give_up = pytest.fail if os.environ.get("CI") == "true" else pytest.skip
    path = next((found for name in NAMES if (found := shutil.which(name))), None)
    if path is None:
        give_up(f"no browser: none of {', '.join(NAMES)} in PATH")
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        give_up("no playwright: pip install playwright")
    return path  # pyright: ignore[reportReturnType]


@contextmanager
def page_of(url: str, width: int = 1000, height: int = 640) -> Iterator[tuple[Any, list[str]]]:
    """A page of a browser at this address, and the addresses that it has asked for so far."""
    path = chromium()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=path, args=[*ARGUMENTS])
        page = browser.new_page(viewport={"width": width, "height": height})
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.on("websocket", lambda socket: asked.append(socket.url))
        try:
            page.goto(url)
            yield page, asked
        finally:
            browser.close()
