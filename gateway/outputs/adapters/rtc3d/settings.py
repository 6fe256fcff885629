"""The section ``rtc3d`` of the configuration, and the output in the registry."""

from collections.abc import Sequence
from typing import Annotated, Final, Self

from pydantic import Field, PlainSerializer, model_validator
from typing_extensions import override

from gateway.config.section import expects, validation_error, validation_errors
from gateway.config.settings import ListenAddress, OutputSettings, SourceSettings
from gateway.config.values import Host, Port, SourceName, Switch
from gateway.outputs.kind import OutputKind, imported_late
from gateway.outputs.listen_address import is_loopback
from gateway.outputs.open_ports import FIREWALL, Access, OpenPort, control_or

DEFAULT_MAX_CLIENTS: Final = 128


Ports = Annotated[
    dict[SourceName, Port],
    PlainSerializer(dict),
    expects("a port for each source that is served, as in {lab: 3120}"),
]
MaxClients = Annotated[
    int, Field(strict=True, ge=1, le=1000), expects("a whole number of clients from 1 to 1000")
]


class Rtc3dSettings(OutputSettings):
    """The settings of the output that serves RTC3D clients."""

    enabled: Switch = False
    """Whether RTC3D clients can connect to the gateway, and share its session with the server."""

    host: Host = "127.0.0.1"
    """The address to listen on: one of this host, or 0.0.0.0 or "::" for all."""

    ports: Ports = {}  # noqa: RUF012 - pydantic copies defaults
    """A TCP port for each source that is served: {NAME: PORT}."""

    max_clients: MaxClients = DEFAULT_MAX_CLIENTS
    """How many clients each source can have at the same time."""

    @property
    @override
    def listens_on(self) -> Sequence[ListenAddress]:
        return [ListenAddress(("ports", source), self.host, port) for source, port in self.ports.items()]

    @model_validator(mode="after")
    def _check_ports(self) -> Self:
        owners: dict[int, str] = {}
        mistakes: list[tuple[str, tuple[str | int, ...]]] = []
        for source, port in self.ports.items():
            if (owner := owners.setdefault(port, source)) != source:
                text = f"found {port}, which {owner} has too; expected another port for each source"
                mistakes.append((text, ("ports", source)))
        if mistakes:
            raise validation_errors(mistakes)
        if self.enabled and not self.ports:
            raise validation_error(
                "found nothing; expected a port for each source that is served, as in {lab: 3120}", "ports"
            )
        return self


def _open_ports(settings: Rtc3dSettings, sources: Sequence[SourceSettings]) -> list[OpenPort]:
    return [
        OpenPort(
            "tcp",
            settings.host,
            port,
            control_or(Access.READ, [source for source in sources if source.name == name]),
            f"RTC3D clients read everything of {name}",
            FIREWALL,
        )
        for name, port in settings.ports.items()
    ]


RTC3D: Final = OutputKind(
    name="rtc3d",
    settings=Rtc3dSettings,
    create=imported_late("gateway.outputs.adapters.rtc3d.output:Rtc3dOutput"),
    checks=("sources", "ports"),
    run_checks=imported_late("gateway.outputs.adapters.rtc3d.output:check_rtc3d"),
    leaves_host=lambda settings: not is_loopback(settings.host),
    open_ports=_open_ports,
)
