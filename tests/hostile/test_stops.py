"""SIGTERM ends the gateway within 2 s with status 0, whatever its servers, peers and disks do."""

import asyncio
import contextlib
import json
import os
import re
import signal
import socket
import time
from asyncio.subprocess import DEVNULL, Process
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import pytest
import yaml

from gateway.outputs.zenoh.output import TEXTS
from tests.hostile.gateway_under_attack import MAX_STOP_S, printed, python
from tests.stops import report, run_stops
from tests.support.gateway_process import PROGRAM
from tests.support.lcm_relay import LcmRelay
from tests.support.networks import free_endpoint, free_port, lcm_url, zenoh_keys
from tests.support.servers import Client, Script, ScriptedServer, markers_frame, ok, packet
from tests.support.waiting import wait_until_async

pytestmark = pytest.mark.netns

NUM_STOPS: Final = 6
"""How many stops under load are tried; `make stops` tries 500."""

NEVER_ENDS: Final = "import {0}, time; {0}.{1} = lambda *arguments: time.sleep(60)"
"""A module that Python imports at its start, which replaces a function by one that never returns."""


class Site:
    """A gateway process with a configuration of the test."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.config = folder / "gateway.yaml"
        self.endpoint = free_endpoint()
        self.process: Process

    @property
    def log(self) -> str:
        return (self._folder / "gateway.log").read_text()

    def configure(self, ports: Sequence[int], **sections: Any) -> None:
        sources = [
            {"name": f"lab-{number}", "host": "127.0.0.1", "port": port} for number, port in enumerate(ports)
        ]
        configuration = {
            "sources": sources,
            "spool": {"directory": str(self._folder / "spool")},
            "zenoh": {"config": zenoh_keys("peer", listen=self.endpoint)},
            "lcm": {"enabled": False},
            "metrics": {"enabled": False},
        }
        self.config.write_text(yaml.safe_dump(configuration | sections))

    @contextlib.asynccontextmanager
    async def running(self, *, sabotage: str = "") -> AsyncIterator[None]:
        """Run the gateway; kill it at the end of the block."""
        (self._folder / "sitecustomize.py").write_text(sabotage)
        path = os.pathsep.join(filter(None, (str(self._folder), os.environ.get("PYTHONPATH"))))
        with (self._folder / "gateway.log").open("wb") as log:
            self.process = await asyncio.create_subprocess_exec(
                *(*PROGRAM, "run", "--config", str(self.config)),
                env=os.environ | {"PYTHONPATH": path},
                stdin=DEVNULL,
                stderr=log,
            )
        try:
            yield
        finally:
            if self.process.returncode is None:
                self.process.kill()
                await self.process.wait()

    async def until_logged(self, text: str, count: int = 1) -> None:
        await wait_until_async(lambda: self.log.count(text) >= count)

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> float:
        """Send a signal; return how long the gateway took to end in s. Its status must be 0."""
        began_s = time.monotonic()
        self.process.send_signal(number)
        status = await asyncio.wait_for(self.process.wait(), 30)
        seconds = time.monotonic() - began_s
        assert status == 0, self.log
        assert seconds < MAX_STOP_S, self.log
        return seconds


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def stream(client: Client, *, answers_bye: bool) -> Callable[[str], bytes | None]:
    """Return what a server answers, which sends a frame for StreamFrames and nothing after it."""

    def answer(command: str) -> bytes | None:
        if command.startswith("StreamFrames"):
            client.send(ok("OK-StreamFrames") + markers_frame(1, (1.0, 2.0, 3.0)))
            return None
        return None if command == "Bye" and not answers_bye else ok(f"OK-{command}")

    return answer


async def ignore_bye(client: Client) -> None:
    with contextlib.suppress(asyncio.IncompleteReadError):
        await client.commands(stream(client, answers_bye=False))
    await asyncio.Event().wait()


async def send_a_file(client: Client) -> None:
    def answer(command: str) -> bytes | None:
        reply = stream(client, answers_bye=True)(command)
        if command.startswith("StreamFrames"):
            client.send(packet(5, b"\x02\x50" + bytes(2_000_000)))
        return reply

    await client.commands(answer)


async def never_read(_client: Client) -> None:
    await asyncio.Event().wait()


async def flood(client: Client) -> None:
    """Send frames as fast as the gateway reads them."""
    frames = b"".join(markers_frame(number, (1.0, 2.0, 3.0)) for number in range(1000))

    async def send() -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                client.send(frames)
                await client.drain()

    sending: list[asyncio.Task[None]] = []

    def answer(command: str) -> bytes | None:
        if command.startswith("StreamFrames"):
            sending.append(asyncio.create_task(send()))
        return ok(f"OK-{command}")

    await client.commands(answer)


@contextlib.contextmanager
def full_server() -> Iterator[int]:
    """Listen on a port that answers no connection; yield it."""
    with socket.create_server(("127.0.0.1", 0), backlog=0) as server, contextlib.ExitStack() as clients:
        for _ in range(3):
            client = clients.enter_context(socket.socket())
            client.setblocking(False)
            client.connect_ex(server.getsockname())
        yield server.getsockname()[1]


@pytest.mark.parametrize("delay_s", [0.1, 0.4, 0.8])
async def test_while_it_starts(site: Site, delay_s: float) -> None:
    site.configure([free_port()])
    async with site.running():
        await asyncio.sleep(delay_s)
        began_s = time.monotonic()
        site.process.terminate()
        status = await site.process.wait()
        assert status in {0, -signal.SIGTERM}  # the latter before Python runs the first line of the gateway
        assert time.monotonic() - began_s < MAX_STOP_S
        assert "Traceback" not in site.log


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
async def test_with_servers_that_do_not_answer(site: Site, number: signal.Signals) -> None:
    """Two do not answer the connection, two never read, and eight ignore Bye."""
    with full_server() as full:
        async with ScriptedServer(never_read) as silent, ScriptedServer(ignore_bye) as rude:
            site.configure([*[full] * 2, *[silent.port] * 2, *[rude.port] * 8])
            async with site.running():
                await site.until_logged("→ streaming", 8)
                await wait_until_async(lambda: silent.connections >= 2)
                await site.stop(number)


@pytest.mark.parametrize("ends", [True, False], ids=["servers that ignore bye", "a reload that does not end"])
async def test_during_a_reload(site: Site, ends: bool) -> None:
    async with ScriptedServer(ignore_bye) as server:
        site.configure([server.port] * 8)
        async with site.running():
            await site.until_logged("→ streaming", 8)
            if ends:
                site.configure([free_port()] * 8, lcm={"url": lcm_url()})
            else:
                site.config.unlink()
                os.mkfifo(site.config)
            site.process.send_signal(signal.SIGHUP)
            await asyncio.sleep(0.1)
            await site.stop()


def takes(folder: Path) -> dict[str, Any]:
    """Return the settings for takes that keep the last minute."""
    folder.mkdir()
    return {"takes": {"enabled": True, "directory": str(folder), "keep_last_s": 60.0}}


@pytest.mark.parametrize(("call", "script"), [("fsync", send_a_file), ("fdatasync", flood)])
async def test_with_a_disk_that_does_not_respond(site: Site, call: str, script: Script) -> None:
    """It takes neither files of the server nor recordings."""
    folder = site.config.parent / "takes"
    async with ScriptedServer(script) as server:
        site.configure([server.port] * 2, **takes(folder))
        async with site.running(sabotage=NEVER_ENDS.format("os", call)):
            await site.until_logged("→ streaming", 2)
            if script is send_a_file:
                await wait_until_async(lambda: any(site.config.parent.glob("spool/*")))
            else:
                await site.until_logged("MiB wait for it; check what else writes to it")
            await site.stop()
            if script is flood:
                assert re.search("bytes are not written|not finished: ", site.log)


@pytest.mark.parametrize("keeps", [False, True], ids=["sent", "kept"])
async def test_while_frames_come_as_fast_as_possible(site: Site, keeps: bool) -> None:
    """A flood of frames delays no stop, and the kept last seconds leave no files behind."""
    folder = site.config.parent / "takes"
    async with ScriptedServer(flood) as server:
        site.configure([server.port] * 2, **(takes(folder) if keeps else {}))
        async with site.running():
            await site.until_logged("→ streaming", 2)
            await asyncio.sleep(1)
            await site.stop()
            is_too_busy = "did not stop within" in site.log  # the next start deletes them
            assert is_too_busy or not [*folder.glob(".rolling/*/*")]


async def test_with_an_lcm_peer_that_does_not_read(site: Site) -> None:
    relay = LcmRelay()
    async with ScriptedServer(flood) as server:
        site.configure([server.port], lcm={"url": relay.url})
        async with site.running():
            await site.until_logged("lcm: sending messages")
            relay.stop_reading()
            await site.until_logged("does not take messages fast enough")
            await site.stop()
    relay.close()


OPEN: Final = "import json, sys, threading, time, zenoh\n" + (
    "session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))\n"
)
SUBSCRIBER_AND_ASKER: Final = """
def ask():
    while True:
        list(session.get("mocap/**", timeout=1))
session.declare_subscriber("mocap/**", lambda sample: None)
for _ in range(8):
    threading.Thread(target=ask, daemon=True).start()
time.sleep(0.5)
"""


@pytest.mark.parametrize("is_router", [True, False], ids=["router", "subscriber and asker"])
async def test_with_a_zenoh_peer_that_has_stopped(site: Site, is_router: bool) -> None:
    keys = (
        zenoh_keys("router", listen=site.endpoint)
        if is_router
        else zenoh_keys("client", connect=site.endpoint)
    )
    code = OPEN + ("" if is_router else SUBSCRIBER_AND_ASKER) + "print(flush=True)\nsys.stdin.read()"
    async with ScriptedServer(flood) as server, contextlib.AsyncExitStack() as stack:

        async def start() -> Process:
            process = await stack.enter_async_context(python("-c", code, json.dumps(keys)))
            await printed(process)
            return process

        client = {"zenoh": {"config": zenoh_keys("client", connect=site.endpoint)}}
        site.configure([server.port], **(client if is_router else {}))
        router = await start() if is_router else None
        async with site.running():
            await site.until_logged("→ streaming")
            process = router or await start()
            process.send_signal(signal.SIGSTOP)
            await asyncio.sleep(1)
            await site.stop()


async def test_with_peers_that_do_not_answer(site: Site) -> None:
    """There is no Zenoh router, LCM's relays do not answer, and others hold the port of the monitoring."""
    port = free_port()
    with full_server() as first, full_server() as second, contextlib.ExitStack() as held:
        site.configure(
            [free_port()],
            zenoh={"config": zenoh_keys("client", connect=site.endpoint)},
            lcm={"url": f"tcpq://127.0.0.1:{first}", "queries_url": f"tcpq://127.0.0.1:{second}"},
            metrics={"port": port},
        )
        async with site.running():
            await site.until_logged(f"zenoh: {TEXTS.cannot_open}")
            await site.until_logged("metrics: /metrics and /healthz are served")
            for _ in range(24):
                held.enter_context(socket.create_connection(("127.0.0.1", port)))
            await asyncio.sleep(0.1)
            await site.stop()


async def test_stops_under_load(tmp_path: Path) -> None:
    stops = await asyncio.to_thread(lambda: list(run_stops(NUM_STOPS, tmp_path)))
    assert all(stop.status == 0 and stop.seconds < MAX_STOP_S for stop in stops), report(stops)
