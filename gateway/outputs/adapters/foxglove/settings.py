"""The section ``foxglove`` of the configuration, and the output in the registry."""

from collections.abc import Sequence
from typing import Annotated, Final

from pydantic import Field
from typing_extensions import override

from gateway.config.section import expects
from gateway.config.settings import ListenAddress, OutputSettings, SourceSettings
from gateway.config.values import Host, Port, Switch
from gateway.outputs.kind import OutputKind, imported_late
from gateway.outputs.listen_address import is_loopback
from gateway.outputs.open_ports import OpenPort, web_port

Origin = Annotated[
    str,
    Field(pattern=r"^https?://[A-Za-z0-9.:\[\]_-]{1,270}$"),
    expects("http:// or https:// and a name or address, with the port if it is another than 80 or 443"),
]


class FoxgloveSettings(OutputSettings):
    """The settings of the WebSocket server for Foxglove, Lichtblick and PlotJuggler."""

    enabled: Switch = False
    """Whether to serve viewers. This needs the extra `foxglove`."""

    host: Host = "127.0.0.1"
    """The address to listen on: one of this computer, or 0.0.0.0 or "::" for all. There is no password."""

    port: Port = 8765
    """The TCP port. Viewers connect to `ws://HOST:PORT`."""

    origins: Annotated[
        tuple[Origin, ...], expects("a list of the addresses of pages, such as http://viewer.lab:8080")
    ] = ()
    """Addresses of further pages with viewers. Those of Foxglove and of this computer may always connect."""

    @property
    @override
    def listens_on(self) -> Sequence[ListenAddress]:
        return [ListenAddress(("port",), self.host, self.port)]


def _open_ports(settings: FoxgloveSettings, _sources: Sequence[SourceSettings]) -> list[OpenPort]:
    return [web_port(settings.host, settings.port, "viewers watch everything", "foxglove.host")]


FOXGLOVE: Final = OutputKind(
    name="foxglove",
    settings=FoxgloveSettings,
    create=imported_late("gateway.outputs.adapters.foxglove.output:FoxgloveOutput", extra="foxglove"),
    checks=("package", "port"),
    run_checks=imported_late("gateway.outputs.adapters.foxglove.checks:check_foxglove"),
    leaves_host=lambda settings: not is_loopback(settings.host),
    open_ports=_open_ports,
)
