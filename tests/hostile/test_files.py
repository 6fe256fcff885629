"""Servers that attack with C3D files: large, many, broken, no C3D files at all, and a disk that refuses."""

import asyncio
import contextlib
import resource
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Final

import pytest

from tests.hostile.gateway_under_attack import GatewayUnderAttack, RunningGateway
from tests.support.servers import Client, Script, ScriptedServer, c3d_file, ok, packet
from tests.support.waiting import wait_until_async

pytestmark = pytest.mark.netns

ATTACK_S: Final = 2.0
MIB: Final = 1024 * 1024
LARGE_BYTES: Final = 200 * MIB
MAX_GROWTH_KIB: Final = 400 * 1024
"""How much memory the gateway may need more than before: files that wait for a busy disk."""


@asynccontextmanager
async def server(attack: Script) -> AsyncIterator[ScriptedServer]:
    """Run a server that attacks in each connection when the handshake is done."""

    async def script(client: Client) -> None:
        command = ""
        while not command.startswith("StreamFrames"):
            command = await client.command()
            client.send(ok(f"OK-{command}"))
        await attack(client)
        await client.commands(lambda command: ok(f"OK-{command}"))

    async with ScriptedServer(script) as running:
        yield running


def header(num_bytes: int) -> bytes:
    """Return the header of a packet with a C3D file of this size."""
    return (8 + num_bytes).to_bytes(4, "big") + b"\0\0\0\5"


def files_of(gateway: RunningGateway, source: str) -> list[Path]:
    return sorted((gateway.folder / "spool").glob(f"{source}-????????T*.c3d"))


BLOCK: Final = bytes(range(256)) * (MIB // 256)


async def large(client: Client) -> None:
    client.send(header(LARGE_BYTES) + c3d_file(b"", MIB))
    for _ in range(LARGE_BYTES // MIB - 1):
        client.send(BLOCK)
        await client.drain()


async def flood(client: Client) -> None:
    while True:
        for _ in range(20):
            client.send(packet(5, c3d_file()))
        await client.drain()
        await asyncio.sleep(0.01)


async def empty(client: Client) -> None:
    while True:
        client.send(packet(5) * 100)
        await client.drain()
        await asyncio.sleep(0.01)


async def no_c3d(client: Client) -> None:
    while True:
        client.send(header(100 * MIB))
        for _ in range(100):
            client.send(bytes(MIB))
            await client.drain()


async def broken(client: Client) -> None:
    client.send(packet(5, c3d_file(b"", MIB))[:-1])
    await client.drain()
    client.cut()


async def byte_by_byte(client: Client) -> None:
    for byte in packet(5, c3d_file(b"", 4000)):
        client.send(bytes([byte]))
        await client.drain()


async def test_large_many_broken_and_no_files(gateway_under_attack: GatewayUnderAttack) -> None:
    """A large file is stored whole, a flood displaces no file of others, and memory stays bounded."""
    once = [c3d_file(b"the only one")]

    async def lonely(client: Client) -> None:
        if once:
            client.send(packet(5, once.pop()))

    attacks = {each.__name__: each for each in (large, empty, no_c3d, broken, byte_by_byte)}
    attacks |= {"lab": lonely, "lab-2": flood}
    async with contextlib.AsyncExitStack() as servers:
        ports = {
            name: (await servers.enter_async_context(server(attack))).port for name, attack in attacks.items()
        }
        async with gateway_under_attack(ports, {"spool": {"max_files": 3}}) as gateway:
            rss_kib = [gateway.rss_kib()]

            def are_stored() -> bool:
                rss_kib.append(gateway.rss_kib())
                num_files = [
                    len(files_of(gateway, name)) for name in ("large", "byte_by_byte", "lab", "lab-2")
                ]
                texts = ("it is empty", "not those of a C3D file", "broke off after")
                return all(num_files) and num_files[-1] >= 3 and all(text in gateway.log for text in texts)

            await wait_until_async(are_stored)
            await asyncio.sleep(ATTACK_S)
            [file] = files_of(gateway, "large")
            assert file.read_bytes() == c3d_file(b"", MIB) + BLOCK * (LARGE_BYTES // MIB - 1)
            assert len(files_of(gateway, "lab")) == 1
            assert (
                3 <= len(files_of(gateway, "lab-2")) <= 4
            )  # the new one is there before an old one is deleted
            for name in ("empty", "no_c3d", "broken"):
                assert files_of(gateway, name) == []
            assert max(*rss_kib, gateway.rss_kib()) - rss_kib[0] < MAX_GROWTH_KIB
    gateway.report.check()
    assert not list((gateway.folder / "spool").glob("*.part"))


@pytest.mark.parametrize("trouble", ["no space", "a file in place of the folder", "the folder disappears"])
async def test_a_disk_that_refuses(gateway_under_attack: GatewayUnderAttack, trouble: str) -> None:
    begun = asyncio.Event()

    async def attack(client: Client) -> None:
        await begun.wait()
        while True:
            client.send(packet(5, c3d_file(b"", MIB)))
            await client.drain()
            await asyncio.sleep(0.02)

    async with server(attack) as hostile, gateway_under_attack({"hostile": hostile.port}) as gateway:
        spool = gateway.folder / "spool"
        if trouble == "no space":
            resource.prlimit(gateway.process.pid, resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
        elif trouble == "a file in place of the folder":
            spool.write_text("a file")
        begun.set()
        until_s = asyncio.get_running_loop().time() + ATTACK_S
        while asyncio.get_running_loop().time() < until_s:
            if trouble == "the folder disappears" and spool.exists():
                for path in spool.iterdir():
                    path.unlink(missing_ok=True)
                with contextlib.suppress(OSError):
                    spool.rmdir()
            await asyncio.sleep(0.01)
        if trouble != "the folder disappears":
            await wait_until_async(lambda: "cannot be stored in" in gateway.log)
            assert gateway.log.count("cannot be stored in") == 1
            assert files_of(gateway, "hostile") == []
    gateway.report.check()
