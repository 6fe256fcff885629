"""``rtc3d-gateway view`` in a real browser, fed by scenes that the tests choose."""

import itertools
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import pytest
from playwright.sync_api import Browser

from gateway.takes.files.component_rows import Array
from tests.support.browser import NewPage, chromium, new_page, pages
from tests.support.gateway_process import gateway_process, simulator
from tests.support.networks import free_endpoint, free_port, open_zenoh
from tests.support.waiting import wait_until
from tests.view.picture import Picture, Position
from tests.view.published_scene import MISSING, PublishedScene, published_scene
from tests.view.view_process import ViewProcess, view_process

pytestmark = [pytest.mark.netns, pytest.mark.chromium, pytest.mark.timeout(600)]

__all__ = ["chromium", "new_page"]

WINDOW: Final = {"width": 800, "height": 320}

LEFT: Final = (-500.0, 0.0, 200.0)
RIGHT: Final = (500.0, 0.0, 200.0)
TOP: Final = (0.0, 0.0, 1200.0)
FREE: Final = (0.0, 0.0, 700.0)
BETWEEN: Final = (0.0, 0.0, 950.0)

MARKERS: Final = "/sources/MOCAP_LAB/markers"
LINKS: Final = "/sources/MOCAP_LAB/links 0"
LAST_PLACES: Final = "/sources/MOCAP_LAB/missing markers"


@pytest.fixture(scope="module")
def shared_scene() -> Iterator[PublishedScene]:
    with published_scene([LEFT, RIGHT, TOP]) as scene:
        yield scene


@pytest.fixture(scope="module")
def view(shared_scene: PublishedScene) -> Iterator[ViewProcess]:
    with view_process("--connect", shared_scene.endpoint) as process:
        yield process


@pytest.fixture(scope="module")
def picture(view: ViewProcess, chromium: Browser) -> Iterator[Picture]:
    """A page that all tests share, because opening one takes seconds."""
    with pages(chromium) as new_page:
        picture = Picture(new_page(viewport=WINDOW), view.address)
        see(picture, LEFT, RIGHT, TOP)
        yield picture


@pytest.fixture
def scene(shared_scene: PublishedScene, picture: Picture) -> PublishedScene:
    """The scene as every test begins, seen in the picture."""
    shared_scene.markers = [LEFT, RIGHT, TOP]
    shared_scene.is_sending = True
    picture.wait_for_points(MARKERS, [LEFT, RIGHT, TOP])
    return shared_scene


def see(picture: Picture, *positions: Position) -> None:
    """Wait until just these markers are shown, and the view is fitted to them."""
    picture.wait_for_points(MARKERS, positions)
    picture.wait_for_view_of(MARKERS, positions)


def is_blue(color: Array) -> bool:
    """Whether it is the colour of the first source."""
    red, _, blue = color
    return bool(blue - red > 100)


def is_bluish(color: Array) -> bool:
    """Whether a thin line in the colour of the first source covers a part of it."""
    red, _, blue = color
    return bool(blue - red > 40)


def is_grey(color: Array) -> bool:
    """Whether it is the colour of what is not live."""
    return bool(color.max() - color.min() < 30 and 90 < color.mean() < 170)


def is_background(color: Array) -> bool:
    return bool(color.mean() < 60)


def test_markers_are_drawn_where_they_are(scene: PublishedScene, picture: Picture) -> None:
    for position in (LEFT, RIGHT, TOP):
        picture.wait_for_drawn(MARKERS, position, is_blue)
    picture.wait_for_drawn(MARKERS, FREE, is_background)
    scene.markers = [LEFT, RIGHT, FREE]
    picture.wait_for_drawn(MARKERS, FREE, is_blue)
    picture.wait_for_drawn(MARKERS, TOP, is_background)


def test_the_key_f_fits_the_view_that_somebody_has_moved(scene: PublishedScene, picture: Picture) -> None:
    fitted = picture.camera_position
    picture.page.mouse.move(60, 280)  # a notice covers what is above
    picture.page.mouse.down()
    picture.page.mouse.move(150, 280, steps=5)
    picture.page.mouse.up()
    picture.wait_until(lambda: picture.distance_to(fitted) > 0.5)
    picture.page.keyboard.press("f")
    picture.wait_until(lambda: picture.distance_to(fitted) < 0.2)
    picture.wait_for_view_of(MARKERS, scene.markers)


def test_a_missing_marker_is_absent_and_its_last_place_fades(scene: PublishedScene, picture: Picture) -> None:
    picture.wait_for_drawn(MARKERS, TOP, is_blue)
    scene.is_blinking = True  # so that the last place does not fade before a slow browser shows it
    picture.wait_for_points(LAST_PLACES, [TOP])
    scene.is_blinking = False
    scene.markers = [LEFT, RIGHT, MISSING]
    picture.wait_for_points(MARKERS, [LEFT, RIGHT])
    picture.wait_for_points(LAST_PLACES, [])
    picture.wait_for_drawn(MARKERS, TOP, is_background)
    scene.markers = [LEFT, RIGHT, TOP]
    picture.wait_for_drawn(MARKERS, TOP, is_blue)


def test_a_scene_without_any_visible_marker_is_empty(scene: PublishedScene, picture: Picture) -> None:
    scene.markers = [MISSING] * 3
    picture.wait_for_points(MARKERS, [])
    scene.markers = []
    picture.wait_for_points(LAST_PLACES, [])
    scene.markers = [LEFT]
    picture.wait_for_points(MARKERS, [LEFT])


def test_labels_follow_the_parameters(scene: PublishedScene, picture: Picture) -> None:
    scene.name_markers("LASI", "RASI", "SACR")
    picture.page.get_by_role("tab", name="Scene").click()
    picture.page.get_by_label("Marker labels").check()
    picture.wait_for_labels({"LASI": LEFT, "RASI": RIGHT, "SACR": TOP})
    scene.name_markers("L.ASI", "R.ASI", "SACRUM")
    picture.wait_for_labels({"L.ASI": LEFT, "R.ASI": RIGHT, "SACRUM": TOP})
    picture.page.get_by_label("Marker labels").uncheck()
    picture.wait_for_labels({})


def test_labels_at_the_same_place_are_beside_each_other_or_left_out(
    scene: PublishedScene, picture: Picture
) -> None:
    """There are four sides of a place, so two of six labels are left out."""
    picture.page.get_by_role("tab", name="Scene").click()
    picture.page.get_by_label("Marker labels").check()
    scene.markers = [TOP] * 6
    picture.wait_for_labels_drawn_at(MARKERS, TOP, 4)
    scene.markers = [LEFT, RIGHT, TOP]
    picture.page.get_by_label("Marker labels").uncheck()
    picture.wait_for_labels({})


def test_the_picture_says_that_data_have_stopped_and_dims(scene: PublishedScene, picture: Picture) -> None:
    picture.wait_for_drawn(MARKERS, LEFT, is_blue)
    scene.is_sending = False
    picture.wait_for_text("^lab: no data for ")
    picture.wait_for_notice("lab: no data since")
    picture.wait_for_drawn(MARKERS, LEFT, is_grey)
    scene.is_sending = True
    picture.wait_for_no_text("no data")
    picture.wait_for_notice("")
    picture.wait_for_drawn(MARKERS, LEFT, is_blue)


def test_a_link_joins_markers_that_move_together(scene: PublishedScene, picture: Picture) -> None:
    steps_mm = itertools.cycle((-100.0, 0.0, 100.0))

    def are_linked() -> bool:
        step_mm = next(steps_mm)
        scene.markers = [(x + step_mm, y, z) for x, y, z in (FREE, TOP)]
        return any(len(node["points"]) for node in picture.shown(LINKS).values())

    picture.wait_until(are_linked)
    scene.markers = [FREE, TOP]
    picture.wait_for_points(LINKS, [FREE, TOP])
    picture.wait_for_drawn(MARKERS, BETWEEN, is_bluish)
    picture.page.get_by_role("tab", name="Scene").click()
    picture.page.get_by_label("Links").uncheck()
    picture.wait_for_points(LINKS, [])
    picture.wait_for_drawn(MARKERS, BETWEEN, is_background)
    picture.page.get_by_label("Links").check()
    picture.wait_for_points(LINKS, [FREE, TOP])


SLOW = ("--rate", "50", "--analog-rate", "50")
"""Rendering in software leaves little of the machine for data, and a picture that lags is not live."""


NO_DATA: Final = {
    "enabled": True,
    "default_permission": "allow",
    "rules": [
        {
            "id": "no data",
            "permission": "deny",
            "flows": ["egress"],
            "messages": ["put"],
            "key_exprs": [f"mocap/lab/{key}" for key in ("3d", "6d", "analog", "force", "event")],
        }
    ],
    "subjects": [{"id": "all"}],
    "policies": [{"rules": ["no data"], "subjects": ["all"]}],
}
"""The access control of a router that passes on no data when they are published, but answers to queries."""


def test_what_happened_before_the_view_was_opened_is_there(tmp_path: Path, new_page: NewPage) -> None:
    """Behind this router, events and markers can only come from the gateway's history.

    If the server ended instead, a view that needs 10 s to start, as on a busy computer, would be too late.
    """
    with ExitStack() as stack:
        port, _ = stack.enter_context(simulator(*SLOW))
        gateway = stack.enter_context(gateway_process(tmp_path, port, hub="router"))
        endpoint = free_endpoint()
        router = open_zenoh("router", connect=gateway.endpoint, listen=endpoint, access_control=NO_DATA)
        stack.callback(router.close)
        wait_until(lambda: gateway.headers["event"])
        view = stack.enter_context(view_process("--connect", endpoint))
        picture = Picture(new_page(viewport=WINDOW), view.address)
        picture.wait_for_banner("lab: no data for")
        picture.wait_for_number_of_points(MARKERS, 10)
        picture.page.get_by_role("tab", name="Events").click()
        picture.page.locator(".events td").first.wait_for()


def test_a_source_that_is_lost_and_comes_back(tmp_path: Path, new_page: NewPage) -> None:
    port = free_port()
    with ExitStack() as stack:
        gateway = stack.enter_context(gateway_process(tmp_path, port, hub="router"))
        with simulator("--port", str(port), *SLOW):
            gateway.wait_for_frames(1)
            view = stack.enter_context(view_process("--connect", gateway.endpoint))
            picture = Picture(new_page(viewport=WINDOW), view.address)
            picture.wait_for_banner("live lab")
            picture.wait_for_number_of_points(MARKERS, 10)
        picture.wait_for_banner("lab: no data for")
        picture.wait_for_banner(f"waiting for 127.0.0.1:{port}")
        picture.wait_for_text("^lab: no data for ")
        with simulator("--port", str(port), *SLOW):
            picture.wait_for_banner("live lab")
            picture.wait_for_no_text("no data")
        assert view.end() == 0
        assert "\n" not in view.output.strip()  # nothing but the address
