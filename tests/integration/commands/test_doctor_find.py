"""``doctor --find``: which RT servers it finds on the usual ports, and that it disturbs nobody."""

import asyncio
import json
import shlex
import signal
import socket
import struct
from collections import Counter
from contextlib import AsyncExitStack, ExitStack
from typing import Final

import pytest

from gateway.tools.doctor.search import Found, SearchResult, parse_hosts, result_lines, search
from tests.support.commands import run, run_in_process
from tests.support.errors import names
from tests.support.gateway_process import PROGRAM
from tests.support.needs import need_ipv6
from tests.support.pseudo_terminals import in_terminal
from tests.support.servers import Client, Script, ScriptedServer, error, markers_frame, ok

pytestmark = pytest.mark.netns

NUM_HOSTS: Final = 254  # of a /24


async def rt_server(client: Client) -> None:
    await client.commands(lambda command: ok(f"OK-{command}"))


async def refusing(client: Client) -> None:
    await client.commands(lambda _command: error("err-unknown command"))


async def silent(client: Client) -> None:
    await client.commands(lambda _command: None)


async def web_server(client: Client) -> None:
    client.send(b"HTTP/1.1 400 Bad Request\r\n\r\n")
    await client.command()


async def closing(client: Client) -> None:
    await client.command()
    client.cut()


async def streaming_at_once(client: Client) -> None:
    client.send(markers_frame(1, (1.0, 2.0, 3.0)))
    await silent(client)


async def found_on(text: str) -> SearchResult:
    return await search(parse_hosts(text), lambda *_: None)


async def answer_of(script: Script) -> Found:
    """Return what is found on port 3020 of a host where a server runs ``script``."""
    async with ScriptedServer(script, 3020):
        [found] = (await found_on("127.0.0.1")).found
    return found


async def test_everything_that_listens_in_a_subnet_is_reported() -> None:
    """Both usual ports of each address are tried once, and the report is in the order of the addresses."""
    servers: dict[tuple[str, int], Script] = {
        ("127.0.0.2", 3020): rt_server,
        ("127.0.0.2", 3030): silent,
        ("127.0.0.5", 3030): refusing,
        ("127.0.0.7", 3020): web_server,
        ("127.0.0.9", 3020): closing,
    }
    shown: list[tuple[int, int]] = []
    async with AsyncExitStack() as stack:
        running = [
            await stack.enter_async_context(ScriptedServer(script, port, host))
            for (host, port), script in servers.items()
        ]
        stack.enter_context(socket.create_server(("127.0.0.3", 3021)))  # not a usual port
        result = await search(
            parse_hosts("127.0.0.0/24"), lambda _what, done, total: shown.append((done, total))
        )
    assert [(each.host, each.port) for each in result.found] == list(servers)
    assert [each.is_rt_server for each in result.found] == [True, False, True, False, False]
    assert names(result.found[0].text, "OK-Version 1.0")
    assert names(result.found[2].text, "err-unknown command")
    assert names(result.found[3].text, "'HTTP/1.1 400 Bad Request")
    assert [server.connections for server in running] == [1] * len(servers)
    assert result.num_hosts == NUM_HOSTS
    assert result.failures == Counter({"Connection refused": 2 * NUM_HOSTS - len(servers)})
    assert len(set(shown)) == 2 * NUM_HOSTS
    assert shown[-1] == (2 * NUM_HOSTS, 2 * NUM_HOSTS)


async def test_a_server_is_asked_for_its_version_only() -> None:
    """It never streams, and says Bye."""
    received: list[str] = []

    async def noting(client: Client) -> None:
        def answer(command: str) -> bytes:
            received.append(command)
            return ok(f"OK-{command}")

        await client.commands(answer)

    assert (await answer_of(noting)).is_rt_server
    assert received == ["Version 1.0", "Bye"]


async def test_a_server_that_only_sends_frames_is_an_rt_server() -> None:
    assert (await answer_of(streaming_at_once)).is_rt_server


async def test_a_long_file_does_not_hold_up_the_search() -> None:
    """A session waits for the end of a C3D file before it gives up on a reply; the search does not."""
    file_bytes, num_sent = 200_000_000, 0

    async def sending_a_file(client: Client) -> None:
        nonlocal num_sent
        client.send(struct.pack(">II", file_bytes, 5))
        while num_sent < file_bytes:  # which takes far longer than a reply may take
            client.send(bytes(100))
            num_sent += 100
            await client.drain()
        client.end()
        await client.command()

    assert not (await answer_of(sending_a_file)).is_rt_server
    assert 0 < num_sent < file_bytes


async def test_a_hostile_reply_is_short_and_printable() -> None:
    found = await answer_of(lambda client: client.commands(lambda _command: ok("OK \x1b[2J" + 9999 * "x")))
    assert found.is_rt_server
    assert found.text.isprintable()
    assert len(found.text) == 200


async def test_a_listener_whose_queue_is_full_gives_no_answer() -> None:
    """As a host that is off, or a firewall that drops packets."""
    with ExitStack() as stack:
        full = stack.enter_context(socket.create_server(("127.0.0.1", 3020), backlog=0))
        for _ in range(4):
            waiting = stack.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(full.getsockname())
        result = await found_on("127.0.0.1")
    assert result.found == []
    assert result.failures == Counter({"no answer within 1 s": 1, "Connection refused": 1})


async def test_there_are_at_most_32_connections_at_a_time() -> None:
    """Each waits for its reply until there are 32, so with more there would be more."""
    open_now = most = 0
    many = asyncio.Event()

    async def counting(client: Client) -> None:
        nonlocal open_now, most
        open_now += 1
        most = max(most, open_now)
        if open_now >= 32:
            many.set()
        try:
            await client.command()
            await many.wait()
            client.send(ok("OK"))
            client.end()
            await client.command()  # Bye
        finally:
            open_now -= 1

    async with ScriptedServer(counting, 3020, "0.0.0.0"):  # noqa: S104 - in a namespace of its own
        result = await found_on("127.0.0.0/25")
    assert len(result.found) == 126
    assert most == 32


def resolve(monkeypatch: pytest.MonkeyPatch, *addresses: str) -> None:
    """Let each host name but invalid ones have these addresses."""

    def look_up(host: str, *_: object, **__: object) -> list[tuple[object, ...]]:
        if host.endswith(".invalid"):
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, 0)) for address in addresses]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)


@pytest.mark.parametrize(
    ("hosts", "found"), [("lab-pc,127.0.0.1", "127.0.0.1"), ("lab-pc,lab-pc.example", "lab-pc")]
)
async def test_a_host_with_two_names_gets_one_connection(
    monkeypatch: pytest.MonkeyPatch, hosts: str, found: str
) -> None:
    """Some servers serve one client only; the search must not be the second one itself."""
    resolve(monkeypatch, "127.0.0.1")
    async with ScriptedServer(rt_server, 3020) as server:
        result = await found_on(hosts)
    assert [(each.host, each.is_rt_server) for each in result.found] == [(found, True)]
    assert server.connections == 1


async def test_a_name_is_tried_at_each_of_its_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    resolve(monkeypatch, "127.0.0.9", "127.0.0.2")
    async with ScriptedServer(rt_server, 3030, "127.0.0.2"):
        result = await found_on("lab-pc,no-such-host.invalid")
    assert [each.server for each in result.found] == ["lab-pc:3030"]
    assert result.num_hosts == 1
    [unknown] = result.unknown
    assert names(unknown, "'no-such-host.invalid'", "Name or service not known")


async def test_the_next_command_can_be_pasted_into_a_shell() -> None:
    need_ipv6()
    async with ScriptedServer(rt_server, 3020, "::1"), ScriptedServer(rt_server, 3030, "127.0.0.2"):
        lines = list(result_lines(await found_on("::1,127.0.0.2")))
    commands = [shlex.split(line) for line in lines if line.startswith(" ")]
    assert commands == [
        ["rtc3d-gateway", "doctor", "--server", "[::1]:3020"],
        ["rtc3d-gateway", "doctor", "--server", "127.0.0.2:3030"],
    ]
    assert any("'[::1]:3020'" in line for line in lines)  # brackets are a pattern to the shell


async def test_the_command_ends_with_success_if_there_is_an_rt_server() -> None:
    async with ScriptedServer(rt_server, 3020, "127.0.0.2"), ScriptedServer(web_server, 3030, "127.0.0.3"):
        text = await run("doctor", "--find", "127.0.0.0/29")
        as_json = await run("doctor", "--find", "127.0.0.2, 127.0.0.3", "--json")
    assert (text.status, text.stderr) == (as_json.status, as_json.stderr) == (0, "")
    assert names(text.stdout, "rtc3d-gateway doctor --server 127.0.0.2:3020", "127.0.0.3:3030")
    content = json.loads(as_json.stdout)
    assert [(each["server"], each["is_rt_server"]) for each in content.pop("found")] == [
        ("127.0.0.2:3020", True),
        ("127.0.0.3:3030", False),
    ]
    assert content == {
        "ok": True,
        "num_hosts": 2,
        "ports": [3020, 3030],
        "unknown": [],
        "failures": {"Connection refused": 2},
    }


async def test_the_command_fails_if_there_is_no_rt_server() -> None:
    async with ScriptedServer(web_server, 3020, "127.0.0.2"):
        text = await run("doctor", "--find", "127.0.0.0/29")
        as_json = await run("doctor", "--find", "127.0.0.2", "--json")
    assert text.status == as_json.status == 1
    assert names(text.stdout, "6 hosts", "3020", "3030", "11 ports", "firewall")
    assert json.loads(as_json.stdout)["ok"] is False


@pytest.mark.parametrize(
    "hosts", ["", "192.0.2.1,,", "192.0.2.1:3020", "[::1]", "a b", "192.0.2.0/33", "fe80::%eth0/120"]
)
def test_what_names_no_host_is_a_usage_error(hosts: str) -> None:
    ended = run_in_process("doctor", "--find", hosts)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert names(ended.stderr, "--find")


@pytest.mark.parametrize("hosts", ["192.0.2.0/23", "192.0.2.0/24,198.51.100.0/24", "2001:db8::/64"])
def test_too_many_addresses_are_a_usage_error(hosts: str) -> None:
    ended = run_in_process("doctor", "--find", hosts)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert names(ended.stderr, "256")


@pytest.mark.parametrize(
    "options",
    [
        ("--server", "127.0.0.1"),
        ("--config", "lab.yaml"),
        ("--no-connect",),
        ("--subscriber",),
        ("--exposure",),
        ("--view", "127.0.0.1"),
        ("--source", "lab"),
        ("--lcm",),
        ("--quiet",),
        ("--seconds", "4"),
        ("--connect", "tcp/127.0.0.1:7447"),
        ("--zenoh-config", "/nowhere"),
    ],
)
def test_other_options_are_a_usage_error(options: tuple[str, ...]) -> None:
    ended = run_in_process("doctor", "--find", "127.0.0.1", *options)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert names(ended.stderr, "--find", "--json", "--verbose")


def test_a_terminal_shows_the_progress() -> None:
    """A subnet can take 20 s. Without a terminal, nothing but the result is printed; see above."""
    with in_terminal("doctor", "--find", "127.0.0.0/28") as terminal:
        assert terminal.wait_for_end() == 1
    assert b"trying ports" in terminal.output


async def test_ctrl_c_ends_the_search_at_once() -> None:
    """While a server has not answered yet: the search prints nothing, and waits for no Bye."""
    asked, ended = asyncio.Event(), asyncio.Event()
    later: list[str] = []

    async def waiting(client: Client) -> None:
        await client.command()
        asked.set()
        try:
            later.append(await client.command())
        finally:
            ended.set()

    async with ScriptedServer(waiting, 3020):
        process = await asyncio.create_subprocess_exec(
            *(*PROGRAM, "doctor", "--find", "127.0.0.1"), stdout=-1, stderr=-1
        )
        await asked.wait()
        process.send_signal(signal.SIGINT)
        written = await process.communicate()
        await ended.wait()
    assert (process.returncode, *written) == (130, b"", b"")
    assert later == []
