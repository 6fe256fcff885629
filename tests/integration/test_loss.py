"""Loss as an operator sees it: counted in messages and frames, logged, in /healthz and in the status line."""

import asyncio
import json
import re
import signal
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import yaml

from gateway.messages.decode import decode
from gateway.monitoring.health import health_page
from gateway.monitoring.status_line import status_lines
from gateway.rtc3d.components import ComponentType
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.memory_gateway import MemoryGateway, run_gateway
from tests.networks import free_endpoint, free_port, open_zenoh, zenoh_keys
from tests.servers import Client, ScriptedServer, markers_frame, ok, packet
from tests.waiting import wait_until_async

# Frames that come and are of no use ----------------------------------------------------------


def sending(*frames: bytes) -> Callable[[Client], Any]:
    """Return a script that acknowledges every command and sends ``frames`` over and over."""

    async def script(client: Client) -> None:
        async def send() -> None:
            while True:
                for frame in frames:
                    client.send(frame)
                await asyncio.sleep(0.01)

        sender = None
        try:
            while True:
                command = await client.command()
                client.send(ok(f"OK-{command}"))
                if command.startswith("StreamFrames") and "Stop" not in command and sender is None:
                    sender = asyncio.create_task(send())
        finally:
            if sender is not None:
                sender.cancel()

    return script


def health(gateway: MemoryGateway) -> tuple[int, dict[str, Any]]:
    page = health_page(gateway.gateway)
    return page.status, json.loads(page.body)


async def test_health_says_that_frames_come_and_are_all_rejected() -> None:
    contradictory = bytearray(markers_frame(1, (0.0, 0.0, 0.0)))
    contradictory[32:36] = (9).to_bytes(4, "big")  # announces 9 markers
    async with ScriptedServer(sending(bytes(contradictory))) as server, run_gateway(server.port) as gateway:
        text = "frames come, and all are rejected: 3d component of 40 bytes announces 9 items"
        await gateway.wait_until(lambda: health(gateway)[1]["streams"][0]["problem"] == text)
        status, body = health(gateway)
        assert (status, body["status"]) == (503, "unhealthy")
        assert body["reasons"][0] == f"lab (3d 6d analog force event): {text}"
        assert status_lines(gateway.gateway)[0].startswith(f"lab: {text}, lost in the last minute: ")


async def test_health_says_that_no_frame_has_a_component_of_the_stream() -> None:
    stream = {"components": (ComponentType.TOOLS,)}
    frame = markers_frame(1, (0.0, 0.0, 0.0))
    async with (
        ScriptedServer(sending(frame)) as server,
        run_gateway(server.port, streams=(stream,)) as gateway,
    ):
        text = "frames come, and none has a component of this stream (6d); the newest has 3d"
        await gateway.wait_until(lambda: health(gateway)[1]["streams"][0]["problem"].startswith(text))
        assert health(gateway)[0] == 503


async def test_a_rejected_frame_now_and_then_degrades_the_gateway() -> None:
    good, bad = markers_frame(1, (0.0, 0.0, 0.0)), packet(3, b"\xff" * 12)
    async with ScriptedServer(sending(good, bad)) as server, run_gateway(server.port) as gateway:
        await gateway.wait_until(lambda: health(gateway)[1]["status"] == "degraded")
        status, body = health(gateway)
        assert (status, body["healthy"]) == (200, True)
        [reason] = body["reasons"]
        assert reason.startswith("lab (3d 6d analog force event): lost in the last minute: ")
        assert reason.endswith(" (frame rejected)")


async def test_frames_that_the_server_numbered_and_did_not_send_are_counted() -> None:
    numbers = (*range(1, 301), *range(351, 401))

    async def script(client: Client) -> None:
        def answer(command: str) -> bytes:
            is_stream = command.startswith("StreamFrames") and "Stop" not in command
            frames = (markers_frame(number, (0.0, 0.0, 0.0)) for number in numbers) if is_stream else ()
            return ok(f"OK-{command}") + b"".join(frames)

        await client.commands(answer)

    async with ScriptedServer(script) as server, run_gateway(server.port) as gateway:
        await gateway.wait_until(gateway.status.losses.report)
        [loss] = gateway.status.losses.report()
        assert (loss.cause, loss.messages, loss.frames) == ("not sent by the server", 50, 50)
        assert health(gateway)[1]["status"] == "degraded"
        messages = await gateway.wait_for("3d", len(numbers))
        assert [message.sequence for message in messages] == list(range(len(numbers)))


# A process that stands still -----------------------------------------------------------------


class Lab:
    """A gateway process with ``backlog: latest``, and what a Zenoh subscriber receives from it."""

    def __init__(self, process: asyncio.subprocess.Process, metrics_port: int, log: Path) -> None:
        self.process = process
        self.log = log
        self._metrics_port = metrics_port
        self.messages: dict[str, list[Any]] = {"3d": [], "6d": [], "status": []}

    def receive(self, key: str, message: bytes) -> None:
        name = key.rpartition("/")[2]
        if name in self.messages:
            self.messages[name].append(decode(message))

    def losses(self) -> dict[str, tuple[int, int]]:
        """Return what the stream lost, from the newest status."""
        [stream] = self.messages["status"][-1].streams
        return {loss.cause: (loss.messages, loss.frames) for loss in stream.drops}

    def has_no_measurement(self) -> bool:
        [stream] = self.messages["status"][-1].streams
        return bool(stream.state == "no measurement")

    async def health(self) -> tuple[int, dict[str, Any]]:
        def get() -> tuple[int, dict[str, Any]]:
            connection = HTTPConnection("127.0.0.1", self._metrics_port, timeout=10)
            try:
                connection.request("GET", "/healthz")
                answer = connection.getresponse()
                return answer.status, json.loads(answer.read())
            finally:
                connection.close()

        return await asyncio.to_thread(get)


@asynccontextmanager
async def lab_process(folder: Path, port: int) -> AsyncIterator[Lab]:
    endpoint, metrics_port, log = free_endpoint(), free_port(), folder / "log"
    stream = {"components": ["3d", "6d"], "backlog": "latest"}
    configuration = {
        "sources": [{"name": "lab", "host": "127.0.0.1", "port": port, "streams": [stream]}],
        "zenoh": {"config": zenoh_keys("peer", listen=endpoint)},
        "lcm": {"enabled": False},
        "metrics": {"port": metrics_port},
    }
    file = folder / "gateway.yaml"
    file.write_text(yaml.safe_dump(configuration))
    with log.open("w") as stderr:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "gateway", "run", "--config", file), stderr=stderr
        )
    lab = Lab(process, metrics_port, log)
    session = open_zenoh("peer", connect=endpoint)
    try:
        session.declare_subscriber(
            "mocap/lab/*", lambda sample: lab.receive(str(sample.key_expr), sample.payload.to_bytes())
        )
        yield lab
    finally:
        session.close()
        if process.returncode is None:
            process.send_signal(signal.SIGTERM)
        async with asyncio.timeout(10):
            await process.wait()


def num_missing(numbers: list[int]) -> int:
    return numbers[-1] - numbers[0] + 1 - len(numbers)


async def test_skipped_frames_are_gaps_in_sequence_and_the_count_in_status_health_and_log(
    tmp_path: Path,
) -> None:
    scene = SyntheticScene(markers=4, tools=2, analog=0, plates=0, rate_hz=200)
    async with Simulator(scene) as simulator, lab_process(tmp_path, simulator.port) as lab:
        simulator.stop_measurement()  # until the subscriber is there
        await wait_until_async(lambda: lab.messages["status"])
        simulator.start_measurement()
        await wait_until_async(lambda: lab.messages["status"][-1].streams[0].clock.has_clock)
        lab.process.send_signal(signal.SIGSTOP)
        await asyncio.sleep(1.0)
        lab.process.send_signal(signal.SIGCONT)
        await wait_until_async(lab.losses)
        simulator.stop_measurement()  # from here on, nothing is skipped on a busy machine either
        await wait_until_async(lab.has_no_measurement)

        messages, frames = lab.losses()["skipped while behind"]
        assert frames > 50
        assert messages == 2 * frames
        for name in ("3d", "6d"):
            received = lab.messages[name]
            assert num_missing([message.sequence for message in received]) == frames
            assert num_missing([message.frame_number for message in received]) == frames

        status, body = await lab.health()
        amount = f"{messages} messages of {frames} frames (skipped while behind)"
        assert (status, body["status"]) == (200, "degraded")
        assert body["reasons"] == [f"lab (3d 6d): lost in the last minute: {amount}"]
        await wait_until_async(lambda: "nothing lost for 5 s" in lab.log.read_text())
        log = lab.log.read_text()
        ends = re.findall(r"(\d+) messages of (\d+) frames \(skipped while behind\)", log)
        assert sum(int(lost) for lost, _ in ends) == messages
        assert sum(int(lost) for _, lost in ends) == frames
        assert log.count("WARNING lab (3d 6d): frames arrive late and are skipped") == len(ends)
