"""The picture: the world, and a group for each source."""

import time
from contextlib import suppress
from typing import Final

import viser

from gateway.live.live_data import LiveSource
from gateway.rtc3d.parameters import Parameters
from gateway.view.axes import up_axis_of
from gateway.view.camera import fit, sphere_around
from gateway.view.colors import color_of
from gateway.view.source_scene import SourceScene
from gateway.view.switches import Switches
from gateway.view.world import World

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
        self._world.show_floor(visible=self._switches.floor)

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
