"""The Zenoh output in the registry."""

import contextlib
import socket
from typing import Final

from gateway.outputs.kind import DemoSide, OutputKind, Receive, Subscription
from gateway.outputs.zenoh.checks import CHECKS, check_zenoh, leaves_host
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.outputs.zenoh.subscriber import ZenohSubscriber, key_patterns, open_zenoh, subscribe

_PORTS: Final = range(20_000, 32_768)
"""Linux gives the ports above to other sockets: one of them could get the port before Zenoh listens there."""


def _free_port() -> int:
    for port in _PORTS:
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port
    return 0  # Zenoh will say that it cannot connect there


def _demo(_use_network: bool) -> DemoSide:
    """Return Zenoh for the demo: TCP on loopback without scouting, so that nothing leaves the machine."""
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    settings = ZenohSettings(
        config={"listen": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    )

    def subscribe_here(source: str, receive: Receive) -> Subscription:
        keys = key_patterns(settings.prefix, source, None)
        return ZenohSubscriber(open_zenoh(endpoint), keys, receive, owns_session=True)

    return DemoSide(settings, ZenohOutput(settings), subscribe_here, endpoint)


ZENOH: Final = OutputKind(
    name=ZenohOutput.name,
    settings=ZenohSettings,
    create=ZenohOutput,
    subscribe=subscribe,
    checks=CHECKS,
    run_checks=check_zenoh,
    leaves_host=leaves_host,
    demo=_demo,
)
