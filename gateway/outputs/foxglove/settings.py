"""The section ``foxglove`` of the configuration."""

from collections.abc import Sequence

from gateway.config.settings import ListenAddress, OutputSettings
from gateway.config.values import Host, Port, Switch


class FoxgloveSettings(OutputSettings):
    """The settings of the WebSocket server for Foxglove, Lichtblick and PlotJuggler."""

    enabled: Switch = False
    """Whether to serve viewers. This needs the extra `foxglove`."""

    host: Host = "127.0.0.1"
    """The address to listen on: one of this computer, or 0.0.0.0 or "::" for all. There is no password."""

    port: Port = 8765
    """The TCP port. Viewers connect to `ws://HOST:PORT`."""

    @property
    def listens_on(self) -> Sequence[ListenAddress]:
        """See OutputSettings."""
        return [ListenAddress(("port",), self.host, self.port)]
