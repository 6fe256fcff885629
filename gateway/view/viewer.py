"""The view: what has arrived, live or from a take, is shown about 30 times a second."""

import sys
import time
from collections.abc import Callable
from typing import Final

from gateway.errors import GatewayError
from gateway.live.live_data import LiveData
from gateway.safe_text import safe_text
from gateway.view.panel import Panel
from gateway.view.playback import Playback
from gateway.view.scene import Scene
from gateway.view.server import ViewServer

PERIOD_S: Final = 1 / 30


class Viewer:
    """Shows the data of all sources, or of a take, to every browser that is connected."""

    def __init__(self, server: ViewServer, live: LiveData, playback: Playback | None = None) -> None:
        self._server = server
        self._live = live
        self._playback = playback
        if playback is not None:
            playback.add_controls(server.gui)
        tabs = server.gui.add_tab_group()
        self.panel = Panel(server, tabs, live, is_take=playback is not None)
        self.scene = Scene(server, tabs)
        self.num_defects = 0
        """How many pictures were not complete, because of a defect in this program."""

    def run(self, stops_within: Callable[[float], bool], tick: Callable[[], object]) -> None:
        """Show what arrives until ``stops_within``, which waits for some seconds, returns True.

        ``tick`` is called before each picture. The schedule is absolute, and pictures that are late are
        dropped. Without a browser, nothing is sent.
        """
        next_s = time.monotonic()
        while not stops_within(max(0.0, next_s - time.monotonic())):
            tick()
            self._update_or_report()
            now_s = time.monotonic()
            next_s += PERIOD_S * max(1, -(-(now_s - next_s) // PERIOD_S))

    def _update_or_report(self) -> None:
        """Show what has arrived. A defect, or what a page should not send, does not end the view."""
        try:
            self.update()
        except GatewayError:
            raise
        except Exception as defect:  # noqa: BLE001 - the next picture may be whole
            if self.num_defects == 0:
                text = f"defect in rtc3d-gateway view: {type(defect).__name__}: {defect}; report this"
                print(safe_text(text), file=sys.stderr, flush=True)
            self.num_defects += 1

    def update(self) -> None:
        """Decode what has arrived, and show it. Raises what ended the playback of a take."""
        clients = self._server.get_clients()
        if clients and self._playback is not None:
            self._playback.start()  # not before: a short take would be over
        is_paused = self._playback is not None and self._playback.is_paused
        if is_paused:
            self._live.hold()
        sources = self._live.update()
        if clients:
            with self._server.atomic():
                self.scene.update(sources, clients)
        else:
            self.scene.pause()
        self.panel.update(sources, is_paused=is_paused)
        if self._playback is not None:
            self._playback.update()
