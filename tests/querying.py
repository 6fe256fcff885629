"""Asking a whole gateway: a server with parameters, gateways on real Zenoh and LCM, and those who ask."""

import asyncio
import json
import struct
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from gateway.config.settings import (
    MetricsSettings,
    ReconnectSettings,
    SourceSettings,
    SpoolSettings,
)
from gateway.gateway import Gateway
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.rtc3d.commands import SendParameters, parse_command
from gateway.rtc3d.parameters import SECTIONS
from tests.configurations import make_settings
from tests.networks import free_endpoint, free_port, open_zenoh, zenoh_keys
from tests.servers import Client, ScriptedServer, error, markers_frame, ok, packet
from tests.spec_parameters import in_root, spec_xml
from tests.waiting import wait_until_async

FRAME = markers_frame(7, (1.0, 2.0, 3.0))


class LabServer:
    """A server to script: what it says of its parameters, what it refuses, what it does not answer.

    It sends one frame after StreamFrames, or No Data with ``measures`` off.
    """

    def __init__(self, marker: str = "Marker 1") -> None:
        self.commands: list[str] = []
        self.received: list[bytes] = []
        """Bodies of packets that are no commands, each behind its type."""
        self.xml = parameters_of(marker)
        self.sections = {section: spec_xml(section) for section in SECTIONS}
        """Answers to questions about one section; ``xml`` answers all others."""
        self.refused: tuple[str, ...] = ()
        """What the commands begin with that get an error."""
        self.silent: tuple[str, ...] = ()
        self.measures = True
        self.client: Client | None = None
        self.open = asyncio.Event()
        """Answers wait until it is set."""
        self.open.set()

    async def script(self, client: Client) -> None:
        self.client = client
        while True:
            size, packet_type = struct.unpack(">II", await client._reader.readexactly(8))
            body = await client._reader.readexactly(size - 8)
            if packet_type != 1:
                self.received.append(struct.pack(">II", size, packet_type) + body)
                continue
            command = body.decode("ascii")
            self.commands.append(command)
            if command == "Bye":
                return
            await self.open.wait()
            reply = self.answer(command)
            if reply is not None:
                client.send(reply)

    def answer(self, command: str) -> bytes | None:
        if command.startswith(self.silent):
            return None
        if command.startswith(self.refused):
            return error("err-unknown command")
        parsed = parse_command(command.encode())
        if isinstance(parsed, SendParameters):
            return packet(2, self.sections.get(" ".join(parsed.sections), self.xml))
        frame = FRAME if self.measures else packet(4)
        if command.startswith("SendCurrentFrame"):
            return frame
        return ok(f"OK-{command}") + (frame if command.startswith("StreamFrames") else b"")

    def count(self, command: str) -> int:
        """Return how many commands came that begin so."""
        return sum(each.startswith(command) for each in self.commands)

    def send(self, data: bytes) -> None:
        assert self.client is not None
        self.client.send(data)


def parameters_of(*markers: str) -> bytes:
    """Return the XML of all sections with markers of these labels."""
    labels = "".join(
        f"<Marker id='{n}'><Label>{label}</Label></Marker>" for n, label in enumerate(markers, 1)
    )
    return in_root(
        "<General><Server><Name>RT</Name><Stats><FramesSent>1</FramesSent></Stats></Server></General>",
        f"<The_3D><Frequency>100</Frequency><Unit>mm</Unit><Markers>{labels}</Markers></The_3D>",
        "<The_6D><Tools/></The_6D><Analog><Channels/></Analog><Force><Plates/></Force><Events/>",
    )


@asynccontextmanager
async def gateway_at(
    port: int,
    *,
    listen: str | None = None,
    router: str | None = None,
    lcm_url: str | None = None,
    queries_url: str | None = None,
    spool: Path | None = None,
    **source: Any,
) -> AsyncIterator[Gateway]:
    """Run a gateway of the source "lab", whose server is at ``port`` of this machine.

    It is on Zenoh as a peer that listens at an endpoint or as a client of a router, or on LCM, or on
    both. ``source`` has other settings of the source.
    """
    defaults: dict[str, Any] = {
        "name": "lab",
        "host": "127.0.0.1",
        "port": port,
        "reconnect": ReconnectSettings(first_delay_s=0.01, max_delay_s=0.05),
        "reply_timeout_s": 5.0,
        "query_timeout_s": 10.0,
        "stall_timeout_s": 60.0,
    }
    # An interval of 0 cannot be configured: here every fresh question is one.
    lab = SourceSettings(**(defaults | source)).model_copy(
        update={} if "fresh_interval_s" in source else {"fresh_interval_s": 0.0}
    )
    keys = zenoh_keys("client", connect=router) if router else zenoh_keys("peer", listen=listen)
    settings = make_settings(
        sources=(lab,),
        zenoh=ZenohSettings(enabled=bool(listen or router), config=keys),
        lcm=LcmSettings(enabled=lcm_url is not None, url=lcm_url, queries_url=queries_url),
        spool=SpoolSettings(directory=None if spool is None else str(spool)),
        metrics=MetricsSettings(enabled=False),
    )
    gateway = Gateway(settings)
    stop = asyncio.Event()
    task = asyncio.create_task(gateway.run(stop))
    try:
        yield gateway
    finally:
        stop.set()
        async with asyncio.timeout(20):
            await task


def queries_of(gateway: Gateway) -> Any:
    """Return the object that answers queries on the gateway's only output."""
    queries = [queries for output in gateway.outputs if (queries := getattr(output, "_queries", None))]
    [only] = queries
    return only


async def is_filled(gateway: Gateway, server: LabServer) -> None:
    """Wait until the gateway has asked for all parameters and each section of them."""
    await wait_until_async(lambda: server.count("SendParameters") >= 7)
    [source] = gateway.sources
    await wait_until_async(lambda: not source._tasks)


class Reply(NamedTuple):
    """What one get brought: data with its encoding and attachment, or an error and its code."""

    key: str
    payload: bytes
    encoding: str
    attachment: dict[str, Any]
    error: str = ""
    code: str = ""

    @property
    def json(self) -> Any:
        return json.loads(self.payload)


@contextmanager
def asker_at(endpoint: str) -> Iterator[zenoh.Session]:
    """Give a session that is a client of the endpoint."""
    session = open_zenoh("client", connect=endpoint)
    try:
        yield session
    finally:
        session.close()


def reply_of(reply: zenoh.Reply) -> Reply:
    if reply.ok is None:
        assert reply.err is not None
        _, _, code = str(reply.err.encoding).partition(";")
        return Reply("", b"", str(reply.err.encoding), {}, reply.err.payload.to_string(), code)
    sample = reply.ok
    attachment = {} if sample.attachment is None else json.loads(sample.attachment.to_bytes())
    return Reply(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding), attachment)


async def ask_all(session: zenoh.Session, selector: str) -> list[Reply]:
    """Return all replies to a get."""
    replies = await asyncio.to_thread(lambda: list(session.get(selector, timeout=20)))
    return [reply_of(reply) for reply in replies]


async def ask(session: zenoh.Session, selector: str) -> Reply:
    """Return the one reply to a get."""
    [reply] = await ask_all(session, selector)
    return reply


class Lab(NamedTuple):
    server: LabServer
    port: int
    gateway: Gateway
    asker: zenoh.Session


@asynccontextmanager
async def lab(server: LabServer | None = None, **settings: Any) -> AsyncIterator[Lab]:
    """Give a server, a gateway that has asked it for everything, and a peer who asks the gateway."""
    server = server or LabServer()
    endpoint = free_endpoint()
    async with (
        ScriptedServer(server.script) as listening,
        gateway_at(listening.port, listen=endpoint, **settings) as gateway,
    ):
        await is_filled(gateway, server)
        with asker_at(endpoint) as asker:
            yield Lab(server, listening.port, gateway, asker)


@asynccontextmanager
async def lab_without_server(**settings: Any) -> AsyncIterator[tuple[int, zenoh.Session]]:
    """Give the port on which no server is, and a peer of a gateway that has tried it."""
    endpoint, port = free_endpoint(), free_port()
    async with gateway_at(port, listen=endpoint, **settings) as gateway:
        [status] = gateway.sources[0].statuses
        await wait_until_async(lambda: status.last_error)
        with asker_at(endpoint) as asker:
            yield port, asker
