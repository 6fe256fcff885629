"""Servers that break, refuse, say nothing or repeat themselves for ever: few connections, and few lines."""

import asyncio
import os
import random
import struct
from typing import Final

import pytest

from tests.hostile.gateway_under_attack import GatewayUnderAttack
from tests.servers import Client, Script, ScriptedServer, error, markers_frame, ok, packet

pytestmark = pytest.mark.netns

_ATTACK_S: Final = 5.0
_SLOW: Final = {"reconnect": {"first_delay_s": 0.1, "max_delay_s": 5.0}}
"""With the default of first_delay_s, five seconds would show little."""


async def shake_hands(client: Client) -> None:
    """Answer commands until frames are requested."""
    while True:
        command = await client.command()
        if command.startswith("SendParameters"):
            client.send(packet(2, "<RT_Parameters><General/></RT_Parameters>"))
        else:
            client.send(ok("OK"))
        if command.startswith("StreamFrames"):
            return


async def break_after_a_frame(client: Client) -> None:
    await shake_hands(client)
    client.send(markers_frame(1, (1.0, 2.0, 3.0)))
    await asyncio.sleep(0.02)
    client.cut()


async def half_close_after_a_frame(client: Client) -> None:
    await shake_hands(client)
    client.send(markers_frame(1, (1.0, 2.0, 3.0)))
    client._writer.write_eof()
    await client.packet()


async def close_at_once(client: Client) -> None:
    client.cut()


async def close_at_a_command(client: Client) -> None:
    await client.command()
    client.cut()


async def say_nothing(client: Client) -> None:
    await client.commands(lambda _: None)


async def send_garbage(client: Client) -> None:
    client.send(os.urandom(1000))
    await client.commands(lambda _: os.urandom(100))


async def refuse_with_new_words(client: Client) -> None:
    await client.commands(lambda _: error(f"no {random.random()}\x1b[2J\n{'x' * 1000}"))


async def alternate_states(client: Client) -> None:
    await shake_hands(client)
    for number in range(1_000_000):
        client.send(packet(4) + markers_frame(number, (1.0, 2.0, 3.0)))
        await asyncio.sleep(0.005)


async def send_bad_frames(client: Client) -> None:
    await shake_hands(client)
    while True:
        unknown = struct.pack(">III", 1, 8, random.randrange(10, 2**31))
        client.send(packet(3, random.choice([unknown, os.urandom(50)])))
        await asyncio.sleep(0.005)


async def restart_the_numbers(client: Client) -> None:
    await shake_hands(client)
    for number in range(1_000_000):
        client.send(markers_frame(number % 7, *[(1.0, 2.0, 3.0)] * (1 + number % 3)))
        await asyncio.sleep(0.005)


BREAKING: Final = [
    break_after_a_frame,
    half_close_after_a_frame,
    close_at_once,
    close_at_a_command,
    send_garbage,
]


@pytest.mark.parametrize("script", BREAKING, ids=lambda script: script.__name__)
async def test_a_server_that_breaks_again_and_again(
    gateway_under_attack: GatewayUnderAttack, script: Script
) -> None:
    async with ScriptedServer(script) as server:
        attacker = {"port": server.port, **_SLOW}
        async with gateway_under_attack({"hostile": attacker}) as gateway:
            await asyncio.sleep(_ATTACK_S)
            # 0.1 + 0.2 + 0.4 + 0.8 + 1.6 + 3.2 s, each shortened by up to half; without it, there are 50.
            assert server.connections <= 12
    gateway.report.check()
    assert gateway.report.log.count("hostile") <= 10


async def test_servers_that_repeat_themselves(gateway_under_attack: GatewayUnderAttack) -> None:
    scripts = (say_nothing, refuse_with_new_words, alternate_states, send_bad_frames, restart_the_numbers)
    async with (
        ScriptedServer(scripts[0]) as mute,
        ScriptedServer(scripts[1]) as refusing,
        ScriptedServer(scripts[2]) as alternating,
        ScriptedServer(scripts[3]) as bad,
        ScriptedServer(scripts[4]) as restarting,
        gateway_under_attack(
            {
                "mute": mute.port,
                "refusing": refusing.port,
                "alternating": alternating.port,
                "bad": bad.port,
                "restarting": restarting.port,
            }
        ) as gateway,
    ):
        await asyncio.sleep(_ATTACK_S)
    gateway.report.check()
    assert max(map(len, gateway.report.log.splitlines())) < 1600
    assert "\x1b" not in gateway.report.log
