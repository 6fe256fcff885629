"""``rtc3d-gateway take`` as a program of its own, with a gateway in this process."""

import asyncio
import json
import os
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from gateway.gateway import Gateway
from gateway.outputs.takes.folder import TakesFolder
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.takes.stored import MAX_PIECE_BYTES
from gateway.takes.event_log import EventLogReader
from gateway.takes.reader import TakeReader
from tests.networks import free_endpoint, lcm_url
from tests.queried_gateway import ParameterServer, query, run_gateway, wait_until_cached, zenoh_peer
from tests.servers import ScriptedServer, markers_frame
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns

NAME = "große Aufnahme 1"


class Completed(NamedTuple):
    status: int
    stdout: str
    stderr: str


async def take(*arguments: str, cwd: Path | None = None) -> Completed:
    """Run ``rtc3d-gateway take`` in another process, without blocking the event loop of this one."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "gateway", "take", *arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=cwd,
        env={**os.environ, "COLUMNS": "200"},
    )
    stdout, stderr = await process.communicate()
    assert process.returncode is not None
    assert b"Traceback" not in stderr
    return Completed(process.returncode, stdout.decode(), stderr.decode())


class Lab(NamedTuple):
    server: ParameterServer
    gateway: Gateway
    endpoint: str
    url: str
    folder: Path

    def options(self, side: str) -> list[str]:
        """Return the options with which the command reaches this gateway on Zenoh or LCM."""
        lcm = ["--lcm", "--url", self.url, "--source", "lab"]
        return lcm if side == "lcm" else ["--connect", self.endpoint]

    def path(self, name: str) -> Path:
        return self.folder / "lab" / f"{name}.lcmlog"


@asynccontextmanager
async def lab(
    folder: Path, takes: dict[str, Any] | None = None, *, remote_control: bool = True
) -> AsyncIterator[Lab]:
    server, endpoint, url = ParameterServer(), free_endpoint(), lcm_url()
    folder.mkdir(exist_ok=True)  # noqa: ASYNC240 - of the test
    settings = TakesSettings.model_validate({"enabled": True, "directory": str(folder), **(takes or {})})
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(
            listening.port, listen=endpoint, lcm_url=url, takes=settings, remote_control=remote_control
        ) as gateway,
    ):
        await wait_until_cached(gateway)
        await wait_until_async(lambda: all(output.health().connected for output in gateway.outputs))
        yield Lab(server, gateway, endpoint, url, folder)


def markers(path: Path) -> int:
    """Return how many frames with markers a take has."""
    return sum(message.key == "3d" for message in TakeReader(path).messages())


sides = pytest.mark.parametrize("side", ["zenoh", "lcm"])


@sides
async def test_a_take_is_started_listed_and_stopped(tmp_path: Path, side: str) -> None:
    async with lab(tmp_path / "takes") as at:
        started = await take("start", NAME, *at.options(side))
        assert started == (0, f"lab: take {NAME!r} is running\n", "")
        for number in range(10):
            at.server.send(markers_frame(number))
        listed = await take("list", *at.options(side))
        assert (listed.status, listed.stderr) == (0, "")
        [row] = [line for line in listed.stdout.splitlines() if NAME in line]
        assert "running" in row
        stopped = await take("stop", *at.options(side), "--json")
        content = json.loads(stopped.stdout)["lab"]
        assert (content["name"], content["is_running"], content["lost"]) == (NAME, False, 0)
        assert content["bytes"] == at.path(NAME).stat().st_size
        assert markers(at.path(NAME)) == 10
        listed = await take("list", "--json", *at.options(side))
        [only] = json.loads(listed.stdout)["lab"]["takes"]
        assert only == {key: value for key, value in content.items() if key != "source"}


@sides
async def test_errors_say_what_to_do(tmp_path: Path, side: str) -> None:
    async with lab(tmp_path / "takes") as at:
        errors = {
            ("stop",): "no take of source 'lab' is running",
            ("save",): "takes.keep_last_s is 0",
            ("start", "../x"): "'../x' cannot be the name of a take: expected 1 to 100 letters",
            ("start", "x;set=stop"): "cannot be the name of a take",
        }
        for arguments, text in errors.items():
            done = await take(*arguments, *at.options(side))
            assert (done.status, done.stdout) == (1, "")
            assert text in done.stderr
    async with lab(tmp_path / "others", remote_control=False) as at:
        done = await take("start", *at.options(side))
        assert (done.status, done.stdout) == (1, "")
        assert "set remote_control: true" in done.stderr
        assert (await take("list", *at.options(side))).status == 0
    async with lab(tmp_path / "none", {"enabled": False}) as at:
        results = await asyncio.gather(*(take(command, *at.options(side)) for command in ("start", "list")))
        for done in results:
            assert (done.status, done.stdout.strip("{}\n")) == (1, "")
            assert "set takes.enabled: true" in done.stderr


@sides
async def test_no_gateway_is_status_3(side: str) -> None:
    options = ["--connect", free_endpoint()] if side == "zenoh" else ["--lcm", "--url", lcm_url()]
    done = await take("start", *options)
    assert (done.status, done.stdout) == (3, "")
    assert "gateway" in done.stderr
    assert done.stderr.count("\n") == 1


async def test_the_last_seconds_are_saved_and_fetched_as_one_file(tmp_path: Path) -> None:
    async with lab(tmp_path / "takes", {"keep_last_s": 60.0}) as at:
        for number in range(10):
            at.server.send(markers_frame(number))
        [source] = at.gateway.sources
        await wait_until_async(lambda: source.statuses[0].frames_in >= 10)
        saved = await take("save", "fall", "--last", "30", *at.options("zenoh"))
        assert saved.status == 0
        assert saved.stdout.startswith("lab: take 'fall' is saved: ")
        fetched = await take("fetch", "fall", *at.options("zenoh"), cwd=tmp_path)
        assert (fetched.status, fetched.stderr) == (0, "")
    assert markers(tmp_path / "fall.lcmlog") == markers(tmp_path / "takes/lab/fall") >= 10


async def long_take(at: Lab, name: str = "walk") -> bytes:
    """Put a take of several pieces into the folder, and return its bytes."""
    assert (await take("start", name, *at.options("zenoh"))).status == 0
    for number in range(600):
        at.server.send(markers_frame(number, *[(1.0, 2.0, 3.0)] * 300))
    [source] = at.gateway.sources
    await wait_until_async(lambda: source.statuses[0].frames_in >= 600)
    assert (await take("stop", *at.options("zenoh"))).status == 0
    content = at.path(name).read_bytes()
    assert len(content) > 2 * MAX_PIECE_BYTES
    return content


async def test_a_fetched_take_has_the_same_bytes_and_replaces_nothing(tmp_path: Path) -> None:
    async with lab(tmp_path / "takes") as at:
        content = await long_take(at)
        fetched = await take("fetch", "walk", str(tmp_path), *at.options("zenoh"))
        assert (fetched.status, fetched.stderr) == (0, "")
        assert (tmp_path / "walk.lcmlog").read_bytes() == content
        again = await take("fetch", "walk", str(tmp_path), *at.options("zenoh"))
        assert (again.status, again.stdout) == (1, "")
        assert "walk.lcmlog exists already, and nothing is overwritten" in again.stderr
        missing = await take("fetch", "run", *at.options("zenoh"), cwd=tmp_path)
        assert (missing.status, missing.stdout) == (1, "")
        assert "source 'lab' has no take 'run'" in missing.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["takes", "walk.lcmlog"]  # noqa: ASYNC240


async def test_of_a_running_take_the_complete_events_are_fetched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with lab(tmp_path / "takes") as at:
        content = await long_take(at)
        sizes = iter([len(content) // 2 + 1000])  # while the first piece is read; the take then grows
        read = TakesFolder.read

        def read_while_it_grows(folder: TakesFolder, source: str, name: str, offset: int) -> Any:
            return read(folder, source, name, offset)._replace(num_bytes=next(sizes, len(content)))

        monkeypatch.setattr(TakesFolder, "read", read_while_it_grows)
        fetched = await take("fetch", "walk", str(tmp_path), *at.options("zenoh"))
        assert fetched.status == 0
        assert "which is still running" in fetched.stdout
    copy = tmp_path / "walk.lcmlog"
    reader = EventLogReader(copy)
    assert list(reader.events())
    assert reader.damaged_bytes == 0
    size = copy.stat().st_size
    assert 0 < len(content) // 2 + 1000 - size < 10_000
    assert content.startswith(copy.read_bytes())


async def test_a_take_that_becomes_shorter_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with lab(tmp_path / "takes") as at:
        await long_take(at)
        read = TakesFolder.read

        def read_and_cut(folder: TakesFolder, source: str, name: str, offset: int) -> Any:
            piece = read(folder, source, name, offset)
            os.truncate(at.path(name), MAX_PIECE_BYTES)
            return piece

        monkeypatch.setattr(TakesFolder, "read", read_and_cut)
        fetched = await take("fetch", "walk", str(tmp_path), *at.options("zenoh"))
        assert (fetched.status, fetched.stdout) == (1, "")
        assert "became shorter while it was copied" in fetched.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["takes"]  # noqa: ASYNC240


async def test_a_piece_without_a_reply_is_requested_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with lab(tmp_path / "takes") as at:
        content = await long_take(at)
        read, offsets = TakesFolder.read, []
        released = asyncio.Event()

        def read_late_once(folder: TakesFolder, source: str, name: str, offset: int) -> Any:
            offsets.append(offset)
            if offset and len(offsets) == 2:
                asyncio.run_coroutine_threadsafe(released.wait(), loop).result(60)
            return read(folder, source, name, offset)

        async def release_when_given_up() -> None:
            await asyncio.sleep(3)
            released.set()

        loop = asyncio.get_running_loop()
        monkeypatch.setattr(TakesFolder, "read", read_late_once)
        releasing = asyncio.create_task(release_when_given_up())
        fetched = await take("fetch", "walk", str(tmp_path), "--timeout", "2", *at.options("zenoh"))
        await releasing
        assert (fetched.status, fetched.stderr) == (0, "")
        assert (tmp_path / "walk.lcmlog").read_bytes() == content
    assert MAX_PIECE_BYTES in offsets


async def test_a_take_in_several_sources_needs_the_source(tmp_path: Path) -> None:
    async with lab(tmp_path / "takes") as at, lab(tmp_path / "others") as other:
        assert (await take("start", "walk", *at.options("zenoh"))).status == 0
        assert (await take("start", "walk", *other.options("zenoh"))).status == 0
        # Zenoh waits for the connections of a peer at most for the delay of scouting.
        keys = {
            "mode": "peer",
            "connect": {"endpoints": [at.endpoint, other.endpoint]},
            "scouting": {"delay": 30_000, "multicast": {"enabled": False}},
        }
        config = tmp_path / "both.json5"
        config.write_text(json.dumps(keys))
        fetched = await take("fetch", "walk", str(tmp_path), "--zenoh-config", str(config))
        assert (fetched.status, fetched.stdout) == (1, "")
        assert "several sources have a take 'walk': lab, lab_2; choose with --source" in fetched.stderr


async def test_no_wildcard_starts_stops_or_saves_a_take(tmp_path: Path) -> None:
    async with lab(tmp_path / "takes", {"keep_last_s": 60.0}) as at:
        with zenoh_peer(at.endpoint) as peer:
            for key in ("mocap/*/take", "mocap/lab/*", "mocap/**", "**", "mocap/lab/ta$*"):
                for action in ("start", "save", "stop"):
                    reply = await query(peer, f"{key}?set={action}")
                    assert reply.code == "bad-request", (key, action)
            assert (await query(peer, "mocap/*/take")).error == (
                "take needs the name of one source, not a wildcard; accepted: mocap/lab/take"
            )
            assert (await query(peer, "mocap/lab/take")).json["takes"] == []
    assert list((tmp_path / "takes/lab").glob("*")) == []
