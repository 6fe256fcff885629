"""Servers whose parameters attack the parser, or are as large as they can be, and change at every request."""

import asyncio
from collections.abc import Callable
from itertools import count
from typing import Final

import pytest

from gateway.rtc3d.parameters_xml import MAX_XML_BYTES
from tests.hostile.gateway_under_attack import GatewayUnderAttack
from tests.servers import Client, Script, ScriptedServer, ok, packet

pytestmark = pytest.mark.netns

ATTACK_S: Final = 3.0
FRESH: Final = {"parameters_interval_s": 0.5, "fresh_interval_s": 0.1}


def filled(before: str, unit: str, after: str = "") -> Callable[[int], bytes]:
    """Return the XML for the n-th request: as many of ``unit`` as the gateway still parses."""

    def xml(number: int) -> bytes:
        start = f"<RT_Parameters><General><Server><Name>{number}</Name></Server></General>{before}"
        end = f"{after}</RT_Parameters>"
        room = MAX_XML_BYTES - len(start) - len(end)
        return f"{start}{unit * (room // len(unit))}{end}".encode()

    return xml


ATTACKS: Final[dict[str, Callable[[int], bytes]]] = {
    "events": filled("<Events>", "<Event/>", "</Events>"),
    "markers": filled("<The_3D><Markers>", "<Marker/>", "</Markers></The_3D>"),
    "labels": filled("<The_3D><Markers>", "<Marker><Label>abcdefgh</Label></Marker>", "</Markers></The_3D>"),
    "numbers": filled(
        "<Analog><Channels>", "<Channel><Frequency>x</Frequency></Channel>", "</Channels></Analog>"
    ),
    "ampersands": filled("", "& "),
    "attributes": filled("<a ", "x='' ", "/>"),
    "too-large": lambda number: b"<RT_Parameters>%d" % number + b"<a/>" * 4_000_000,  # 16 MB
    "bomb": lambda number: (
        b"<!DOCTYPE a [<!ENTITY a '%d'><!ENTITY b '%b'>]><a>&b;</a>" % (number, b"&a;" * 5000)
    ),
}


def giving(xml: Callable[[int], bytes]) -> Script:
    numbers = count()

    def answer(command: str) -> bytes:
        if command.startswith("SendParameters"):
            return packet(2, xml(next(numbers)))
        return packet(4) if command.startswith("StreamFrames") else ok(f"OK-{command}")

    async def script(client: Client) -> None:
        await client.commands(answer)

    return script


async def test_eight_servers_with_parameters_that_take_long(gateway_under_attack: GatewayUnderAttack) -> None:
    servers = {name: ScriptedServer(giving(xml)) for name, xml in ATTACKS.items()}
    for server in servers.values():
        await server.__aenter__()
    sources = {name: {"port": server.port, **FRESH} for name, server in servers.items()}
    async with gateway_under_attack(sources) as gateway:
        await asyncio.sleep(ATTACK_S)
    for server in servers.values():
        await server.__aexit__(None, None, None)
    gateway.report.check()
