"""The picture: the world, and a group for each source."""

import time
from collections.abc import Iterable
from contextlib import suppress
from typing import Final
from urllib.parse import quote

import numpy as np
import viser

from gateway.display.live import LiveComponent, LiveSource
from gateway.display.view.laboratory import (
    Plates,
    Sphere,
    UpAxis,
    World,
    fit,
    on_floor,
    sphere_around,
    up_axis_of,
)
from gateway.display.view.markers_and_tools import Markers, Tools, color_of
from gateway.display.view.panel import Switches
from gateway.rtc3d.parameters import Parameters

_NAMES: Final = {"3d": "markers", "6d": "tools", "force": "forces", "analog": "analog data"}

_GAP_M: Final = 0.2
"""How much higher the label of each further source is that says that its data have stopped."""


class SourceScene:
    """The markers, tools, plates and forces of a source, in a group of their own.

    ``number`` is the source's: it has a colour of its own, and its labels are not where others have theirs.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        source: LiveSource,
        number: int,
        switch: viser.GuiCheckboxHandle,
    ) -> None:
        self._number = number
        color = color_of(number)
        self._name = source.name
        self._switch = switch
        scene = server.scene
        path = f"/sources/{quote(source.channels, safe='')}"
        self._group = scene.add_frame(path, show_axes=False)
        self._markers = Markers(scene, path, color)
        self._tools = Tools(scene, path)
        self._plates = Plates(scene, path, number)
        self._stopped = scene.add_label(
            f"{path}/stopped", "", visible=False, font_screen_scale=1.6, anchor="bottom-center"
        )

    def update(
        self, source: LiveSource, up: UpAxis, switches: Switches, now_s: float, *, is_alone: bool
    ) -> None:
        """Show the newest data of the source. If it is not alone, its labels begin with its name."""
        if source.name != self._name:  # on LCM, a status says the name
            self._name = source.name
            self._switch.label = source.name
        self._group.visible = self._switch.value
        if not self._group.visible:
            return
        components = {**source.components}
        prefix = "" if is_alone else f"{source.name}: "
        if "3d" in components:
            self._markers.update(
                components["3d"],
                now_s,
                prefix,
                labels=switches.marker_labels.value,
                trails=switches.trails.value,
            )
        if "6d" in components:
            self._tools.update(components["6d"], now_s, prefix, labels=switches.tool_labels.value)
        self._plates.update(components.get("force"), source.newest_parameters, up, now_s, prefix)
        self._say_stopped(source.name, components, up)

    def hide(self) -> None:
        """Hide everything until the next update."""
        self._group.visible = False

    @property
    def is_visible(self) -> bool:
        """Whether its switch is on."""
        return bool(self._group.visible)

    @property
    def has_subject(self) -> bool:
        """Whether markers or tools are in the picture."""
        return sphere_around([self._markers.positions, self._tools.positions]) is not None

    @property
    def has_plates(self) -> bool:
        """Whether force plates are shown."""
        return self.is_visible and len(self._plates.corners) > 0

    @property
    def points(self) -> list[np.ndarray]:
        """The positions of everything, each of shape (points, 3), in metres; NaN is missing."""
        return [self._markers.positions, self._tools.positions, self._plates.corners]

    def _say_stopped(self, name: str, components: dict[str, LiveComponent], up: UpAxis) -> None:
        stopped = {key: each for key, each in components.items() if each.is_stopped}
        self._stopped.visible = bool(stopped)
        if not stopped:
            return
        age_s = max(each.age_s or 0.0 for each in stopped.values())
        self._stopped.text = f"{name}: no {_what(stopped, components)} for {_duration(age_s)}"
        # Above its own subject: between that and its plates, another source's subject may be.
        sphere = sphere_around([self._markers.positions, self._tools.positions])
        sphere = sphere or sphere_around([self._plates.corners]) or Sphere((0.0, 0.0, 0.0), 0.0)
        above = on_floor(up, 0.0, 0.0, sphere.radius + _GAP_M * self._number)
        x, y, z = np.add(sphere.centre, above).tolist()
        self._stopped.position = (x, y, z)


def _what(stopped: Iterable[str], components: dict[str, LiveComponent]) -> str:
    """Return what does not come, such as "markers and forces"."""
    expected = [key for key in _NAMES if key in components]
    names = [_NAMES[key] for key in expected if key in stopped]
    if len(names) == len(expected):
        return "data"
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.0f} h"


_SETTLE_S: Final = 0.3
"""How long after the first data the view is fitted: other sources may come at the same time."""


class Scene:
    """The picture of all sources. Everything is called in one thread, except what viser calls."""

    def __init__(self, server: viser.ViserServer, tabs: viser.GuiTabGroupHandle) -> None:
        self._server = server
        self._world = World(server)
        self._sources: dict[str, SourceScene] = {}  # by the beginning of their channels
        self._parameters: list[Parameters] = []
        self._first_s: float | None = None
        """When the first data were shown."""
        self._has_plates = False
        self._has_subject = False
        """Whether markers or tools have been shown, and not only plates."""
        self._fitted: set[int] = set()
        """The browsers whose view has been fitted."""
        self._switches = Switches(
            server, tabs.add_tab("Scene"), lambda client: self._fitted.discard(client.client_id)
        )

    def update(self, sources: list[LiveSource], clients: dict[int, viser.ClientHandle]) -> None:
        """Show the newest data of the sources to the browsers."""
        now_s = time.monotonic()
        for source in sources:
            if source.channels not in self._sources:
                number = len(self._sources)
                switch = self._switches.add_source(source.name, color_of(number))
                self._sources[source.channels] = SourceScene(self._server, source, number, switch)
        self._turn(sources)
        for source in sources:
            self._sources[source.channels].update(
                source, self._world.up, self._switches, now_s, is_alone=len(sources) == 1
            )
        self._has_plates = any(scene.has_plates for scene in self._sources.values())
        self._world.show_scale(forces=self._has_plates)
        self._fit(clients, now_s)

    def pause(self) -> None:
        """Hide the data while no browser is connected: the next one must not show old data first."""
        for scene in self._sources.values():
            scene.hide()

    def _turn(self, sources: list[LiveSource]) -> None:
        """Turn the picture as chosen, or as the plates lie."""
        parameters = [source.newest_parameters for source in sources]
        if [*map(id, parameters)] != [*map(id, self._parameters)]:
            self._parameters = parameters
            found = up_axis_of(parameters)
            if found is not None:
                self._switches.suggest_up(found)
        if self._world.up != self._switches.up:
            self._world.set_up(self._switches.up)
            self._fitted.clear()
        self._world.show_floor(visible=self._switches.floor.value)

    def _fit(self, clients: dict[int, viser.ClientHandle], now_s: float) -> None:
        """Fit the view of browsers that are new, or want it; of all when the first markers or tools come."""
        if not self._has_subject and any(scene.has_subject for scene in self._sources.values()):
            self._has_subject = True
            self._first_s = now_s
            self._fitted.clear()
        self._fitted &= clients.keys()
        waiting = [client for number, client in clients.items() if number not in self._fitted]
        if not waiting:
            return
        points = [part for scene in self._sources.values() if scene.is_visible for part in scene.points]
        if points and self._has_plates:
            points.append(self._world.mark)  # it says the scale of the arrows
        sphere = sphere_around(points)
        if sphere is None:
            return
        self._first_s = now_s if self._first_s is None else self._first_s
        if now_s - self._first_s < _SETTLE_S:
            return
        for client in waiting:
            self._fitted.add(client.client_id)
            with suppress(ValueError):
                fit(client, sphere, self._world.up)
