"""Subscribing to a gateway's messages on Zenoh, for ``echo``, the demo and tests."""

import contextlib
import json
import socket
import threading
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Final

import zenoh

from gateway.errors import OutputError
from gateway.messages.topics import escape_key_chunk, is_json_key, zenoh_key
from gateway.outputs.kind import DemoSide, Receive, Subscription, SubscriptionRequest, missing_source
from gateway.outputs.zenoh.config import command_config, zenoh_config, zenoh_reason
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import DEFAULT_ZENOH_PREFIX, ZenohSettings
from gateway.runtime.program_end import Process

_PORTS: Final = range(20_000, 32_768)
"""Those of the demo. Linux gives the ports above to other sockets: one could get it before Zenoh listens."""

_first_use: Final[list[Process]] = []
"""The process that has opened the first session; empty before."""


def key_patterns(prefix: str, source: str | None, component: str | None) -> tuple[str, ...]:
    """Return the key expressions of the messages. None means all sources, or all components.

    The pose of one tool is 6d/LABEL, those of all tools are 6d/*. No pattern for more than one component is
    **, because that would have the gateway make JSON of everything.
    """
    base = zenoh_key(prefix, source or "*")
    if component is None:
        return f"{base}/*", f"{base}/6d/*"
    group, _, label = component.partition("/")
    path = (escape_key_chunk(label) if label != "*" else label,) if label else ()
    return ("/".join((base, group, *path)),)


def subscriber_config(connect: str | None, config_file: Path | None) -> zenoh.Config:
    """Return the configuration of a subscriber. Raises ConfigError if Zenoh rejects the file.

    With ``connect``, an endpoint such as tcp/127.0.0.1:7447, the session is a client of that endpoint only.
    Without it, the session is what ``config_file`` says, or a peer that finds others by multicast, Zenoh's
    default. The file may be that of a running gateway.
    """
    config = command_config(config_file) if config_file else zenoh_config({})
    if connect is not None:
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([connect]))
        config.insert_json5("scouting/multicast/enabled", "false")
    return config


def open_zenoh(connect: str | None, config_file: Path | None = None) -> zenoh.Session:
    """Return an open session with ``subscriber_config``.

    Raises OutputError if it does not open, and ForkError in a fork of a process that has used Zenoh: the
    threads that all sessions share are not there.
    """
    if not _first_use:
        _first_use.append(Process())
    _first_use[0].check("a Zenoh session")
    try:
        return zenoh.open(subscriber_config(connect, config_file))
    except zenoh.ZError as error:
        where = f" to {connect}" if connect else f" with {config_file}" if config_file else ""
        raise OutputError(
            f"no Zenoh session{where}: {zenoh_reason(error)}; is the gateway or the router running there?",
            cause="not open",
        ) from error


class ZenohSubscriber:
    """Subscribes to ``keys``, key expressions. If it ``owns_session``, ``close`` closes the session, too.

    It calls ``receive`` once at a time. JSON is left out, unless a key expression ends with its name.
    """

    def __init__(
        self, session: zenoh.Session, keys: Sequence[str], receive: Receive, *, owns_session: bool = False
    ) -> None:
        lock = threading.Lock()
        has_json = any(is_json_key(key) for key in keys)

        def on_sample(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            if has_json or not is_json_key(key):
                with lock:
                    receive(key, sample.payload.to_bytes())

        self._session = session
        self._owns_session = owns_session
        self._subscribers = [session.declare_subscriber(key, on_sample) for key in keys]

    def close(self) -> None:
        """Unsubscribe."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        if self._owns_session:
            self._session.close()


def subscribe(request: SubscriptionRequest, receive: Receive) -> ZenohSubscriber:
    """Subscribe with a new session; ``request.address`` is the endpoint to connect to. Raises OutputError."""
    keys = key_patterns(request.prefix or DEFAULT_ZENOH_PREFIX, request.source, request.component)
    return ZenohSubscriber(open_zenoh(request.address, request.config), keys, receive, owns_session=True)


def demo(_use_network: bool) -> DemoSide:
    """Return Zenoh for the demo: TCP on loopback without scouting, so that nothing leaves the machine."""
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    settings = ZenohSettings(
        config={"listen": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    )

    def subscribe_here(source: str, receive: Receive) -> Subscription:
        return subscribe(SubscriptionRequest(source, prefix=settings.prefix, address=endpoint), receive)

    return DemoSide(settings, ZenohOutput(settings), subscribe_here, endpoint)


def _free_port() -> int:
    for port in _PORTS:
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port
    return 0  # Zenoh will say that it cannot connect there


def served_sources(session: zenoh.Session, prefix: str, timeout_s: float = 1.0) -> list[str]:
    """Return the sources that gateways serve, by their liveliness tokens. It takes ``timeout_s`` at most."""
    tokens = session.liveliness().get(zenoh_key(prefix, "*", "alive"), timeout=timeout_s)
    keys = [str(reply.ok.key_expr) for reply in tokens if reply.ok is not None]
    return sorted({key.removeprefix(f"{prefix}/").partition("/")[0] for key in keys})


def no_gateway_on_zenoh(prefix: str, wanted: Collection[str], served: Collection[str]) -> str:
    """Return why nothing arrives of the ``wanted`` sources (of all, if empty) if these are ``served``."""
    if not served:
        return (
            f"no gateway found on Zenoh ({prefix}/*/alive); check that it is running with this "
            "prefix, and that --connect (or, without it, multicast) reaches the gateway or its router"
        )
    return missing_source(wanted, served)
