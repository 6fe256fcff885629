"""The picture: the floor, the axes and the camera, and a group for each source."""

import time
from collections.abc import Sequence
from typing import Final, NamedTuple
from urllib.parse import quote

import numpy as np
import viser

from gateway.messages.descriptions.force_plates import METRES_PER_NEWTON, UpAxis, up_axis_of
from gateway.rtc3d.parameters import Parameters
from gateway.takes.files.component_rows import Array
from gateway.tools.display.live import DisplayedSource, LiveComponent
from gateway.tools.display.view.camera import (
    MIN_RADIUS_M,
    Cameras,
    RecentPositions,
    Subject,
    without_outliers,
)
from gateway.tools.display.view.links import Links
from gateway.tools.display.view.panel import Switches
from gateway.tools.display.view.plates import Plates
from gateway.tools.display.view.scene_items import (
    GREY,
    PLANES,
    UP_AXES,
    Markers,
    color_of,
    on_floor,
)
from gateway.tools.display.view.tools import Tools


class Sphere(NamedTuple):
    """What is to be seen, in metres."""

    centre: tuple[float, float, float]
    radius: float


def sphere_around(parts: Sequence[Array]) -> Sphere | None:
    """Return a sphere around points, each part of shape (points, 3); None without any. NaN is left out."""
    points = np.concatenate([np.empty((0, 3)), *parts])
    near = without_outliers(points[np.isfinite(points).all(axis=1)])
    if not len(near):
        return None
    centre = (near.min(axis=0) + near.max(axis=0)) / 2
    radius = max(MIN_RADIUS_M, float(np.linalg.norm(near - centre, axis=1).max()))
    x, y, z = centre.tolist()
    return Sphere((x, y, z), radius)


_AXIS_M: Final = 0.5
_GRID_M: Final = 10.0
_LINE_COLOR: Final = (110, 115, 125)


class World:
    """What does not move. ``up`` is the axis that points up."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        server.scene.configure_default_lights(cast_shadow=False)  # shadows cost browsers more than all else
        self._grids = {
            axis: server.scene.add_grid(
                f"/world/floor {axis}",
                _GRID_M,
                _GRID_M,
                plane=PLANES[axis],
                cell_size=0.25,
                cell_color=GREY,
                cell_thickness=0.4,
                section_size=1.0,
                section_color=_LINE_COLOR,
                section_thickness=1.0,
                fade_distance=15.0,
                shadow_opacity=0.0,
                visible=False,
            )
            for axis in UP_AXES
        }
        server.scene.add_frame("/world/axes", axes_length=_AXIS_M, axes_radius=0.006, origin_radius=0.012)
        for name, position in zip("xyz", _AXIS_M * np.eye(3), strict=True):
            server.scene.add_label(
                f"/world/{name}", name, position=position, anchor="bottom-center", font_screen_scale=0.8
            )
        self._unit = server.scene.add_label(
            "/world/unit", "1 m", anchor="center-center", font_screen_scale=0.8
        )
        self.up: UpAxis = "z"
        self.set_up("z")

    def set_up(self, up: UpAxis) -> None:
        """Turn the picture so that this axis points up."""
        self.up = up
        direction = on_floor(up, 0.0, 0.0, 1.0)
        self._server.scene.set_up_direction(direction)
        for axis, grid in self._grids.items():
            grid.visible = axis == up
        self._unit.position = on_floor(up, 1.0, 0.0)

    def update(self, *, forces: bool, floor: bool) -> None:
        """Show the floor or not, and say how much force an arrow of 1 m is if there are ``forces``."""
        self._unit.text = f"1 m = {1 / METRES_PER_NEWTON:.0f} N" if forces else "1 m"
        self._grids[self.up].visible = floor


AXES_SHARE: Final = 0.06
"""The length of the axes of tools, relative to the distance of the camera: about 30 pixels."""

_NAMES: Final = {"3d": "markers", "6d": "tools", "force": "forces", "analog": "analog data"}

_GAP_M: Final = 0.2
"""How much higher the label of each further source is that says that its data have stopped."""


class SourceScene:
    """The markers, links, tools, plates and forces of a source, in a group of their own.

    ``number`` is the source's: it has a colour of its own, and its labels are not where others have theirs.
    """

    def __init__(
        self, scene: viser.SceneApi, source: DisplayedSource, number: int, switch: viser.GuiCheckboxHandle
    ) -> None:
        self._number = number
        self._name = source.name
        self._switch = switch
        path = f"/sources/{quote(source.channels, safe='')}"
        self.group = scene.add_frame(path, show_axes=False)
        """What is visible if its switch is on."""
        self._markers = Markers(scene, path, color_of(number))
        self._links = Links(scene, path, number)
        self._tools = Tools(scene, path)
        self._plates = Plates(scene, path, number)
        self._has_subject = False
        self._recent = {"3d": RecentPositions(), "6d": RecentPositions()}
        self._stopped = scene.add_label(
            f"{path}/stopped", "", visible=False, font_screen_scale=1.6, anchor="bottom-center"
        )

    def update(
        self,
        source: DisplayedSource,
        up: UpAxis,
        switches: Switches,
        now_s: float,
        *,
        axes_m: float,
        is_alone: bool,
    ) -> None:
        """Show the newest data of the source, and tools with axes of a length of ``axes_m``.

        If it is not alone, its labels begin with its name.
        """
        if source.name != self._name:  # on LCM, a status says the name
            self._name = source.name
            self._switch.label = source.name
        self.group.visible = self.is_on
        if not self.group.visible:
            return
        components = {**source.components}
        for key, recent in self._recent.items():
            if key in components:
                recent.add(components[key])
        prefix = "" if is_alone else f"{source.name}: "
        if "3d" in components:
            labels, trails = switches.marker_labels.value, switches.trails.value
            self._markers.update(components["3d"], now_s, prefix, labels=labels, trails=trails)
            positions, links = self._markers.positions, switches.links.value
            self._links.update(components["3d"], positions, now_s, shown=links)
        if "6d" in components:
            tool_labels = switches.tool_labels.value
            self._tools.update(components["6d"], prefix, labels=tool_labels, length_m=axes_m)
        self._plates.update(components.get("force"), source.newest_parameters, up, now_s, prefix)
        self._say_stopped(source.name, components, up)

    @property
    def subject(self) -> "Sphere | None":
        """What is around the markers and tools in the picture; None without any."""
        return sphere_around([self._markers.positions, self._tools.positions])

    @property
    def has_plates(self) -> bool:
        """Whether force plates are shown."""
        return bool(self.group.visible) and len(self._plates.corners) > 0

    @property
    def is_on(self) -> bool:
        """Whether its switch is on."""
        return bool(self._switch.value)

    @property
    def has_subject(self) -> bool:
        """Whether markers or tools have been seen, and not only plates."""
        self._has_subject = self._has_subject or self.subject is not None
        return self._has_subject

    @property
    def points(self) -> list[Array]:
        """Where everything was during the last 10 s, each of shape (points, 3), in metres."""
        return [*(recent.points for recent in self._recent.values()), self._plates.corners]

    def _say_stopped(self, name: str, components: dict[str, LiveComponent], up: UpAxis) -> None:
        stopped = {key: each for key, each in components.items() if each.is_stopped}
        self._stopped.visible = bool(stopped)
        if not stopped:
            return
        expected = [key for key in _NAMES if key in components and components[key].age_s is not None]
        names = [_NAMES[key] for key in expected if key in stopped]
        what = " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
        if len(names) == len(expected):
            what = "data"
        age_s = max(each.age_s or 0.0 for each in stopped.values())
        duration = f"{age_s / 60:.0f} min" if age_s < 6000 else f"{age_s / 3600:.0f} h"
        if age_s < 100:
            duration = f"{age_s:.0f} s"
        self._stopped.text = f"{name}: no {what} for {duration}"
        # Above its own subject: between that and its plates, another source's subject may be.
        sphere = self.subject or sphere_around([self._plates.corners]) or Sphere((0.0, 0.0, 0.0), 0.0)
        above = on_floor(up, 0.0, 0.0, sphere.radius + _GAP_M * self._number)
        self._stopped.position = np.add(sphere.centre, above)


class ViewScene:
    """The picture of all sources. Everything is called in one thread, except what viser calls."""

    def __init__(self, server: viser.ViserServer, tabs: viser.GuiTabGroupHandle) -> None:
        self._server = server
        self._world = World(server)
        self._sources: dict[str, SourceScene] = {}  # by the beginning of their channels
        self._parameters: list[Parameters] = []
        self._cameras = Cameras()
        self._switches = Switches(server, tabs.add_tab("Scene"), self._cameras.fit_again)

    def update(self, sources: list[DisplayedSource], clients: dict[int, viser.ClientHandle]) -> None:
        """Show the newest data of the sources to the browsers."""
        now_s = time.monotonic()
        for source in sources:
            if source.channels not in self._sources:
                number = len(self._sources)
                switch = self._switches.add_source(source.name, color_of(number))
                self._sources[source.channels] = SourceScene(self._server.scene, source, number, switch)
        parameters = [source.newest_parameters for source in sources]
        if [*map(id, parameters)] != [*map(id, self._parameters)]:
            self._parameters = parameters
            self._switches.suggest_up(up_axis_of(parameters))
        if self._world.up != self._switches.up:
            self._world.set_up(self._switches.up)
        for source in sources:
            self._sources[source.channels].update(
                source,
                self._world.up,
                self._switches,
                now_s,
                axes_m=AXES_SHARE * self._cameras.distance_m,
                is_alone=len(sources) == 1,
            )
        has_plates = any(scene.has_plates for scene in self._sources.values())
        self._world.update(forces=has_plates, floor=self._switches.floor.value)
        shown = {
            name: scene
            for name, scene in self._sources.items()
            if scene.is_on and (scene.has_subject or scene.has_plates)
        }
        subject = Subject(self._world.up, tuple(shown), sum(scene.has_subject for scene in shown.values()))
        points = (part for scene in shown.values() for part in scene.points)
        self._cameras.update(clients, subject, lambda: points, now_s)

    def pause(self) -> None:
        """Hide the data while no browser is connected: the next one must not show old data first."""
        for scene in self._sources.values():
            scene.group.visible = False
