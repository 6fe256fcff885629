"""Pages in Debian's Chromium, driven by playwright.

A test module imports the fixtures ``chromium`` and ``new_page``, and marks its tests with ``chromium``. Its
tests cannot be async, and the browser is closed at the end of the module: playwright keeps an event loop
running.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Request, sync_playwright

CHROMIUM: Final = Path("/usr/bin/chromium")
FLAGS: Final = (
    "--no-sandbox",  # tests run as root in CI
    "--use-gl=angle",  # WebGL without a graphics card
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)
LOCAL_HOSTS: Final = {None, "127.0.0.1"}
"""The hosts that a page may contact; None is that of file:, data: and blob: addresses."""

NewPage = Callable[..., Page]
"""Opens an empty page. Its arguments are those of playwright's ``Browser.new_context``, such as viewport."""


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def new_page(chromium: Browser) -> Iterator[NewPage]:
    """Open pages, each with a profile of its own; see ``pages``."""
    with pages(chromium) as open_page:
        yield open_page


@contextmanager
def pages(chromium: Browser) -> Iterator[NewPage]:
    """Open pages, each with a profile of its own, until the end of the block.

    Then the test fails if a page has logged an error, raised one, or contacted another host.
    """
    problems: list[str] = []
    contexts: list[BrowserContext] = []  # not all of the browser's: other tests share pages of it

    def on_console(message: ConsoleMessage) -> None:
        if message.type == "error":
            problems.append(f"error in the console: {message.text} ({message.location.get('url')})")

    def on_request(request: Request) -> None:
        if urlsplit(request.url).hostname not in LOCAL_HOSTS:
            problems.append(f"request to another host: {request.url}")

    def open_page(**options: Any) -> Page:
        contexts.append(chromium.new_context(**options))
        page = contexts[-1].new_page()
        page.on("console", on_console)
        page.on("pageerror", lambda error: problems.append(f"error in the page: {error}"))
        page.on("request", on_request)
        return page

    yield open_page
    for context in contexts:
        context.close()
    if problems:
        pytest.fail("\n".join(problems), pytrace=False)
