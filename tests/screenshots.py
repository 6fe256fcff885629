"""Pictures of the live view for README and the documentation: `make screenshots`.

The simulator plays the sample take, a gateway publishes it, and Chromium shows it. Look at the pictures
before you commit them.
"""

import tempfile
from pathlib import Path
from typing import Final

from playwright.sync_api import Page, ViewportSize, sync_playwright

from tests.support.browser import CHROMIUM, FLAGS
from tests.support.documents import ROOT
from tests.support.gateway_process import gateway_process, simulator
from tests.view.view_process import view_process

_SIZE: Final[ViewportSize] = {"width": 1200, "height": 700}
_TIMEOUT_MS: Final = 120_000

_MOMENT: Final = (0.7, 0.95)
"""The places, in metres, between which the person stands on a plate and no label hides another one."""

_ZOOM: Final = 4
"""How many steps of the mouse wheel the camera comes nearer: the view fits the whole walk."""

_NO_NOTICE: Final = ".mantine-Notifications-root { display: none }"
"""Software rendering is what this computer lacks, not what users see."""

_ON_PLATES: Final = """([from, to]) => {
    const nodes = window.__viserSceneTree?.getState() ?? {};
    const points = nodes["/sources/MOCAP_LAB/markers"]?.message.props.points ?? [];
    const places = Array.from(points).filter((_, index) => index % 3 == 1);
    const middle = places.reduce((sum, place) => sum + place, 0) / places.length;
    return from < middle && middle < to;
}"""
"""Whether the person is between two places in the direction of walking, in metres."""


def _picture(page: Page, theme: str, file: Path) -> None:
    page.get_by_role("tab", name="Scene").click()
    page.get_by_role("button", name=theme).click()
    page.get_by_role("tab", name="Sources").click()
    page.wait_for_function(_ON_PLATES, arg=[*_MOMENT])
    page.screenshot(path=file, style=_NO_NOTICE)
    print(f"{file.relative_to(ROOT)}: {file.stat().st_size / 1000:.0f} kB")


def main() -> None:
    """Write docs/view-light.png and docs/view-dark.png."""
    with (
        tempfile.TemporaryDirectory() as folder,
        simulator("--take", str(ROOT / "examples/walk.lcmlog")) as (port, _),
        gateway_process(Path(folder), port, hub="router") as gateway,
        view_process("--connect", gateway.endpoint) as view,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport=_SIZE)
        page.set_default_timeout(_TIMEOUT_MS)
        page.goto(view.address)
        page.wait_for_function(_ON_PLATES, arg=[*_MOMENT])
        page.mouse.move(400, 400)
        for _ in range(_ZOOM):
            page.mouse.wheel(0, -100)
            page.wait_for_timeout(300)
        for theme in ("light", "dark"):
            _picture(page, theme, ROOT / f"docs/view-{theme}.png")
        browser.close()


if __name__ == "__main__":
    main()
