"""Odd configurations at a reload, floods of the monitoring port, and names that nobody resolves."""

import asyncio
import json
import os
import signal
import socket
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

import pytest
import yaml

from tests.hostile.gateway_under_attack import GatewayUnderAttack, RunningGateway
from tests.support.networks import dead_name_server
from tests.support.waiting import wait_until_async

pytestmark = pytest.mark.netns

HELD_S: Final = 2.0
"""Less than the gateway waits for a request."""

MAX_ANSWER_S: Final = 30.0


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


async def test_odd_configurations_at_a_reload_are_refused(gateway_under_attack: GatewayUnderAttack) -> None:
    async with gateway_under_attack() as gateway:
        good = gateway.config.read_text()
        for number, spoil in enumerate(ODD_CONFIGURATIONS.values(), 1):
            spoil(gateway.config)
            gateway.process.send_signal(signal.SIGHUP)
            await wait_until_async(
                lambda: gateway.log.count("new configuration refused") >= number  # noqa: B023
            )
            if gateway.config.is_dir():
                gateway.config.rmdir()
            else:
                gateway.config.unlink(missing_ok=True)
            gateway.config.write_text(good)
        gateway.process.send_signal(signal.SIGHUP)
        await wait_until_async(lambda: "nothing changed" in gateway.log)
    gateway.report.check()


async def _hold(port: int, count: int, request: bytes) -> None:
    """Hold connections with the beginning of a request; new ones take the place of old ones in time."""
    held: deque[socket.socket] = deque()
    try:
        while True:
            for _ in range(count):
                held.append(socket.create_connection(("127.0.0.1", port)))
                with suppress(OSError):  # ended by the gateway
                    held[-1].sendall(request)
                if len(held) > count:
                    held.popleft().close()
                await asyncio.sleep(0)
            await asyncio.sleep(HELD_S)
    finally:
        for connection in held:
            connection.close()


async def _answer(gateway: RunningGateway, request: bytes) -> bytes:
    reader, writer = await asyncio.open_connection("127.0.0.1", gateway.metrics_port)
    try:
        writer.write(request)
        return await asyncio.wait_for(reader.read(), MAX_ANSWER_S)
    finally:
        writer.close()


FLOODS: Final = (
    b"GET /metrics HTTP/1.1\r\n\r\n",
    b"GET /" + b"x" * 7000 + b" HTTP/1.1\r\n\r\n",
    b"\0" * 20_000,
)


async def _flood(gateway: RunningGateway, request: bytes, ended: asyncio.Event) -> None:
    while not ended.is_set():  # a cancellation may be lost between two connections
        with suppress(OSError, TimeoutError):
            await _answer(gateway, request)


async def test_health_is_answered_during_attacks_on_its_port(
    gateway_under_attack: GatewayUnderAttack,
) -> None:
    """A supervisor learns that the gateway works while others hold all connections or flood it."""
    async with gateway_under_attack() as gateway:
        port = gateway.metrics_port
        attacks = [
            [_hold(port, count, request)]
            for count in (24, 400)
            for request in (b"", b"GET /healthz HTTP/1.1\r\nX: ")
        ]
        ended = asyncio.Event()
        attacks.append([_flood(gateway, request, ended) for request in FLOODS for _ in range(4)])
        for attack in attacks:
            tasks = [asyncio.create_task(each) for each in attack]
            await asyncio.sleep(HELD_S / 2)
            for method in (b"GET", b"HEAD"):
                answer = await _answer(gateway, method + b" /healthz HTTP/1.1\r\n\r\n")
                assert answer.startswith(b"HTTP/1.1 200 ")
            assert not any(task.done() for task in tasks)
            if attack is attacks[-1]:
                ended.set()
            else:
                tasks[0].cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
    gateway.report.check()


_DEAD = {f"dead-{number}": {"host": f"dead-{number}.example.org", "port": 3020} for number in range(8)}


AT_ONCE_S: Final = 20.0
"""What waits for the name server takes longer: a program asks it again after 30 s."""


def num_threads(gateway: RunningGateway) -> int:
    return len(list(Path(f"/proc/{gateway.process.pid}/task").iterdir()))


async def test_eight_dead_names_and_a_dead_name_server(
    gateway_under_attack: GatewayUnderAttack, tmp_path: Path
) -> None:
    settings = {"metrics": {"host": "dead.example.org"}}
    with dead_name_server(tmp_path) as before_command:
        async with gateway_under_attack(_DEAD, settings, before_command=before_command) as gateway:
            await wait_until_async(lambda: "was not resolved within 1 s" in gateway.log)
            threads_before = num_threads(gateway)
            configuration = yaml.safe_load(gateway.config.read_text())
            configuration["sources"][1]["port"] = 3030
            gateway.config.write_text(yaml.safe_dump(configuration))
            gateway.process.send_signal(signal.SIGHUP)
            await wait_until_async(lambda: "source dead-0 changed" in gateway.log, AT_ONCE_S)
            await asyncio.sleep(2)  # several attempts of each source
            assert num_threads(gateway) < threads_before + len(_DEAD)  # not one more for each attempt
    gateway.report.check()
    assert gateway.report.stop_s < AT_ONCE_S


async def test_dead_names_of_zenoh_peers(gateway_under_attack: GatewayUnderAttack, tmp_path: Path) -> None:
    endpoints = [f"tcp/dead-{number}.example.org:7447" for number in range(4)]
    environ = {"RTC3D_GATEWAY__ZENOH__CONFIG__CONNECT__ENDPOINTS": json.dumps(endpoints)}
    with dead_name_server(tmp_path) as before_command:
        async with gateway_under_attack(environ=environ, before_command=before_command) as gateway:
            await asyncio.sleep(3)
    gateway.report.check()
    assert gateway.report.stop_s < AT_ONCE_S
