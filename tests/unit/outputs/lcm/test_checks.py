"""The doctor's findings about LCM: results, and the values in them."""

import socket
from typing import Any

import pytest

from gateway.outputs.findings import Finding, MessageLoad, Result
from gateway.outputs.lcm import checks
from gateway.outputs.lcm.checks import charged_bytes, check_lcm
from gateway.outputs.lcm.settings import LcmSettings
from tests.support.errors import names
from tests.support.findings import is_finding
from tests.support.networks import add_multicast_route, lan_interface, lcm_url, remove_multicast_route

LOADS = (MessageLoad(rate_hz=100.0, largest_bytes=8000), MessageLoad(rate_hz=50.0, largest_bytes=1000))
URL = "udpm://239.255.76.67:7667?ttl=0"


def found(url: str | None, *loads: MessageLoad) -> tuple[Finding, Finding]:
    route, _, buffers = check_lcm(LcmSettings(url=url), ("lab",), loads, 0.1)
    return route, buffers


@pytest.fixture
def buffer_bytes(monkeypatch: pytest.MonkeyPatch) -> dict[int | None, int]:
    """What the kernel grants for each size that a socket requests; None requests nothing."""
    granted: dict[int | None, int] = {None: 212_992, 2**30: 425_984}
    monkeypatch.setattr(checks, "receive_buffer_bytes", granted.__getitem__)
    return granted


def test_memory_needs_neither_multicast_nor_a_buffer() -> None:
    route, buffers = found("memq://", *LOADS)
    assert is_finding(route, "lcm", "route", Result.PASSING, "memq")
    assert is_finding(buffers, "lcm", "buffers", Result.NOT_TESTED, "memq")


def test_a_relay_that_does_not_run_fails() -> None:
    route, buffers = found("tcpq://127.0.0.1:9")
    assert is_finding(route, "lcm", "route", Result.FAILING, "tcpq://127.0.0.1:9", remedy=["lcm.url"])
    assert is_finding(buffers, "lcm", "buffers", Result.NOT_TESTED, "tcpq")


@pytest.mark.netns
@pytest.mark.parametrize(
    ("query", "ttl"), [("", "ttl=0"), ("?ttl=1", "ttl=1"), ("?recv_buf_size=9&ttl=12", "ttl=12")]
)
def test_multicast_that_works_passes_with_its_reach(query: str, ttl: str) -> None:
    address = lcm_url().partition("?")[0]
    route, _ = found(address + query)
    name = address.removeprefix("udpm://")
    assert is_finding(route, "lcm", "route", Result.PASSING, name, ttl)
    route, _ = found("udpm://" + query)
    assert is_finding(route, "lcm", "route", Result.PASSING, ttl)


@pytest.mark.netns
def test_a_url_that_lcm_rejects_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """The configuration does not check the environment variable."""
    url = "udpm://not-an-address:7667"
    monkeypatch.setenv("LCM_DEFAULT_URL", url)
    route, _ = found(None)
    assert is_finding(route, "lcm", "route", Result.FAILING, url, remedy=["lcm.url"])


def test_a_remedy_begins_with_a_capital_letter_and_keeps_its_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "multicast_problem", lambda url: f"no multicast to {url}; add; a route")
    route, _ = found(URL)
    assert route == Finding("lcm", "route", Result.FAILING, f"no multicast to {URL}", "Add; a route.")


RARE = (MessageLoad(rate_hz=1.0, largest_bytes=8000),)


@pytest.mark.netns
class TestBuffers:
    @pytest.mark.parametrize(
        ("loads", "needed", "kib"),
        [
            pytest.param(LOADS, 2 * 16_640 + 2_304, 35, id="a pause of 20 ms"),
            pytest.param(RARE, 2 * 16_640, 32, id="two of the largest"),
        ],
    )
    def test_a_pause_of_20_ms_and_two_of_the_largest_messages_must_fit(
        self, buffer_bytes: dict[int | None, int], loads: tuple[MessageLoad, ...], needed: int, kib: int
    ) -> None:
        """In the bytes that the kernel charges, to the byte."""
        assert (charged_bytes(8000), charged_bytes(1000)) == (16_640, 2_304)
        values = (f"{kib} KiB", "20 ms", 8000)
        buffer_bytes[None] = needed
        assert is_finding(found(URL, *loads)[1], "lcm", "buffers", Result.PASSING, *values)
        buffer_bytes[None] = needed - 1
        failing = found(URL, *loads)[1]
        remedy = [f"recv_buf_size={needed // 2}"]
        assert is_finding(failing, "lcm", "buffers", Result.FAILING, *values, remedy=remedy)

    def test_a_limit_of_the_kernel_is_named_with_the_command_that_raises_it(
        self, buffer_bytes: dict[int | None, int]
    ) -> None:
        buffer_bytes |= {None: 100, 2**30: 2 * 16_640 + 2_304}
        assert "sysctl" not in found(URL, *LOADS)[1].remedy
        buffer_bytes[2**30] -= 1
        assert names(found(URL, *LOADS)[1].remedy, "recv_buf_size=17792", "sysctl -w net.core.rmem_max=17792")

    def test_the_size_that_the_url_requests_is_checked(self, buffer_bytes: dict[int | None, int]) -> None:
        buffer_bytes[50_000] = 100_000
        _, buffers = found(f"{URL}&recv_buf_size=50000", *LOADS)
        assert names(buffers.found, "98 KiB")

    def test_without_frames_nothing_is_tested(self) -> None:
        assert is_finding(found(URL)[1], "lcm", "buffers", Result.NOT_TESTED)


def requests(**settings: Any) -> Finding:
    _, finding, _ = check_lcm(LcmSettings(**settings), ("lab",), (), 0.1)
    return finding


@pytest.mark.netns
def test_requests_on_the_loopback_interface_pass() -> None:
    assert is_finding(requests(url=URL), "lcm", "requests", Result.PASSING)
    assert is_finding(requests(url="memq://"), "lcm", "requests", Result.PASSING, "memq")


@pytest.mark.netns
@pytest.mark.parametrize("ttl", [0, 1])
def test_requests_that_may_come_from_the_network_are_a_warning(ttl: int) -> None:
    url = f"udpm://239.255.76.67:7667?ttl={ttl}"
    with lan_interface("192.0.2.7"):
        finding = requests(url=url)
        off = requests(url=url, queries=False)
    assert is_finding(off, "lcm", "requests", Result.PASSING, "lcm.queries")
    assert is_finding(finding, "lcm", "requests", Result.WARNING, "lan", remedy=["lcm.queries"])


@pytest.mark.netns
def test_requests_are_not_tested_without_a_route() -> None:
    remove_multicast_route()
    try:
        finding = requests(url=URL)
    finally:
        add_multicast_route()
    assert is_finding(finding, "lcm", "requests", Result.NOT_TESTED, "route")


@pytest.mark.parametrize("size", [200, 1500, 3000, 8000, 20_000, 60_000])
def test_the_kernel_charges_at_most_charged_bytes_for_a_datagram(size: int) -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 150_000)
        count = receiver.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // charged_bytes(size)
        assert count >= 1
        for _ in range(count):
            sender.sendto(bytes(size), receiver.getsockname())
        receiver.setblocking(False)
        assert [len(receiver.recv(size)) for _ in range(count)] == [size] * count


def test_large_messages_are_charged_per_datagram() -> None:
    assert charged_bytes(3 * 65_499) == 3 * charged_bytes(65_499)
    assert (charged_bytes(200), charged_bytes(1500)) == (1280, 2304)
