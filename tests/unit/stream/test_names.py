"""Look-ups of host names: one thread per name, and late answers are kept."""

import asyncio
import socket
import threading

import pytest
import uvloop

from gateway.stream.names import MAX_ADDRESSES, is_address, look_up
from tests.unit.stream.conftest import Resolver


def num_look_ups(name: str) -> int:
    return sum(thread.name == f"look-up {name}" for thread in threading.enumerate())


async def give_up(name: str) -> None:
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.01):
            await look_up(name)


@pytest.mark.parametrize("host", ["192.0.2.20", "::1", "2001:db8::1", "fe80::1%eth0"])
def test_numbers_are_their_own_addresses(host: str, resolver: Resolver) -> None:
    assert is_address(host)
    assert uvloop.run(look_up(host)) == [host]
    assert resolver.names == []


def test_addresses_keep_their_order_and_are_limited(resolver: Resolver) -> None:
    resolver.addresses = ["127.0.0.9", *(f"127.0.0.{number}" for number in range(1, 20))]
    assert uvloop.run(look_up("many")) == resolver.addresses[:MAX_ADDRESSES]


def test_a_link_local_address_keeps_its_scope(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [(socket.AF_INET6, socket.SOCK_STREAM, 6, "", ("fe80::1", 0, 0, 2))]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    assert uvloop.run(look_up("lab-pc")) == ["fe80::1%2"]


def test_attempts_that_give_up_share_one_look_up(resolver: Resolver) -> None:
    async def attempts() -> None:
        resolver.answers.clear()
        for _ in range(5):
            await give_up("dead")
        await asyncio.gather(*(give_up("dead") for _ in range(5)))
        assert resolver.names == ["dead"]
        assert num_look_ups("dead") == 1

    uvloop.run(attempts())


def test_a_late_answer_serves_the_next_attempt_and_no_other(resolver: Resolver) -> None:
    async def attempts() -> None:
        resolver.answers.clear()
        await give_up("slow")
        resolver.answers.set()
        assert await look_up("slow") == ["127.0.0.1"]
        assert resolver.names == ["slow"]
        assert await look_up("slow") == ["127.0.0.1"]
        assert resolver.names == ["slow", "slow"]

    uvloop.run(attempts())


def test_attempts_at_the_same_time_share_the_answer(resolver: Resolver) -> None:
    async def attempts() -> None:
        first, second = await asyncio.gather(look_up("two"), look_up("two"))
        assert first == second == ["127.0.0.1"]
        assert resolver.names == ["two"]

    uvloop.run(attempts())


def test_an_error_is_not_kept(resolver: Resolver) -> None:
    async def attempts() -> None:
        resolver.error = socket.gaierror(socket.EAI_NONAME, "no")
        with pytest.raises(socket.gaierror):
            await look_up("new")
        resolver.error = None
        assert await look_up("new") == ["127.0.0.1"]

    uvloop.run(attempts())


def test_the_end_of_a_loop_does_not_wait_for_a_look_up(resolver: Resolver) -> None:
    resolver.answers.clear()
    uvloop.run(give_up("dead-at-the-end"))
    assert not resolver.answers.is_set()
