"""The panel beside the picture."""

import viser

from gateway.live.live_data import LiveData, LiveSource


class Panel:
    """The tabs of the panel."""

    def __init__(self, server: viser.ViserServer, tabs: viser.GuiTabGroupHandle, live: LiveData) -> None:
        self._server = server
        self._tabs = tabs
        self._live = live

    def update(self, sources: list[LiveSource]) -> None:
        """Show the sources as they are now."""
