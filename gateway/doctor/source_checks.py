"""Looks at one source: its name, TCP, the protocol, parameters, frames, their rate, markers in view."""

import asyncio
import ipaddress
import socket
from collections.abc import AsyncIterator
from typing import Final

from gateway.config.settings import SourceSettings
from gateway.doctor.finding import Finding, Patient
from gateway.doctor.frame_findings import VISIBLE, frames_finding, rate_finding, visibility_finding
from gateway.doctor.observation import StreamWatch
from gateway.errors import ConnectError, LinkError, PacketError
from gateway.rtc3d.parameters import Parameters
from gateway.stream.state import StreamInput

CHECKS: Final = ("name", "TCP", "protocol", "parameters", "frames", "rate", "visibility")
"""The layers, each of which needs those before it."""

_PORTS: Final = "3020 is First Principles, 3030 WaveFront"


class SourceExamination:
    """One source under examination; the streams that it saw are in ``watches`` afterwards."""

    def __init__(self, source: SourceSettings, seconds: float) -> None:
        self._source = source
        self._seconds = seconds
        self._patient = Patient(source.name)
        self._server = f"{source.host}:{source.port}"
        self.watches: list[StreamWatch] = []

    async def findings(self) -> AsyncIterator[Finding]:
        """Yield what is found, layer by layer; what needs a layer that is red is not tested."""
        checks = list(CHECKS)
        for look in (self._name, self._tcp, self._protocol):
            finding = await look()
            yield finding
            checks.remove(finding.check)
            if finding.remedy:
                for check in checks:
                    yield self._patient.untested(check, f"it needs {finding.check}, which failed")
                break
        else:
            yield self._parameters()
            await asyncio.sleep(self._seconds)
            for watch in self.watches:
                yield frames_finding(self._patient, watch, self._announced)
                yield rate_finding(self._patient, watch, self._announced)
                if VISIBLE.intersection(watch.stream.components):
                    yield visibility_finding(self._patient, watch, self._announced)
        await asyncio.gather(*(watch.session.close() for watch in self.watches))

    @property
    def _announced(self) -> Parameters | None:
        parsed = next((watch.parsed for watch in self.watches if watch.parsed is not None), None)
        return None if parsed is None else parsed.parameters

    async def _name(self) -> Finding:
        host = self._source.host
        try:
            ipaddress.ip_address(host)
        except ValueError:
            pass
        else:
            return self._patient.good("name", f"{host} is an address")
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(self._source.connect_timeout_s):
                found = await loop.getaddrinfo(host, self._source.port, type=socket.SOCK_STREAM)
        except OSError as error:  # TimeoutError is one, without a text
            reason = error.strerror or f"no answer within {self._source.connect_timeout_s:g} s"
            return self._patient.bad(
                "name",
                f"the host name {host!r} is not known: {reason}",
                "Correct the source's host, or add the name to DNS or /etc/hosts; an address needs neither.",
            )
        addresses = dict.fromkeys(str(address[0]) for *_, address in found)
        return self._patient.good("name", f"{host} is {', '.join(addresses)}")

    async def _tcp(self) -> Finding:
        self.watches = [StreamWatch(self._source, stream) for stream in self._source.streams]
        try:
            for watch in self.watches:
                await watch.session.connect()
        except ConnectError as error:
            found, _, question = str(error).partition("; ")
            return self._patient.bad("TCP", found, f"{question[:1].upper()}{question[1:]}")
        count = len(self.watches)
        connections = "a connection" if count == 1 else f"{count} connections, one per stream"
        return self._patient.good("TCP", f"{self._server} accepts {connections}")

    async def _protocol(self) -> Finding:
        for watch in self.watches:
            try:
                await watch.negotiation.start()
            except LinkError as error:
                return self._no_protocol(error)
            watch.status.move(StreamInput.READY, self._server)
            if not watch.status.bytes_in:
                return self._patient.bad(
                    "protocol",
                    f"{self._server} accepts a connection and then says nothing",
                    f"Point host and port at the RT server ({_PORTS}); if they are right, restart it.",
                )
        refused = list(dict.fromkeys(text for watch in self.watches for text in watch.status.limitations))
        if not refused:
            return self._patient.good("protocol", "the server answers every command")
        return self._patient.good(
            "protocol", f"the server is an RT server; the gateway does without this: {'; '.join(refused)}"
        )

    def _no_protocol(self, error: LinkError) -> Finding:
        text = str(error)
        if isinstance(error.__cause__, PacketError):
            begin = error.__cause__.begin.decode("latin-1")
            words = "".join(letter if letter.isprintable() else "·" for letter in begin)
            return self._patient.bad(
                "protocol",
                f"what answers at {self._server} is no RT server; it begins with {words!r}",
                f"Point host and port at the RT server: {_PORTS}.",
            )
        if "refuses to stream" in text:
            return self._patient.bad(
                "protocol",
                f"{self._server} refuses to stream in every form that the protocol has",
                "Switch on the real-time output in the server's settings.",
            )
        return self._patient.bad(
            "protocol",
            text,
            "Is this the RT server's port, and does it take one more client? End other programs that are "
            f"connected, and look into the server's own messages ({_PORTS}).",
        )

    def _parameters(self) -> Finding:
        [first, *_] = self.watches
        if first.parsed is not None:
            repaired = f" (repaired: {first.parsed.recovered[0]})" if first.parsed.recovered else ""
            return self._patient.good("parameters", _told(first.parsed.parameters) + repaired)
        reasons = [text for text in first.status.limitations if "SendParameters" in text]
        if reasons:
            return self._patient.untested(
                "parameters", f"{reasons[0]}; names, units and announced rates are unknown"
            )
        unread = [text for text in first.status.limitations if text.startswith("no parameters: ")]
        return self._patient.bad(
            "parameters",
            f"the server's XML cannot be read: {unread[0].removeprefix('no parameters: ')}",
            "The gateway streams without names and units. Look for odd characters in the names of markers "
            "and tools on the server, or update its software.",
        )


def _told(parameters: Parameters) -> str:
    """Return what the server announces, in a few words."""
    parts = []
    if parameters.markers is not None:
        parts.append(_count(len(parameters.markers.markers), "marker"))
    if parameters.tools is not None:
        parts.append(_count(len(parameters.tools.tools), "tool"))
    if parameters.analog is not None:
        parts.append(_count(len(parameters.analog.channels), "analog channel"))
    if parameters.force is not None:
        parts.append(_count(len(parameters.force.plates), "force plate"))
    if parameters.events is not None:
        parts.append(_count(len(parameters.events.events), "kind") + " of events")
    return ", ".join(parts) or "the server announces nothing"


def _count(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
