"""The camera of a browser: what it sees of the data, and when it is moved."""

from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gateway.messages.descriptions.force_plates import UpAxis
from gateway.rtc3d.components import ComponentType
from gateway.takes.files.component_rows import Array
from gateway.tools.display.view import camera
from gateway.tools.display.view.camera import (
    SAMPLE_US,
    WINDOW_US,
    Cameras,
    Pose,
    RecentPositions,
    Subject,
    fitted_pose,
    sees,
    without_outliers,
)
from tests.support.takes import START_UTIME
from tests.unit.tools.display.live_lab import MISSING, Lab

FOV: Final = 1.3
coordinates = st.floats(-20, 20, width=32)


@given(
    points=st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=1, max_size=8),
    up=st.sampled_from(["x", "y", "z"]),
    aspect=st.floats(0.3, 3),
)
@example([(12.0, 0.0, 20.0), (-13.0, 19.0, 12.0), (-1.0, 13.0, 4.0)], "y", 2.07)  # the camera was at a point
def test_a_fitted_camera_sees_all_points(
    points: list[tuple[float, float, float]], up: UpAxis, aspect: float
) -> None:
    seen = np.array(points)
    assert sees(fitted_pose(seen, up, FOV, aspect), seen, up, FOV, aspect)


PERSON: Final = np.array([(x, y, z) for x in (-0.3, 0.3) for y in (-2.0, 2.0) for z in (0.0, 1.8)])
"""The box in which somebody walks along y."""


@pytest.mark.parametrize(("aspect", "least"), [(0.46, 0.3), (1.6, 0.45)])
def test_the_data_fill_the_picture_on_a_phone_and_on_a_screen(aspect: float, least: float) -> None:
    """On a phone, the walk is seen from its end: from the side, it would fill a quarter of the height."""
    pose = fitted_pose(PERSON, "z", FOV, aspect)
    forward = pose.look_at - pose.position
    depth = (PERSON - pose.position) @ forward / np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1))
    upwards = np.cross(right / np.linalg.norm(right), forward / np.linalg.norm(forward))
    height = np.ptp((PERSON - pose.position) @ upwards / depth) / (2 * np.tan(FOV / 2))
    assert least < height < 1


def test_points_far_from_all_others_are_left_out() -> None:
    points = np.concatenate([np.tile(PERSON, (10, 1)), [(500.0, 0.0, 0.0)]])
    assert len(without_outliers(points)) == len(points) - 1
    assert len(without_outliers(np.empty((0, 3)))) == 0


def sampled(lab: Lab, recent: RecentPositions) -> list[list[float]]:
    recent.add(lab.source.components["3d"])
    return [*map(list, recent.points)]


def test_positions_are_kept_for_ten_seconds_one_frame_of_each_sample() -> None:
    """The history of a gateway comes at once, and live frames one by one."""
    lab, recent = Lab(), RecentPositions()
    for number in range(4):
        lab.send(
            ComponentType.MARKERS,
            [(1000 * number, 0, 0, 0), MISSING],
            utime=START_UTIME // SAMPLE_US * SAMPLE_US + number * SAMPLE_US // 2,
        )
    assert sampled(lab, recent) == [[0, 0, 0], [2, 0, 0]]
    lab.send(ComponentType.MARKERS, [(4000, 0, 0, 0)], utime=START_UTIME + WINDOW_US + SAMPLE_US)
    assert sampled(lab, recent) == [[2, 0, 0], [4, 0, 0]]
    lab.send(ComponentType.MARKERS, [(5000, 0, 0, 0)], utime=START_UTIME - 2 * WINDOW_US)
    assert sampled(lab, recent) == [[5, 0, 0]]


class Browser:
    """A browser with a camera that its user can move."""

    client_id = 1

    def __init__(self) -> None:
        self.camera = SimpleNamespace(fov=FOV, image_width=800, image_height=400, position=np.zeros(3))
        self.num_moves = 0


class Room:
    """Cameras, one browser, and what is in the picture."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.cameras = Cameras()
        self.browser: Any = Browser()
        self.points: Array = PERSON
        self.subject = Subject("z", ("lab",), 1)
        self._now_s = 1000.0
        monkeypatch.setattr(camera, "_move", self._move)

    def _move(self, client: Any, pose: Pose, _up: UpAxis) -> None:
        client.camera.position = pose.position
        client.num_moves += 1

    def after(self, seconds: float) -> int:
        """Let time pass; return how often the camera was moved in it."""
        before = self.browser.num_moves
        for _ in range(round(10 * seconds)):
            self._now_s += 0.1
            self.cameras.update({1: self.browser}, self.subject, lambda: [self.points], self._now_s)
        return int(self.browser.num_moves - before)

    def move_as_user(self) -> None:
        self.browser.camera.position = self.browser.camera.position + 1.0


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> Room:
    room = Room(monkeypatch)
    assert room.after(1.5) == 1
    return room


def test_a_camera_stays_while_it_sees_the_data_and_follows_data_that_leave_early(room: Room) -> None:
    assert room.after(3.0) == 0
    room.points = 2 * PERSON
    assert room.after(2.0) == 1
    assert room.after(5.0) == 0
    room.points = 4 * PERSON
    assert room.after(20.0) == 0  # the last 10 s are known by now


def test_a_camera_that_its_user_has_moved_stays(room: Room) -> None:
    room.move_as_user()
    room.points = 2 * PERSON
    assert room.after(3.0) == 0
    room.subject = room.subject._replace(num_with_data=2)
    assert room.after(3.0) == 0


def test_the_key_and_other_sources_move_even_a_camera_that_its_user_has_moved(room: Room) -> None:
    room.move_as_user()
    assert room.after(2.0) == 0
    room.cameras.fit_again(room.browser)
    assert room.after(0.1) == 1
    for subject in (Subject("z", ("gym", "lab"), 2), Subject("y", ("gym", "lab"), 2)):
        assert room.after(2.0) == 0
        room.move_as_user()
        assert room.after(2.0) == 0
        room.subject = subject
        assert room.after(2.0) == 1


def test_the_first_markers_move_a_camera_that_has_seen_only_plates(room: Room) -> None:
    room.subject = Subject("z", ("gym",), 0)
    assert room.after(20.0) == 1
    room.subject = Subject("z", ("gym",), 1)
    room.points = 2 * PERSON
    assert room.after(1.0) == 1


def test_without_a_source_or_points_no_camera_is_moved(room: Room) -> None:
    room.subject = Subject("z", (), 0)
    assert room.after(2.0) == 0
    room.subject, room.points = Subject("z", ("gym",), 1), np.empty((0, 3))
    assert room.after(2.0) == 0
    room.points = PERSON
    assert room.after(0.1) == 1


@pytest.mark.parametrize(
    "lens", [{"image_height": 0}, {"image_width": 0}, {"fov": 0.0}, {"fov": 9.0}, {"fov": np.nan}]
)
def test_a_browser_may_say_anything_about_its_lens(room: Room, lens: dict[str, Any]) -> None:
    for name, value in lens.items():
        setattr(room.browser.camera, name, value)
    room.cameras.fit_again(room.browser)
    assert room.after(0.1) == 1
    assert np.isfinite(room.browser.camera.position).all()
