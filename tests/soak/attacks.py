"""The attacks of ``make soak``, each in a process of its own, which ends in the middle of the attack.

python -m tests.soak.attacks NAME TARGET   # TARGET is the JSON of a Target
"""

import asyncio
import contextlib
import json
import os
import signal
import socket
import sys
from collections.abc import Awaitable, Callable, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import Final

import rtc3d
import uvloop
import zenoh

from gateway.messages.topics import lcm_channel
from gateway.outputs.lcm.connection import open_lcm
from tests.hostile.port_attacks import ATTACKS as PORT_ATTACKS
from tests.hostile.server_floods import FLOODS
from tests.hostile.servers import SERVERS, streaming
from tests.hostile.zenoh_peer import KINDS
from tests.support.networks import open_zenoh
from tests.support.servers import Client, Script, ScriptedServer, c3d_file, packet

ASKS_AT_ONCE: Final = 2000
NUM_STALLED: Final = 20
NUM_DECLARATIONS: Final = 2000
LARGE_BYTES: Final = 100 * 1024 * 1024
NUM_HTTP_CONNECTIONS: Final = 100
_AGAIN_S: Final = 0.1


@dataclass(frozen=True)
class Target:
    """What an attack can reach."""

    zenoh_endpoint: str
    lcm_url: str
    queries_url: str
    metrics_port: int
    output_ports: Mapping[str, int]
    """The port of each output that is a server."""
    pid: int
    ports: tuple[int, ...]
    """Where the gateway expects hostile servers."""


Attack = Callable[[Target], Awaitable[None]]


def _server(script: Script) -> Attack:
    async def attack(target: Target) -> None:
        async with AsyncExitStack() as stack:
            for port in target.ports:
                await stack.enter_async_context(ScriptedServer(script, port))
            await asyncio.Event().wait()

    return attack


def _questions(selector: str) -> Attack:
    """Ask on Zenoh again and again, without waiting for the answers."""

    async def attack(target: Target) -> None:
        session = open_zenoh("client", connect=target.zenoh_endpoint)
        while True:
            for _ in range(ASKS_AT_ONCE):
                session.get(selector, lambda _reply: None)
            await asyncio.sleep(0.5)

    return attack


async def _lcm_requests(target: Target) -> None:
    connection = open_lcm(target.queries_url)
    request = rtc3d.parameters_request_t()
    request.requester = "soak"
    channel = lcm_channel("MOCAP", "healthy", "parameters_request")
    while True:
        for request.request_id in range(ASKS_AT_ONCE):
            connection.publish(channel, request.encode())
        await asyncio.sleep(0.1)


async def _lcm_garbage(target: Target) -> None:
    """Send what is no message, and messages of others, on all channels of the gateway."""
    connections = [open_lcm(url) for url in (target.lcm_url, target.queries_url)]
    while True:
        for connection in connections:
            for channel in ("PARAMETERS_REQUEST", "PARAMETERS_REPLY", "STATUS", "?" * 40):
                connection.publish(f"MOCAP_HEALTHY_{channel}", os.urandom(2000))
        await asyncio.sleep(0.002)


async def _stalled_subscribers(target: Target) -> None:
    """Subscribe to everything, and never read it: this process stops."""
    _kept = list(KINDS["subscribers"](target.zenoh_endpoint, NUM_STALLED))
    await asyncio.sleep(0.5)
    os.kill(os.getpid(), signal.SIGSTOP)


def _zenoh_peer(kind: str) -> Attack:
    async def attack(target: Target) -> None:
        _kept = list(KINDS[kind](target.zenoh_endpoint, NUM_DECLARATIONS))
        await asyncio.Event().wait()

    return attack


async def _many_files(client: Client) -> None:
    while True:
        client.send(packet(5, c3d_file()) * 20)
        await client.drain()
        await asyncio.sleep(0.01)


async def _large_files(client: Client) -> None:
    file = packet(5, c3d_file(b"", LARGE_BYTES))
    while True:
        client.send(file)
        await client.drain()


async def _held_http_connections(target: Target) -> None:
    """Hold connections open that never ask, and let others ask all the time."""
    held = [socket.create_connection(("127.0.0.1", target.metrics_port)) for _ in range(NUM_HTTP_CONNECTIONS)]
    for connection in held[::2]:
        connection.sendall(b"GET /metrics HTTP/1.1\r\nX: ")
    while True:
        reader, writer = await asyncio.open_connection("127.0.0.1", target.metrics_port)
        writer.write(b"GET /metrics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
        await reader.read()
        writer.close()


def _on_port_of(output: str, attack: Callable[[int], Awaitable[None]]) -> Attack:
    return lambda target: attack(target.output_ports.get(output, 0))  # LSL's ports are always the same


async def _reloads(target: Target) -> None:
    while True:
        os.kill(target.pid, signal.SIGHUP)
        await asyncio.sleep(0.2)


_ON_PORTS: Final = {"rtc3d": "RTC3D client", "vrpn": "VRPN client", "foxglove": "viewer", "lsl": "LSL"}
"""Who attacks the port of an output."""

ATTACKS: Final[dict[str, Attack]] = {
    **{f"server: {name}": _server(script) for group in SERVERS.values() for name, script in group.items()},
    "server: many-files": _server(streaming(_many_files)),
    "server: large-files": _server(streaming(_large_files)),
    **{
        f"{group}: {name}": _server(script)
        for group, (servers, _) in FLOODS.items()
        for name, script in servers.items()
    },
    "asker: all frames as JSON": _questions("mocap/healthy/3d?format=json"),
    "asker: everything": _questions("mocap/healthy/**"),
    "asker: the whole history": _questions("mocap/healthy/*?from=0"),
    "asker: unknown keys": _questions("mocap/healthy/none/of/these?format=none"),
    "asker: fresh parameters": _questions("mocap/*/parameters?fresh=true"),
    "asker: LCM": _lcm_requests,
    "sender: LCM": _lcm_garbage,
    "Zenoh peer: stalled subscribers": _stalled_subscribers,
    **{f"Zenoh peer: {kind}": _zenoh_peer(kind) for kind in KINDS},
    **{
        f"{who}: {name}": _on_port_of(output, attack)
        for output, who in _ON_PORTS.items()
        for name, attack in PORT_ATTACKS[output].items()
    },
    "host: HTTP connections": _held_http_connections,
    "host: reloads": _reloads,
}
"""By what the table in the report calls them."""


async def _run(attack: Attack, target: Target) -> None:
    """Attack without end: again if the gateway ends a connection."""
    while True:
        with contextlib.suppress(OSError, zenoh.ZError):
            await attack(target)
        await asyncio.sleep(_AGAIN_S)


def main() -> None:
    name, target = sys.argv[1], json.loads(sys.argv[2])
    uvloop.run(_run(ATTACKS[name], Target(**{**target, "ports": tuple(target["ports"])})))


if __name__ == "__main__":
    main()
