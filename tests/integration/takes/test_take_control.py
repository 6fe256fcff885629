"""``rtc3d-gateway take`` as a program of its own, with a gateway in this process."""

import asyncio
import json
import os
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from gateway.client.client import GatewayAddress, GatewayClient
from gateway.daemon.gateway import Gateway
from gateway.outputs.takes.folder import MAX_PIECE_BYTES, TakesFolder
from gateway.outputs.takes.settings import TakesSettings
from gateway.takes.files.event_log import EventLogReader
from gateway.takes.files.reader import TakeReader
from gateway.tools.display.live import LiveData
from gateway.tools.display.view.watched import WatchedSubscriber
from tests.support.errors import names
from tests.support.networks import free_endpoint, lcm_url
from tests.support.queried_gateway import ParameterServer, query, run_gateway, wait_until_cached, zenoh_peer
from tests.support.servers import ScriptedServer, markers_frame
from tests.support.takes import markers, write_take
from tests.support.waiting import wait_until_async

pytestmark = pytest.mark.netns

NAME = "große Aufnahme 1"


class Completed(NamedTuple):
    status: int
    stdout: str
    stderr: str


async def take(*arguments: str) -> Completed:
    """Run ``rtc3d-gateway take`` in another process, without blocking the event loop of this one."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "gateway", "take", *arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "COLUMNS": "200"},
    )
    stdout, stderr = await process.communicate()
    assert process.returncode is not None
    assert b"Traceback" not in stderr
    return Completed(process.returncode, stdout.decode(), stderr.decode())


async def error(*arguments: str, status: int = 1) -> str:
    """Run a command that fails, and return what it prints."""
    done = await take(*arguments)
    assert (done.status, done.stdout.strip("{}\n")) == (status, "")
    return done.stderr


class Lab(NamedTuple):
    server: ParameterServer
    gateway: Gateway
    endpoint: str
    url: str
    folder: Path

    def options(self, side: str = "zenoh") -> list[str]:
        """Return the options with which the command reaches this gateway on Zenoh or LCM."""
        lcm = ["--lcm", "--url", self.url, "--source", "lab"]
        return lcm if side == "lcm" else ["--connect", self.endpoint]

    async def send(self, count: int) -> None:
        """Let the gateway receive so many frames."""
        for number in range(count):
            self.server.send(markers_frame(number))
        [source] = self.gateway.sources
        await wait_until_async(lambda: source.statuses[0].frames_in >= count)


@asynccontextmanager
async def lab(folder: Path, **takes: Any) -> AsyncIterator[Lab]:
    server, endpoint, url = ParameterServer(), free_endpoint(), lcm_url()
    folder.mkdir(exist_ok=True)  # noqa: ASYNC240 - of the test
    settings = TakesSettings.model_validate({"enabled": True, "directory": str(folder), **takes})
    options: dict[str, Any] = {"listen": endpoint, "lcm_url": url, "takes": settings}
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, remote_control=True, **options) as gateway,
    ):
        await wait_until_cached(gateway)
        await wait_until_async(lambda: all(output.health().connected for output in gateway.outputs))
        yield Lab(server, gateway, endpoint, url, folder)


def num_frames(path: Path) -> int:
    """Return how many frames with markers a take has."""
    return sum(message.key == "3d" for message in TakeReader(path).messages())


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
async def test_the_view_learns_which_take_is_running_while_a_page_is_open(tmp_path: Path, side: str) -> None:
    async with lab(tmp_path / "takes") as at:
        live, pages = LiveData(), [1]
        client = GatewayClient(GatewayAddress(side == "lcm", connect=at.endpoint, url=at.url))
        subscribe = partial(client.subscribe, (), None, live)
        watched = await asyncio.to_thread(
            WatchedSubscriber, live, subscribe, lambda: pages, takes_period_s=0.05
        )

        def shown() -> str | None:
            live.update()
            watched.tick()
            return live.sources_now[0].running_take if live.sources_now else None

        await wait_until_async(lambda: shown() == "")
        await asyncio.to_thread(client.start_take, NAME, source="lab")
        await wait_until_async(lambda: shown() == NAME)
        await asyncio.to_thread(client.stop_take, source="lab")
        await wait_until_async(lambda: shown() == "")
        watched.close()


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
async def test_takes_are_started_listed_and_stopped_or_errors_say_why(tmp_path: Path, side: str) -> None:
    async with lab(tmp_path / "takes") as at:
        options = at.options(side)
        assert names(await error("stop", *options), "no take", "'lab'")
        assert names(await error("start", "x;set=stop", *options, status=2), "name", "x;set=stop")
        assert await take("start", NAME, *options) == (0, f"lab: take {NAME!r} is running\n", "")
        await at.send(10)
        listed = await take("list", *options)
        assert (listed.status, listed.stderr) == (0, "")
        [row] = [line for line in listed.stdout.splitlines() if NAME in line]
        assert "running" in row
        content = json.loads((await take("stop", *options, "--json")).stdout)["lab"]
        assert (content["name"], content["is_running"], content["lost"]) == (NAME, False, 0)
        path = at.folder / "lab" / f"{NAME}.lcmlog"
        assert (content["bytes"], num_frames(path)) == (path.stat().st_size, 10)
        [only] = json.loads((await take("list", "--json", *options)).stdout)["lab"]["takes"]
        assert {"source": "lab", **only} == content


async def test_the_last_seconds_are_saved_and_fetched_as_one_file(tmp_path: Path) -> None:
    async with lab(tmp_path / "takes", keep_last_s=60.0) as at:
        await at.send(10)
        saved = await take("save", "fall", "--last", "30", *at.options())
        assert (saved.status, saved.stderr) == (0, "")
        assert names(saved.stdout, "lab", "'fall'")
        fetched = await take("fetch", "fall", str(tmp_path), *at.options())
        assert (fetched.status, fetched.stderr) == (0, "")
    assert num_frames(tmp_path / "fall.lcmlog") == num_frames(tmp_path / "takes/lab/fall") >= 10


def write_walk(folder: Path, num_markers: int = 1) -> bytes:
    """Write the take "walk" into a folder of takes, and return its bytes."""
    (folder / "lab").mkdir(parents=True)
    path = write_take(folder / "lab/walk.lcmlog", (markers(num_markers, number) for number in range(600)))
    return path.read_bytes()


@pytest.fixture
async def walk(tmp_path: Path) -> AsyncIterator[tuple[Lab, bytes]]:
    """A gateway with the take "walk" of several pieces, and its bytes."""
    content = write_walk(tmp_path / "takes", 300)
    assert len(content) > 2 * MAX_PIECE_BYTES
    async with lab(tmp_path / "takes") as at:
        yield at, content


async def test_takes_that_grow_shrink_or_are_read_late_are_fetched_as_far_as_they_are_complete(
    tmp_path: Path, walk: tuple[Lab, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    at, content = walk
    fetch = ("fetch", "walk", str(tmp_path), *at.options())
    copy, read, loop = tmp_path / "walk.lcmlog", TakesFolder.read, asyncio.get_running_loop()

    offsets: list[int] = []
    released = asyncio.Event()

    def read_late_once(folder: TakesFolder, source: str, name: str, offset: int) -> Any:
        offsets.append(offset)
        if offset and len(offsets) == 2:
            loop.call_soon_threadsafe(loop.call_later, 3, released.set)
            asyncio.run_coroutine_threadsafe(released.wait(), loop).result(60)
        return read(folder, source, name, offset)

    monkeypatch.setattr(TakesFolder, "read", read_late_once)
    fetched = await take(*fetch, "--timeout", "2")
    assert (fetched.status, fetched.stderr) == (0, "")
    assert copy.read_bytes() == content
    assert MAX_PIECE_BYTES in offsets
    assert names(await error(*fetch), "walk.lcmlog", "exists already")
    copy.unlink()

    half = len(content) // 2 + 1000
    sizes: Iterator[int] = iter([half])  # while the first piece is read; the take then grows

    def read_while_it_grows(folder: TakesFolder, source: str, name: str, offset: int) -> Any:
        return read(folder, source, name, offset)._replace(num_bytes=next(sizes, len(content)))

    monkeypatch.setattr(TakesFolder, "read", read_while_it_grows)
    assert names((await take(*fetch)).stdout, "still running")
    reader = EventLogReader(copy)
    assert list(reader.events())
    assert reader.damaged_bytes == 0
    assert 0 < half - copy.stat().st_size < 10_000
    assert content.startswith(copy.read_bytes())
    copy.unlink()

    def read_and_cut(folder: TakesFolder, source: str, name: str, offset: int) -> Any:
        piece = read(folder, source, name, offset)
        os.truncate(at.folder / "lab/walk.lcmlog", MAX_PIECE_BYTES)
        return piece

    monkeypatch.setattr(TakesFolder, "read", read_and_cut)
    assert names(await error(*fetch), "shorter")
    missing = await error("fetch", "run", str(tmp_path), *at.options())
    assert names(missing, "'lab'", "'run'")
    assert [path.name for path in tmp_path.iterdir()] == ["takes"]  # noqa: ASYNC240


async def test_a_take_in_several_sources_needs_the_source(tmp_path: Path) -> None:
    for folder in ("takes", "others"):
        write_walk(tmp_path / folder)
    async with lab(tmp_path / "takes") as at, lab(tmp_path / "others") as other:
        # Zenoh waits for the connections of a peer at most for the delay of scouting.
        keys = {
            "mode": "peer",
            "connect": {"endpoints": [at.endpoint, other.endpoint]},
            "scouting": {"delay": 30_000, "multicast": {"enabled": False}},
        }
        config = tmp_path / "both.json5"
        config.write_text(json.dumps(keys))
        several = await error("fetch", "walk", str(tmp_path), "--zenoh-config", str(config))
        assert names(several, "'walk'", "lab, lab_2", "--source")


async def test_no_wildcard_starts_stops_or_saves_a_take(tmp_path: Path) -> None:
    async with lab(tmp_path / "takes", keep_last_s=60.0) as at:
        with zenoh_peer(at.endpoint) as peer:
            for key in ("mocap/*/take", "mocap/lab/*", "mocap/**", "**", "mocap/lab/ta$*"):
                for action in ("start", "save", "stop"):
                    reply = await query(peer, f"{key}?set={action}")
                    assert reply.code == "bad-request", (key, action)
            expected = "take needs the name of one source, not a wildcard; accepted: mocap/lab/take"
            assert (await query(peer, "mocap/*/take")).error == expected
            assert (await query(peer, "mocap/lab/take")).json["takes"] == []
    assert list((tmp_path / "takes/lab").glob("*")) == []
