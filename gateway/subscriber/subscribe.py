"""Subscribing to everything that gateways publish, on Zenoh or on LCM."""

import threading
from collections.abc import Collection
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

from gateway.outputs.lcm.settings import DEFAULT_LCM_PREFIX, effective_lcm_url
from gateway.outputs.zenoh.settings import DEFAULT_ZENOH_PREFIX
from gateway.outputs.zenoh.subscriber import open_zenoh
from gateway.subscriber.lcm_subscriber import LcmGatewaySubscriber
from gateway.subscriber.reception import Reception
from gateway.subscriber.zenoh_subscriber import ZenohGatewaySubscriber

_CLOSE_S: Final = 0.5


class GatewaySubscriber(Protocol):
    """A subscriber that hands what it receives to a Reception."""

    def tick(self) -> None:
        """Query what is not known yet of new sources. Called often, in one thread."""

    def query_takes(self, source: Any) -> None:
        """Query which take the gateway of a source records; see Source.running_take."""

    def silence(self) -> str:
        """Return that no gateway is found, or none with these sources; "" if one is. It may take 1 s."""

    def close(self) -> None:
        """Unsubscribe. It may block while a peer does not read."""


class Transport(NamedTuple):
    """Where to subscribe: on LCM if ``is_lcm``, otherwise on Zenoh. None means the default."""

    is_lcm: bool = False
    connect: str | None = None
    zenoh_config: Path | None = None
    url: str | None = None
    prefix: str | None = None


def subscribe_all(
    transport: Transport,
    sources: Collection[str],
    components: Collection[str] | None,
    reception: Reception[Any, Any],
) -> GatewaySubscriber:
    """Subscribe to these sources (all, if empty) and components (None: all).

    Raises OutputError if Zenoh or LCM does not open, and ConfigError if Zenoh rejects the configuration file.
    """
    if transport.is_lcm:
        url = effective_lcm_url(transport.url)
        return LcmGatewaySubscriber(
            url, transport.prefix or DEFAULT_LCM_PREFIX, sources, components, reception
        )
    session = open_zenoh(transport.connect, transport.zenoh_config)
    return ZenohGatewaySubscriber(
        session, transport.prefix or DEFAULT_ZENOH_PREFIX, sources, components, reception
    )


def silence_text(subscriber: GatewaySubscriber, reception: Reception[Any, Any]) -> str:
    """Return why nothing has arrived so far. It may take 1 s."""
    names = ", ".join(source.name for source in reception.sources_now)
    found = f"a gateway serves {names or 'this source'}, but nothing arrives from it; try again"
    return subscriber.silence() or found


def close_in_time(subscriber: GatewaySubscriber) -> None:
    """Close a subscriber, but do not wait longer than 0.5 s: a peer that does not read delays it."""
    thread = threading.Thread(target=subscriber.close, name="subscriber-close", daemon=True)
    thread.start()
    thread.join(_CLOSE_S)
