"""Odd configurations at a reload, and clients of the monitoring port that hold or flood it."""

import asyncio
import os
import signal
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Final

import pytest

from tests.hostile.gateway_under_attack import GatewayUnderAttack, RunningGateway
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns

ATTACK_S: Final = 3.0
MAX_ANSWER_S: Final = 5.0


def _replaced_by(make: Callable[[Path], object]) -> Callable[[Path], None]:
    def replace(path: Path) -> None:
        path.unlink()
        make(path)

    return replace


ODD_CONFIGURATIONS: Final[dict[str, Callable[[Path], object]]] = {
    "pipe": _replaced_by(os.mkfifo),
    "folder": _replaced_by(Path.mkdir),
    "device": _replaced_by(lambda path: path.symlink_to("/dev/zero")),
    "missing": Path.unlink,
    "huge": lambda path: os.truncate(path, 2**33),
    "values": lambda path: path.write_text("[" + "a," * 130_000 + "]"),
    "keys": lambda path: path.write_text("".join(f"a{n}:\n" for n in range(20_000))),
    "levels": lambda path: path.write_text("[" * 200_000),
    "aliases": lambda path: path.write_text(
        "a0: &a0 [x, x]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 200))
    ),
    "bytes": lambda path: path.write_bytes(bytes(200_000)),
}


async def _wait_for_refusals(gateway: RunningGateway, count: int) -> None:
    await wait_until_async(lambda: gateway.log.count("new configuration refused") >= count)


async def test_odd_configurations_at_a_reload_are_refused(gateway_under_attack: GatewayUnderAttack) -> None:
    async with gateway_under_attack() as gateway:
        good = gateway.config.read_text()
        for number, spoil in enumerate(ODD_CONFIGURATIONS.values(), 1):
            spoil(gateway.config)
            gateway.process.send_signal(signal.SIGHUP)
            await _wait_for_refusals(gateway, number)
            if gateway.config.is_dir():
                gateway.config.rmdir()
            else:
                gateway.config.unlink(missing_ok=True)
            gateway.config.write_text(good)
        gateway.process.send_signal(signal.SIGHUP)
        await wait_until_async(lambda: "configuration reloaded: nothing changed" in gateway.log)
    gateway.report.check()


@asynccontextmanager
async def _held(gateway: RunningGateway, count: int, request: bytes) -> AsyncIterator[None]:
    """Hold connections with the beginning of a request until the end of the block."""
    writers = []
    try:
        for _ in range(count):
            _, writer = await asyncio.open_connection("127.0.0.1", gateway.metrics_port)
            writer.write(request)
            writers.append(writer)
        yield
    finally:
        for writer in writers:
            writer.transport.abort()


async def _answer(gateway: RunningGateway, request: bytes) -> bytes:
    reader, writer = await asyncio.open_connection("127.0.0.1", gateway.metrics_port)
    try:
        writer.write(request)
        return await asyncio.wait_for(reader.read(), MAX_ANSWER_S)
    finally:
        writer.close()


@pytest.mark.parametrize("count", [24, 1000])
@pytest.mark.parametrize("request_start", [b"", b"GET /healthz HTTP/1.1\r\nX: "], ids=["silent", "slow"])
async def test_health_is_answered_while_connections_are_held(
    gateway_under_attack: GatewayUnderAttack, count: int, request_start: bytes
) -> None:
    async with gateway_under_attack() as gateway, _held(gateway, count, request_start):
        for method in (b"GET", b"HEAD"):
            answer = await _answer(gateway, method + b" /healthz HTTP/1.1\r\n\r\n")
            assert answer.startswith(b"HTTP/1.1 200 ")
        await asyncio.sleep(1)  # the length of the attack
    gateway.report.check()


async def test_a_flood_of_requests_delays_nobody(gateway_under_attack: GatewayUnderAttack) -> None:
    requests = (
        b"GET /metrics HTTP/1.1\r\n\r\n",
        b"GET /" + b"x" * 7000 + b" HTTP/1.1\r\n\r\n",
        b"\0" * 20_000,
    )

    async def flood(gateway: RunningGateway, request: bytes) -> None:
        end_s = time.monotonic() + ATTACK_S
        while time.monotonic() < end_s:
            with suppress(OSError, TimeoutError):
                await _answer(gateway, request)

    async with gateway_under_attack() as gateway:
        await asyncio.gather(*(flood(gateway, request) for request in requests for _ in range(4)))
    gateway.report.check()
