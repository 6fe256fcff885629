"""``rtc3d-gateway doctor --exposure``: every port of a configuration, who can reach it, and what protects it.

It reads the configuration, this computer's network interfaces and the kernel's tables of sockets, and
connects to nothing. Firewalls and other programs, such as Zenoh routers, are not looked at.
"""

import json
from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

from gateway.config.settings import Settings
from gateway.outputs.findings import Check, Finding, Result
from gateway.outputs.open_ports import Access, OpenPort, web_port
from gateway.outputs.registry import OUTPUTS
from gateway.runtime.safe_text import safe_json
from gateway.tools.doctor.reach import Reach, interface_names, ports_in_use, reach_of

VIEW_PORT: Final = 8080


class ExposedPort(NamedTuple):
    """A port of ``subject``, who can reach it, and whether a program of this computer listens on it now.

    ``is_in_use`` is None if the number of the port is not known.
    """

    subject: str
    port: OpenPort
    reach: Reach
    reach_text: str
    is_in_use: bool | None

    @property
    def result(self) -> Result:
        """FAILING if others can control recordings without showing who they are, WARNING if they can read."""
        port = self.port
        if self.reach is Reach.THIS_COMPUTER or port.access is Access.NOTHING or port.authentication:
            return Result.PASSING
        return Result.FAILING if port.access is Access.CONTROL else Result.WARNING

    @property
    def finding(self) -> Finding:
        """The line of the report."""
        port, result = self.port, self.result
        check = Check(self.subject, f"{port.protocol} {port.port or 'any'}")
        state = {True: "open now", False: "not open now", None: "a new port at each start"}[self.is_in_use]
        found = f"{port.host} ({state}): {self.reach_text}; {port.purpose}"
        if port.access is Access.CONTROL:
            found += "; they can start and stop recordings and takes"
        if port.access is not Access.NOTHING:
            found += f"; {port.encryption or 'no encryption'}, {port.authentication or 'no password'}"
        remedy = "" if result is Result.PASSING else port.remedy
        return Finding(check.subject, check.name, result, found, remedy)

    @property
    def as_dict(self) -> dict[str, Any]:
        """The port in the JSON."""
        port = {"output": self.subject, **self.port._asdict(), "access": self.port.access.value}
        return port | {"reach": self.reach.value, "is_open": self.is_in_use, "result": self.result.value}


def exposed_ports(settings: Settings, view: tuple[str, int] | None = None) -> Iterator[ExposedPort]:
    """Yield the ports of the gateway with these settings, and that of ``view`` at this host and port.

    Raises ConfigError if Zenoh does not accept its configuration. Blocks while host names are looked up.
    """
    interfaces, used = interface_names(), ports_in_use()
    ports = []
    if settings.metrics.enabled:
        host, number = settings.metrics.host, settings.metrics.port
        ports.append(("metrics", web_port(host, number, "/metrics and /healthz", "metrics.host")))
    for name, section in settings.outputs.items():
        if section.enabled:
            ports += [(name, port) for port in OUTPUTS[name].open_ports(section, settings.sources)]
    if view is not None:
        ports.append(("view", web_port(*view, "browsers watch everything", "--host of view")))
    for subject, port in ports:
        is_in_use = (port.protocol, port.port) in used if port.port else None
        yield ExposedPort(subject, port, *reach_of(port, interfaces), is_in_use)


def exposure_findings(settings: Settings, ports: Sequence[ExposedPort]) -> Iterator[Finding]:
    """Yield a finding for each port, and one for each output without any."""
    yield from (port.finding for port in ports)
    subjects = {port.subject for port in ports}
    for name, section in settings.outputs.items():
        if section.enabled and name not in subjects:
            yield Check(name, "ports").passing("opens no port")


def exposure_json(ports: Sequence[ExposedPort]) -> str:
    """Return a JSON object: ok, and ports with what is known about each."""
    is_ok = all(port.result is not Result.FAILING for port in ports)
    content = {"ok": is_ok, "ports": [port.as_dict for port in ports]}
    return safe_json(json.dumps(content, indent=2, ensure_ascii=False))
