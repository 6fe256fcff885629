"""The live view: what has arrived is shown about 30 times a second."""

import threading
import time
from collections.abc import Callable
from typing import Final

from gateway.live.live_data import LiveData
from gateway.view.panel import Panel
from gateway.view.scene import Scene
from gateway.view.server import ViewServer

PERIOD_S: Final = 1 / 30


class Viewer:
    """Shows the data of all sources to every browser that is connected."""

    def __init__(self, server: ViewServer, live: LiveData) -> None:
        self._server = server
        self._live = live
        tabs = server.gui.add_tab_group()
        self.panel = Panel(server, tabs, live)
        self.scene = Scene(server, tabs)

    def run(self, stop: threading.Event, tick: Callable[[], object]) -> None:
        """Show what arrives until ``stop``; call ``tick`` before each picture.

        The schedule is absolute, and pictures that are late are dropped. Without a browser, nothing is sent.
        """
        next_s = time.monotonic()
        while not stop.wait(max(0.0, next_s - time.monotonic())):
            tick()
            self.update()
            now_s = time.monotonic()
            next_s += PERIOD_S * max(1, -(-(now_s - next_s) // PERIOD_S))

    def update(self) -> None:
        """Decode what has arrived, and show it."""
        sources = self._live.update()
        clients = self._server.get_clients()
        with self._server.atomic():
            if not clients:
                self.scene.pause()
                return
            self.scene.update(sources, clients)
            self.panel.update(sources)
