"""The site in a real browser: searching and reading on a phone, from its folder, and its versions."""

import os
import sys
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from subprocess import run
from threading import Thread
from typing import Final

import pytest
from playwright.sync_api import Page, expect

from tests.support.browser import NewPage, chromium, new_page
from tests.support.documents import ROOT
from tests.support.fresh_clones import clone_into

pytestmark = pytest.mark.chromium

__all__ = ["chromium", "new_page"]

expect.set_options(timeout=60_000)  # busy machines need longer than the default of 5 s

PHONE: Final = {"viewport": {"width": 390, "height": 844}, "is_mobile": True, "has_touch": True}

TOO_WIDE: Final = """() => [...document.querySelectorAll("pre code")].filter(code => {
    const wraps = code.closest(".language-sh, .language-yaml, .language-json5, .language-ini");
    const scrolls = getComputedStyle(code).overflowX === "auto";
    return code.scrollWidth > code.clientWidth && (wraps || !scrolls);
}).map(code => code.textContent)"""
"""Code blocks with lines that cannot be read to the end, or only by swiping although they should wrap."""

FONT_SIZES: Final = """() => [...document.querySelectorAll("pre code")]
    .map(code => parseFloat(getComputedStyle(code).fontSize))"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("a site")  # with a space, as folders of users have
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    run(command, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, check=True)
    return folder


def search(page: Page, text: str) -> None:
    """Type a text into the field for searching, key by key: the page does not look at pasted text."""
    page.get_by_role("textbox", name="Search").press_sequentially(text)


def test_searching_finds_a_page_and_opens_it(site: Path, new_page: NewPage) -> None:
    page = new_page()
    page.goto((site / "how-to/record.html").as_uri())
    search(page, "WaveFront")
    result = page.locator(".md-search-result__link", has_text="Connect WaveFront").first
    expect(result).to_be_visible()
    result.click()
    expect(page.get_by_role("heading", level=1)).to_contain_text("Connect WaveFront")


def test_searching_for_what_is_not_there_says_so(site: Path, new_page: NewPage) -> None:
    page = new_page()
    page.goto((site / "index.html").as_uri())
    search(page, "xyzzy")
    expect(page.locator(".md-search-result__meta")).to_have_text("No matching documents")


def test_no_page_is_wider_than_a_phone(site: Path, new_page: NewPage) -> None:
    page = new_page(**PHONE)
    pages = sorted(set(site.rglob("*.html")) - {site / "404.html"})  # only web servers show that one
    assert len(pages) > 20
    for path in pages:
        page.goto(path.as_uri())
        assert page.evaluate("document.scrollingElement.scrollWidth") == 390, path.name
        assert page.evaluate(TOO_WIDE) == [], path.name
        assert all(size >= 12 for size in page.evaluate(FONT_SIZES)), path.name


def test_the_button_copies_a_block_as_it_is_in_the_source(site: Path, new_page: NewPage) -> None:
    page = new_page(permissions=["clipboard-read", "clipboard-write"])
    page.goto((site / "how-to/secure.html").as_uri())
    block = page.locator(".language-text", has_text="table inet rtc3d_lcm")
    block.hover()
    block.locator("button").first.click()
    expect(page.locator(".md-dialog")).to_contain_text("Copied to clipboard")
    copied = page.evaluate("navigator.clipboard.readText()")
    assert copied in (ROOT / "docs/how-to/secure.md").read_text()
    assert copied.count("\n") > 10


def test_a_web_server_shows_all_versions_the_newest_first(tmp_path: Path, new_page: NewPage) -> None:
    clone = tmp_path / "clone"
    run(["git", "init", "--quiet", str(clone)], check=True)
    clone_into(clone)
    with (clone / ".git/config").open("a") as file:
        file.write("[user]\nname = Release\nemail = release@example.org\n")
    run(["git", "commit", "--quiet", "--allow-empty", "--message=Release"], cwd=clone, check=True)
    make = ["make", "--assume-old=.venv/installed", f"BIN={Path(sys.executable).parent}", "site"]
    for version in ("1.0.2", "1.1.0"):
        (clone / "gateway/__init__.py").write_text(f'__version__ = "{version}"\n')
        run(make, cwd=clone, env=os.environ | {"MAKEFLAGS": ""}, check=True)
    site = tmp_path / "site"
    run(["git", "worktree", "add", "--quiet", str(site), "gh-pages"], cwd=clone, check=True)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=site)) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        page = new_page()
        page.goto(f"http://127.0.0.1:{server.server_port}/latest/how-to/record.html")
        page.wait_for_url("**/1.1/how-to/record.html")
        page.get_by_role("button", name="Select version").focus()
        page.get_by_role("link", name="1.0", exact=True).click()
        page.wait_for_url("**/1.0/", wait_until="networkidle")
        server.shutdown()
