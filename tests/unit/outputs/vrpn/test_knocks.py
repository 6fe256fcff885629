"""To whom the server connects when it is asked by UDP, and to how many at the same time."""

import asyncio
import socket

from gateway.outputs.vrpn.knocks import MAX_CALLS, MAX_CALLS_PER_HOST, Knocks

OWN_PORT = 3883


async def test_calls_are_bounded_for_each_host_and_in_all() -> None:
    """Anybody can forge a sender, so the gateway must not become a tool of an attack."""
    called: list[tuple[str, int]] = []
    may_end = asyncio.Event()

    async def call(host: str, port: int) -> None:
        called.append((host, port))
        await may_end.wait()

    async def knock(host: str, port: int) -> None:
        knocks._receive(f"{host} {port}".encode() + b"\0", host)
        await asyncio.sleep(0)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.setblocking(False)
        knocks = Knocks(udp, call, lambda *_: None, OWN_PORT)
        await knock("192.0.2.1", OWN_PORT)
        for port in range(5000, 5000 + MAX_CALLS_PER_HOST + 1):
            for _ in range(2):  # a repeated request is none
                await knock("192.0.2.1", port)
        assert called == [("192.0.2.1", 5000 + number) for number in range(MAX_CALLS_PER_HOST)]
        for number in range(MAX_CALLS):
            await knock(f"192.0.2.{100 + number}", 5000)
        assert len(called) == MAX_CALLS
        may_end.set()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        await knock("192.0.2.1", 5000)  # there is room again
        assert called[MAX_CALLS:] == [("192.0.2.1", 5000)]
        knocks.close()
