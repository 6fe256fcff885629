"""The cameras of the browsers: what they should see, and when they are moved."""

from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import viser

from gateway.messages.descriptions.force_plates import UpAxis
from gateway.takes.files.component_rows import Array
from gateway.tools.display.live import LiveComponent
from gateway.tools.display.view.scene_items import is_shown, on_floor, positions_in_metres

WINDOW_US: Final = 10_000_000
"""The camera is fitted to the data of this time."""

SAMPLE_US: Final = 250_000
"""The frames to which it is fitted are so far apart."""

_NO_POINTS: Final = np.empty((0, 3), np.float32)


class RecentPositions:
    """Where the markers or tools of a source were during the last 10 s."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, Array]] = deque()  # the time in SAMPLE_US, and the positions

    def add(self, component: LiveComponent) -> None:
        """Take the frames that have arrived, one for each SAMPLE_US."""
        rows = component.batch
        samples = rows.heads["utime"] // SAMPLE_US
        last = self._samples[-1][0] if self._samples else None
        for num_items, items in rows.items.items():
            times = samples[rows.heads["num_items"] == num_items]
            is_new = np.diff(times, prepend=-1) != 0
            for time, row in zip(times[is_new].tolist(), items[is_new], strict=True):
                if time != last:
                    self._samples.append((time, positions_in_metres(row, component.description.unit)))
        if len(rows.heads):
            newest = int(samples[-1])
            num_samples = WINDOW_US // SAMPLE_US
            while abs(newest - self._samples[0][0]) > num_samples or len(self._samples) > 2 * num_samples:
                self._samples.popleft()

    @property
    def points(self) -> Array:
        """All positions, shape (points, 3), in metres; NaN is left out."""
        points = np.concatenate([_NO_POINTS, *(positions for _, positions in self._samples)])
        seen: Array = points[is_shown(points)]
        return seen


MIN_RADIUS_M: Final = 0.3
"""The camera sees this much around the middle, even if there is only one marker."""

_FAR: Final = 4.0
"""Points that are this much farther from the middle than most others are not what the picture is about."""


def without_outliers(points: Array) -> Array:
    """Return the points that are near the others, shape (points, 3)."""
    if not len(points):
        return points
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    near: Array = points[distances <= _FAR * np.percentile(distances, 75) + MIN_RADIUS_M]
    return near


class Pose(NamedTuple):
    """Where a camera is and what it turns around, in metres."""

    position: Array
    look_at: Array


_FILLED: Final = 0.85
"""The share of the width or the height that the points fill; labels stand beside them."""

_FROM: Final = (0.6, -1.0, 0.5)
"""The usual direction to the camera: on the two axes of the floor, and up."""

_NUM_DIRECTIONS: Final = 8
"""From how many sides the points may be seen: from where they are largest, as a walk is from its side."""

_MUCH_NEARER: Final = 1.1
"""They are seen from the usual side unless the farthest is so many times nearer from another one."""


def fitted_pose(points: Array, up: UpAxis, fov: float, aspect: float) -> Pose:
    """Return from where a camera sees all points, shape (points, 3), as large as possible.

    ``fov`` is the vertical angle of view in rad, ``aspect`` the width of the picture divided by its height.
    """
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = MIN_RADIUS_M * np.eye(3)
    points = np.concatenate([points, middle + radius, middle - radius])
    first, second, height = _FROM
    turns = np.exp(2j * np.pi * np.arange(_NUM_DIRECTIONS) / _NUM_DIRECTIONS) * complex(first, second)
    directions = [on_floor(up, turn.real, turn.imag, height) for turn in turns]
    poses = [_pose_from(direction, points, up, fov, aspect) for direction in directions]
    farthest_m = [float(np.linalg.norm(points - pose.position, axis=1).max()) for pose in poses]
    best = int(np.argmin(farthest_m))
    return poses[best] if farthest_m[best] * _MUCH_NEARER < farthest_m[0] else poses[0]


def _distance_m(pose: Pose) -> float:
    """Return how far the camera is from what it turns around."""
    return float(np.linalg.norm(pose.position - pose.look_at))


def _pose_from(direction: tuple[float, ...], points: Array, up: UpAxis, fov: float, aspect: float) -> Pose:
    axes = _axes(np.array(direction), up)
    by_axis = points.astype(float) @ axes.T
    depth = by_axis[:, 2]
    tangent = _FILLED * np.tan(fov / 2)
    # The planes at the four sides of the view touch the outermost points: (x - x_camera) is at most
    # tangent * (depth - depth_camera).
    sides = []
    for values, slope in ((by_axis[:, 0], tangent * aspect), (by_axis[:, 1], tangent)):
        right, left = float(np.max(values - slope * depth)), float(np.max(-values - slope * depth))
        sides.append(((right - left) / 2, -(right + left) / (2 * slope)))
    (x, depth_by_width), (y, depth_by_height) = sides
    nearest = depth.min() - MIN_RADIUS_M  # the camera may touch no point
    position = np.array([x, y, min(depth_by_width, depth_by_height, nearest)])
    look_at = np.array([x, y, (depth.min() + depth.max()) / 2])
    return Pose(position @ axes, look_at @ axes)


def _axes(direction: Array, up: UpAxis) -> Array:
    """Return the camera's axes as rows: right, up, and forward; ``direction`` is that to the camera."""
    forward = -direction / np.linalg.norm(direction)
    right = np.cross(forward, on_floor(up, 0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(right, forward), forward])


def sees(pose: Pose, points: Array, up: UpAxis, fov: float, aspect: float) -> bool:
    """Return whether a camera sees all points, shape (points, 3)."""
    axes = _axes(pose.position - pose.look_at, up)
    x, y, depth = axes @ (points - pose.position).T
    tangent = np.tan(fov / 2)
    return bool(np.all((abs(x) <= tangent * aspect * depth) & (abs(y) <= tangent * depth)))


_SETTLE_S: Final = 0.3
"""How long after a change of the sources the cameras are fitted: others may come at the same time."""

_GROW_S: Final = 10.0
"""How long a camera follows data that leave its picture: until then, 10 s of data were not known."""

_CHECK_S: Final = 1.0
"""How often that is checked."""

_ARRIVE_S: Final = 1.0
"""How long a page may say where its camera was before it was sent elsewhere."""

_SAME: Final = 0.01
"""A camera this close to where it was sent was not moved by its user. Relative to its distance."""


class Subject(NamedTuple):
    """What the picture is about."""

    up: UpAxis
    """The axis that points up: with another one, everything turns."""
    sources: tuple[str, ...]
    """The sources that are shown."""
    num_with_data: int
    """How many of them have had markers or tools, and not only force plates."""


@dataclass
class _Page:
    """The camera of one browser."""

    subject: Subject
    """What it was fitted to."""
    pose: Pose
    fitted_s: float
    """When it was fitted to this subject for the first time."""
    sent_s: float
    """When it was sent to its pose."""
    is_moved: bool = False
    """Whether its user has moved it."""

    def note_place(self, position: Array, now_s: float) -> None:
        """Take note of where the browser says its camera is."""
        is_there = bool(np.linalg.norm(position - self.pose.position) <= _SAME * _distance_m(self.pose))
        self.is_moved |= not is_there and now_s - self.sent_s > _ARRIVE_S

    def must_fit(self, subject: Subject, now_s: float, *, is_check_due: bool) -> bool:
        """Return whether it is fitted, if it does not see everything."""
        if subject[:2] != self.subject[:2]:
            return True
        is_new = subject != self.subject or (is_check_due and now_s - self.fitted_s <= _GROW_S)
        return is_new and not self.is_moved


class Cameras:
    """Fits the cameras of all browsers.

    A camera is fitted when its page opens, when other sources are shown, and when its user wants it. Until
    the user moves it, it is also fitted to the first markers and tools of a source, and to data that leave
    the picture in the first seconds.
    """

    def __init__(self) -> None:
        self._pages: dict[int, _Page] = {}
        self.distance_m = 5.0
        """How far the camera that was fitted last is from what it turns around."""
        self._subject: Subject | None = None
        self._changed_s = 0.0
        self._check_s = 0.0

    def fit_again(self, client: viser.ClientHandle) -> None:
        """Fit the camera of a browser at the next update. It may be called in any thread."""
        self._pages.pop(client.client_id, None)

    def update(
        self,
        clients: dict[int, viser.ClientHandle],
        subject: Subject,
        points: Callable[[], Iterable[Array]],
        now_s: float,
    ) -> None:
        """Move the cameras that have to be moved.

        ``points`` returns all that should be seen, each of shape (points, 3) in metres.
        """
        for number in [number for number in [*self._pages] if number not in clients]:
            self._pages.pop(number, None)
        if subject != self._subject:
            self._subject, self._changed_s = subject, now_s
        if not subject.sources or now_s - self._changed_s < _SETTLE_S:
            return
        is_check_due = now_s - self._check_s >= _CHECK_S
        self._check_s = now_s if is_check_due else self._check_s
        seen: Array | None = None
        for number, client in clients.items():
            page = self._pages.get(number)
            if page is not None:
                page.note_place(client.camera.position, now_s)
                if not page.must_fit(subject, now_s, is_check_due=is_check_due):
                    continue
            if seen is None:
                seen = without_outliers(np.concatenate([_NO_POINTS, *points()]))
            if not len(seen):
                return
            self._pages[number] = fitted = _fitted_page(client, page, subject, seen, now_s)
            self.distance_m = _distance_m(fitted.pose)


def _fitted_page(
    client: viser.ClientHandle, page: _Page | None, subject: Subject, seen: Array, now_s: float
) -> _Page:
    """Move the camera of a browser, unless it sees all that it was fitted to."""
    fov, aspect = _lens(client)
    fitted_s = now_s
    if page is not None and page.subject == subject:
        if sees(page.pose, seen, subject.up, fov, aspect):
            return page
        fitted_s = page.fitted_s
    pose = fitted_pose(seen, subject.up, fov, aspect)
    with suppress(ValueError):  # the browser has said that its camera is at no place
        _move(client, pose, subject.up)
    return _Page(subject, pose, fitted_s, now_s)


def _lens(client: viser.ClientHandle) -> tuple[float, float]:
    """Return the angle of view of a browser in rad, and its aspect ratio. A page may say anything."""
    camera = client.camera
    aspect = camera.image_width / max(1, camera.image_height)  # the height of a page can be 0
    fov = camera.fov if np.isfinite(camera.fov) else 1.0
    return float(np.clip(fov, 0.1, 3.0)), float(np.clip(aspect, 0.1, 10.0))


def _move(client: viser.ClientHandle, pose: Pose, up: UpAxis) -> None:
    with client.atomic():
        client.camera.up_direction = on_floor(up, 0.0, 0.0, 1.0)
        client.camera.position = pose.position
        client.camera.look_at = pose.look_at
