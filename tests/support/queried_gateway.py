"""A whole gateway on real Zenoh and LCM for tests of queries: its server, itself, and a peer."""

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from gateway.config.settings import SpoolSettings
from gateway.daemon.gateway import Gateway
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.rtc3d.commands import SendParameters, parse_command
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import SECTIONS
from tests.support.configurations import local_settings, local_source
from tests.support.gateways import running_gateway
from tests.support.networks import free_endpoint, open_zenoh, zenoh_keys
from tests.support.parameters import in_root, spec_xml
from tests.support.servers import Client, ScriptedServer, error, markers_frame, ok, packet
from tests.support.waiting import wait_until_async

FRAME = markers_frame(7, (1.0, 2.0, 3.0))


class ParameterServer:
    """A server whose parameters and replies the test sets.

    It sends one frame after StreamFrames, or No Data if ``has_measurement`` is False.
    """

    def __init__(self, marker: str = "Marker 1") -> None:
        self.commands: list[str] = []
        self.received: list[bytes] = []
        """The packets that are not commands."""
        self.xml = parameters_xml(marker)
        self.sections = {section: spec_xml(section) for section in SECTIONS}
        """The replies to SendParameters for one section; ``xml`` is the reply to all others.

        The gateway requests a section only if ``xml`` lacks it.
        """
        self.refused_commands: tuple[str, ...] = ()
        """The prefixes of the commands that get an error."""
        self.ignored_commands: tuple[str, ...] = ()
        """The prefixes of the commands that get no reply."""
        self.has_measurement = True
        self.client: Client | None = None

    async def script(self, client: Client) -> None:
        self.client = client
        while True:
            packet_type, body = await client.packet()
            if packet_type != 1:
                self.received.append(packet(packet_type, body))
                continue
            command = body.decode("ascii")
            self.commands.append(command)
            if command == "Bye":
                return
            reply = self.answer(command)
            if reply is not None:
                client.send(reply)

    def answer(self, command: str) -> bytes | None:
        """Return the packets that reply to a command; None for no reply."""
        if command.startswith(self.ignored_commands):
            return None
        if command.startswith(self.refused_commands):
            return error("err-unknown command")
        parsed = parse_command(command.encode())
        if isinstance(parsed, SendParameters):
            return packet(2, self.sections.get(" ".join(parsed.sections), self.xml))
        frame = FRAME if self.has_measurement else packet(4)
        if command.startswith("SendCurrentFrame"):
            return frame
        return ok(f"OK-{command}") + (frame if command.startswith("StreamFrames") else b"")

    def count(self, command: str) -> int:
        """Return how many received commands start with ``command``."""
        return sum(received.startswith(command) for received in self.commands)

    def send(self, data: bytes) -> None:
        assert self.client is not None
        self.client.send(data)


class ServerOfSections(ParameterServer):
    """A server that sends most of its parameters only when they are requested by section."""

    def __init__(self) -> None:
        super().__init__()
        self.xml = in_root("<Other/>")


def parameters_xml(*markers: str) -> bytes:
    """Return the XML of all sections, with markers of these labels."""
    labels = "".join(
        f"<Marker id='{n}'><Label>{label}</Label></Marker>" for n, label in enumerate(markers, 1)
    )
    return in_root(
        "<General><Server><Name>RT</Name><Stats><FramesSent>1</FramesSent></Stats></Server></General>",
        f"<The_3D><Frequency>100</Frequency><Unit>mm</Unit><Markers>{labels}</Markers></The_3D>",
        "<The_6D><Tools/></The_6D><Analog><Channels/></Analog><Force><Plates/></Force><Events/>",
    )


@asynccontextmanager
async def run_gateway(
    port: int,
    *,
    listen: str | None = None,
    router: str | None = None,
    lcm_url: str | None = None,
    queries_url: str | None = None,
    spool: Path | None = None,
    tool_poses: bool = False,
    takes: TakesSettings | None = None,
    **source: Any,
) -> AsyncIterator[Gateway]:
    """Run a gateway with the source "lab", whose server listens on ``port`` of this host.

    On Zenoh, it is a peer that listens at an endpoint, or a client of a router. On LCM, it uses the URLs.
    ``source`` replaces settings of the source.
    """
    timeouts = {"reply_timeout_s": 5.0, "query_timeout_s": 10.0, "stall_timeout_s": 60.0}
    # The configuration does not accept 0. It sends every fresh query to the server.
    lab = local_source(port, **(timeouts | source)).model_copy(
        update={} if "fresh_interval_s" in source else {"fresh_interval_s": 0.0}
    )
    keys = zenoh_keys("client", connect=router) if router else zenoh_keys("peer", listen=listen)
    settings = local_settings(
        lab,
        zenoh=ZenohSettings(enabled=bool(listen or router), config=keys, tool_poses=tool_poses),
        lcm=LcmSettings(
            enabled=lcm_url is not None, url=lcm_url, queries_url=queries_url, tool_poses=tool_poses
        ),
        takes=takes or TakesSettings(),
        spool=SpoolSettings(directory=None if spool is None else str(spool)),
    )
    async with running_gateway(Gateway(settings)) as gateway:
        yield gateway


async def wait_until_cached(gateway: Gateway) -> None:
    """Wait until the gateway answers queries, knows the parameters, and its handshakes are done."""
    await wait_until_async(lambda: all(output.health().connected for output in gateway.outputs))
    for output in (each.output for each in gateway.outputs):
        if isinstance(output, LcmOutput) and output._requests is not None and output.settings.queries:
            # The thread that receives requests opens it once it receives; a request before that is lost.
            replies = output._requests.replies.sender
            await wait_until_async(lambda: not replies.problem)  # noqa: B023
    [source] = gateway.sources
    await wait_until_async(lambda: source.queries.parameters.newest)
    await wait_until_async(lambda: all(stream.session for stream in source.streams))


async def wait_until_found(session: zenoh.Session, source: str, num_gateways: int = 1) -> None:
    """Wait until ``session`` sees ``num_gateways`` that answer queries about ``source``.

    A router learns about a gateway some time after that has connected.
    """
    # Each gateway declares this token of its own after what answers its queries.
    tokens = f"mocap/{source}/parameters/@adv/**"
    await wait_until_async(lambda: len(list(session.liveliness().get(tokens))) == num_gateways)


class Reply(NamedTuple):
    """One reply to a query: a payload with its encoding and attachment, or an error and its code."""

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
def zenoh_peer(endpoint: str) -> Iterator[zenoh.Session]:
    """Open a Zenoh session that is a client of the endpoint."""
    session = open_zenoh("client", connect=endpoint)
    try:
        yield session
    finally:
        session.close()


def to_reply(reply: zenoh.Reply) -> Reply:
    if reply.ok is None:
        assert reply.err is not None
        _, _, code = str(reply.err.encoding).partition(";")
        return Reply("", b"", str(reply.err.encoding), {}, reply.err.payload.to_string(), code)
    sample = reply.ok
    attachment = {} if sample.attachment is None else json.loads(sample.attachment.to_bytes())
    return Reply(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding), attachment)


async def query_all(session: zenoh.Session, selector: str) -> list[Reply]:
    """Send a query and return all replies."""
    replies = await asyncio.to_thread(lambda: list(session.get(selector, timeout=20)))
    return [to_reply(reply) for reply in replies]


async def query(session: zenoh.Session, selector: str) -> Reply:
    """Send a query and return its only reply."""
    [reply] = await query_all(session, selector)
    return reply


class QuerySetup(NamedTuple):
    server: ParameterServer
    port: int
    gateway: Gateway
    peer: zenoh.Session


@asynccontextmanager
async def gateway_with_server(
    server: ParameterServer | None = None, **settings: Any
) -> AsyncIterator[QuerySetup]:
    """Run a server, a gateway that has cached its parameters, and a Zenoh peer."""
    server = server or ParameterServer()
    endpoint = free_endpoint()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, listen=endpoint, **settings) as gateway,
    ):
        await wait_until_cached(gateway)
        with zenoh_peer(endpoint) as peer:
            yield QuerySetup(server, listening.port, gateway, peer)


async def until_a_frame(gateway: Gateway) -> None:
    """Wait until a frame with markers has arrived."""
    await wait_until_async(lambda: gateway.sources[0].fan_out.newest(ComponentType.MARKERS, "zenoh"))
