"""The section ``vrpn`` of the configuration, and the output in the registry."""

from collections.abc import Sequence
from typing import Annotated, Final

from typing_extensions import override

from gateway.config.section import expects
from gateway.config.settings import ListenAddress, OutputSettings, SourceSettings
from gateway.config.values import Host, Port, Switch
from gateway.outputs.adapters.vrpn.trackers import TrackerNames
from gateway.outputs.kind import OutputKind, imported_late
from gateway.outputs.listen_address import is_loopback
from gateway.outputs.open_ports import FIREWALL, Access, OpenPort

DEFAULT_VRPN_PORT: Final = 3883


class VrpnSettings(OutputSettings):
    """The settings of the VRPN server."""

    enabled: Switch = False
    """Whether to serve the tools as VRPN trackers."""

    host: Host = "127.0.0.1"
    """The address to listen on: one of this host, or 0.0.0.0 for all. There is no password."""

    port: Port = DEFAULT_VRPN_PORT
    """The port, for TCP and UDP."""

    tracker_names: Annotated[TrackerNames, expects("auto, tool or source/tool")] = "auto"
    """The names of trackers: tool, source/tool, or auto for tool if there is only one source."""

    @property
    @override
    def listens_on(self) -> Sequence[ListenAddress]:
        return [ListenAddress(("port",), self.host, self.port)]


def _open_ports(settings: VrpnSettings, _sources: Sequence[SourceSettings]) -> list[OpenPort]:
    purposes = {"tcp": "clients read poses", "udp": "clients ask to be connected to, and then read poses"}
    return [
        OpenPort(protocol, settings.host, settings.port, Access.READ, purpose, FIREWALL)
        for protocol, purpose in purposes.items()
    ]


VRPN: Final = OutputKind(
    name="vrpn",
    settings=VrpnSettings,
    create=imported_late("gateway.outputs.adapters.vrpn.output:VrpnOutput"),
    checks=("port", "access"),
    run_checks=imported_late("gateway.outputs.adapters.vrpn.output:check_vrpn"),
    leaves_host=lambda settings: not is_loopback(settings.host),
    open_ports=_open_ports,
)
