"""Checks of one source: host name, TCP, protocol, parameters, frames, byte order, rate and so on."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterable, Iterator
from functools import partial
from itertools import chain
from typing import Final

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import ConnectError, LinkError, PacketError
from gateway.messages.descriptions.source_frame import source_frame, unknown_unit_text
from gateway.messages.summary import described_items
from gateway.outputs.findings import Check, Finding, MessageLoad, Result, as_sentence, failing_first
from gateway.rtc3d.packets import FIRST_PRINCIPLES_PORT, WAVEFRONT_PORT
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.safe_text import quoted
from gateway.session.tcp import is_address, look_up, open_connection
from gateway.tools.doctor.frame_checks import (
    check_byte_order,
    check_frames,
    check_rate,
    check_receive_buffer,
    check_visibility,
)
from gateway.tools.doctor.observation import COMPONENTS_WITH_VISIBILITY, ObservedStream

CHECKS: Final = (
    "name",
    "TCP",
    "protocol",
    "parameters",
    "frames",
    "byte order",
    "rate",
    "buffer",
    "visibility",
)
"""The checks in order. If one of the first three fails, those after it are not made."""

CONNECTION: Final = "connection"
"""The check that announces a second connection to a server."""

USUAL_PORTS: Final = (FIRST_PRINCIPLES_PORT, WAVEFRONT_PORT)
_PORTS: Final = f"{FIRST_PRINCIPLES_PORT} is First Principles, {WAVEFRONT_PORT} WaveFront"


class SourceChecks:
    """Runs the checks of one source, once. Create it in a running event loop.

    ``connected`` are the servers, as HOST:PORT, to which the running gateway is connected.
    """

    def __init__(self, source: SourceSettings, seconds: float, connected: Iterable[str] = ()) -> None:
        self._source = source
        self._seconds = seconds
        self._server = f"{source.host}:{source.port}"
        self._connected = connected
        self._addresses: frozenset[str] = frozenset()  # of the source's host, as far as they are known
        self._streams: list[ObservedStream] = []

    @property
    def message_loads(self) -> list[MessageLoad]:
        """The messages that the gateway would publish, one entry per observed component."""
        return [component.message_load for stream in self._streams for component in stream.observed.values()]

    async def run(self) -> AsyncIterator[Finding]:
        """Run the checks in order, yield their findings, and close the connections."""
        for number, check in enumerate((self._check_name, self._check_tcp, self._check_protocol), start=1):
            if check == self._check_tcp and await self._gateway_is_connected():
                yield self._check(CONNECTION).note(  # field note 21
                    f"the running gateway is connected to {self._server}; doctor now opens further "
                    "connections to it",
                    "Some servers serve one client only, or fail with two. With --no-connect, doctor asks "
                    "the running gateway instead.",
                )
            finding = await check()
            if finding.result is Result.FAILING:
                for each in failing_first(finding, CHECKS[number:]):
                    yield each
                break
            yield finding
        else:
            yield self._check_parameters()
            await asyncio.sleep(self._seconds)
            for finding in chain.from_iterable(map(self._check_stream, self._streams)):
                yield finding
        await asyncio.gather(*(stream.session.close() for stream in self._streams))

    async def run_without_connecting(self) -> AsyncIterator[Finding]:
        """Check the host name, and yield for each other check that it is not made."""
        yield await self._check_name()
        for name in CHECKS[1:]:
            yield self._check(name).not_tested("--no-connect")

    def _check_stream(self, stream: ObservedStream) -> Iterator[Finding]:
        components = stream.component_keys if len(self._streams) > 1 else ""
        check = partial(Check, self._source.name, stream=components)
        others_receive = any(other.observed for other in self._streams if other is not stream)
        yield check_frames(check("frames"), stream, self._parameters, others_receive=others_receive)
        yield check_byte_order(check("byte order"), stream, self._source.byte_order)
        yield check_rate(check("rate"), stream, self._parameters)
        yield check_receive_buffer(check("buffer"), stream.load_bytes_per_s)
        if set(COMPONENTS_WITH_VISIBILITY).intersection(stream.settings.components):
            yield check_visibility(check("visibility"), stream, self._parameters)

    def _check(self, name: str) -> Check:
        return Check(self._source.name, name)

    async def _gateway_is_connected(self) -> bool:
        """Return whether the running gateway is connected to this server, perhaps by another host name."""
        servers = [server.rpartition(":") for server in self._connected]
        hosts = {host for host, _, port in servers if port == str(self._source.port)}
        if self._source.host in hosts:
            return True
        for host in hosts:
            with contextlib.suppress(OSError):
                if self._addresses & await self._resolve(host):
                    return True
        return False

    @property
    def _parameters(self) -> Parameters | None:
        """The parameters that the first stream with any received."""
        return next((stream.parsed.parameters for stream in self._streams if stream.parsed is not None), None)

    async def _check_name(self) -> Finding:
        host = self._source.host
        if is_address(host):
            self._addresses = frozenset([host])
            return self._check("name").passing(f"{host} is an IP address")
        try:
            self._addresses = await self._resolve(host)
        except OSError as error:  # includes TimeoutError, which has no text
            reason = error.strerror or f"no answer within {self._source.connect_timeout_s:g} s"
            return self._check("name").failing(
                f"the host name {host!r} cannot be resolved: {reason}",
                "Correct the source's host, add the name to DNS or /etc/hosts, or use an IP address.",
            )
        return self._check("name").passing(f"{host} resolves to {', '.join(sorted(self._addresses))}")

    async def _resolve(self, host: str) -> frozenset[str]:
        """Return the addresses of ``host``; raises OSError, of which TimeoutError has no text."""
        async with asyncio.timeout(self._source.connect_timeout_s):
            return frozenset(await look_up(host))

    async def _check_tcp(self) -> Finding:
        if self._source.streams == "auto":
            self._streams = [ObservedStream(self._source, StreamSettings(), plans=True)]
        else:
            self._streams = [ObservedStream(self._source, stream) for stream in self._source.streams]
        try:
            for stream in self._streams:
                await stream.session.connect()
        except ConnectError as error:
            found, _, question = str(error).partition("; ")
            remedy = f"{question[:1].upper()}{question[1:]}"
            if isinstance(error.__cause__, ConnectionRefusedError):
                remedy += await self._other_ports()
            return self._check("TCP").failing(found, remedy)
        count = len(self._streams)
        connections = "a connection" if count == 1 else f"{count} connections, one per stream"
        return self._check("TCP").passing(f"{self._server} accepts {connections}")

    async def _other_ports(self) -> str:
        """Return a sentence about the usual ports that accept a connection, because this one refuses."""
        open_ports = []
        for port in USUAL_PORTS:
            if port != self._source.port:
                with contextlib.suppress(ConnectError):
                    other = self._source.model_copy(update={"port": port})
                    (await open_connection(other, asyncio.Protocol())).abort()
                    open_ports.append(str(port))
        if not open_ports:
            return ""
        if len(open_ports) == 1:
            return f" Port {open_ports[0]} of {self._source.host} accepts connections ({_PORTS})."
        return f" Ports {' and '.join(open_ports)} of {self._source.host} accept connections ({_PORTS})."

    async def _check_protocol(self) -> Finding:
        for stream in self._streams:
            try:
                await stream.control.start()
            except LinkError as error:
                return self._protocol_failure(stream, error)
        if self._source.streams == "auto":
            await self._open_further_streams(self._streams[0])
        check = self._check("protocol")
        limitations = dict.fromkeys(text for stream in self._streams for text in stream.status.limitations)
        if not limitations:
            return check.passing("the server accepts every command")
        return check.passing(
            f"the server is an RT server; the gateway works around this: {'; '.join(limitations)}"
        )

    async def _open_further_streams(self, first: ObservedStream) -> None:
        """Open a connection for each faster rate, as the gateway does."""
        for group in first.plan.groups[1:]:
            stream = ObservedStream(self._source, StreamSettings(components=group))
            try:
                await stream.session.connect()
                await stream.control.start()
            except LinkError as error:
                await stream.session.close()
                reason = str(error).partition("; ")[0]
                await first.use_one_connection(f"the server accepts one connection only ({reason})")
                return
            self._streams.append(stream)

    def _protocol_failure(self, stream: ObservedStream, error: LinkError) -> Finding:
        if isinstance(error.__cause__, PacketError):
            first_bytes = quoted(error.__cause__.first_bytes.decode("latin-1"), 60)
            found = f"the program at {self._server} is not an RT server; its first bytes are {first_bytes}"
            remedy = f"Correct the source's host and port: {_PORTS}."
        elif stream.session.is_open and not stream.status.bytes_in:
            found = f"{self._server} accepts a connection but sends nothing"
            remedy = (
                f"Correct the source's host and port ({_PORTS}). If they are correct, restart the RT server."
            )
        elif stream.session.is_open:  # only the refusal of StreamFrames leaves it open
            found = f"{self._server} refuses every form of the StreamFrames command"
            remedy = "Enable the real-time output in the server's settings."
        else:
            found = str(error)
            remedy = (
                f"Check that this is the RT server's port ({_PORTS}) and that the server accepts one more "
                "client. Close other programs that are connected to it, and read the server's own messages."
            )
        return self._check("protocol").failing(found, remedy)

    def _check_parameters(self) -> Finding:
        first, check = self._streams[0], self._check("parameters")
        if first.parsed is not None:
            parameters = first.parsed.parameters
            found = described_items(parameters, event="event type") or "the server's parameters are empty"
            found += f" (repaired: {first.parsed.recovered[0]})" if first.parsed.recovered else ""
            if source_frame(self._source, parameters).metres_per_unit is None:
                problem, _, remedy = unknown_unit_text(parameters, "positions in metres").partition("; ")
                return check.warning(f"{found}; {problem}", as_sentence(remedy))
            return check.passing(found)
        refusals = [text for text in first.status.limitations if "SendParameters" in text]
        if refusals:
            return check.not_tested(f"{refusals[0]}; names, units and configured rates are unknown")
        prefix = "no parameters: "
        reasons = [text for text in first.status.limitations if text.startswith(prefix)]
        return check.failing(
            f"the server's XML cannot be read: {reasons[0].removeprefix(prefix)}",
            "The gateway publishes data without names and units. Look for unusual characters in the names of "
            "markers and tools on the server, or update the server's software.",
        )
