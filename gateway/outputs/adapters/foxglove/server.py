"""A server of Foxglove's WebSocket protocol: channels and their subscribers.

It is not that of foxglove-sdk 0.30, which does not count what a slow client loses, limits neither clients nor
handshakes, ends for ever when the process has too many open files, and waits in ``stop`` for a client that
does not read. docs/design.md has more about this.
"""

import asyncio
import logging
import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, cast

from websockets.asyncio.server import Server, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from gateway.errors import QueryError
from gateway.messages.foxglove.topics import FoxgloveTopic
from gateway.outputs.adapters.foxglove import connections
from gateway.outputs.adapters.foxglove.connections import LIMITS, MAX_REQUEST_BYTES, FoxgloveViewer
from gateway.outputs.listen_address import foreign_page
from gateway.runtime.failures import DefectLog, EventLog
from gateway.runtime.server_limits import Clients

SERVER_NAME: Final = "rtc3d-gateway"

_PING_INTERVAL_S: Final = 10.0
_PING_TIMEOUT_S: Final = 20.0
"""A viewer that does not answer a ping for this long is disconnected: its computer may have gone."""

_FOXGLOVE: Final = re.compile(r"https://([a-z0-9-]+\.)*foxglove\.dev")
_DESKTOP: Final = "file://"
"""Lichtblick for the desktop is a page from the disk, which no web site can be."""

logger = logging.getLogger(__name__)

_library_logger: Final = logging.getLogger(f"{__name__}.websockets")
_library_logger.setLevel(logging.CRITICAL)  # websockets logs a traceback for whatever a port scan sends


class FoxgloveChannel:
    """An advertised topic. ``subscribers`` are the viewers, each with its number for the subscription.

    ``on_change`` is called with a viewer that subscribes, and with None when one unsubscribes.
    """

    def __init__(
        self, number: int, topic: FoxgloveTopic, on_change: Callable[[FoxgloveViewer | None], None]
    ) -> None:
        self.number = number
        self.topic = topic
        self.text = connections.channel_text(number, topic)
        self.subscribers: dict[FoxgloveViewer, int] = {}
        self.on_change = on_change


class FoxgloveServer:
    """Advertises channels to viewers, and sends messages to those that subscribe to them.

    ``origins`` are those of further pages that may connect. All methods are called in one event loop.
    Channels can be opened before the server listens.
    """

    def __init__(self, host: str, port: int, session: str, origins: Sequence[str] = ()) -> None:
        self._host = host
        self._port = port
        self._info = connections.server_info(SERVER_NAME, session)
        self._channels: dict[int, FoxgloveChannel] = {}
        self._last_number = 0
        self._origins = frozenset(origin.lower() for origin in origins)
        self.clients: Clients[FoxgloveViewer] = Clients(LIMITS, lambda each: each.transport.abort())
        self._events = EventLog(logger, "foxglove")
        self._server: Server | None = None
        self._opening = asyncio.Lock()
        self._is_closed = False
        self._defects = DefectLog(logger, "foxglove")

    async def open(self) -> None:
        """Listen, unless ``close`` was called. Raises OSError."""
        create: Any = partial(FoxgloveViewer, self.clients, self._events)
        handler, refuse = cast(Any, self._serve), cast(Any, self._refuse)
        async with self._opening:
            if self._is_closed:
                return
            self._server = await serve(
                handler,
                self._host,
                self._port,
                subprotocols=[Subprotocol(name) for name in connections.SUBPROTOCOLS],
                compression=None,  # it would cost more than a network in a laboratory
                process_request=refuse,
                open_timeout=LIMITS.handshake_s,
                ping_interval=_PING_INTERVAL_S,
                ping_timeout=_PING_TIMEOUT_S,
                close_timeout=LIMITS.close_s,
                max_size=MAX_REQUEST_BYTES,
                logger=_library_logger,
                create_connection=create,
            )

    async def close(self) -> None:
        """Stop listening, and disconnect all viewers."""
        self._is_closed = True
        async with self._opening:
            if self._server is not None:
                self._server.close()
                await self._server.wait_closed()

    # Channels.

    def open_channel(
        self, topic: FoxgloveTopic, on_change: Callable[[FoxgloveViewer | None], None]
    ) -> FoxgloveChannel:
        """Advertise a topic. ``on_change`` is that of the channel."""
        self._last_number += 1
        channel = FoxgloveChannel(self._last_number, topic, on_change)
        self._channels[channel.number] = channel
        self._tell_all(connections.advertise([channel.text]))
        return channel

    def close_channels(self, channels: list[FoxgloveChannel]) -> None:
        """Withdraw channels, with all subscriptions to them."""
        for channel in channels:
            del self._channels[channel.number]
            for viewer, number in channel.subscribers.items():
                del viewer.subscriptions[number]
            channel.subscribers.clear()
        if channels:
            self._tell_all(connections.unadvertise([channel.number for channel in channels]))

    def _tell_all(self, message: str) -> None:
        for viewer in tuple(self.clients.served):
            viewer.send_control(message)

    # Viewers.

    def _refuse(self, viewer: FoxgloveViewer, request: Request) -> Response | None:
        """Return the response to a foreign page or to a viewer that is one too many; None to accept it."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        reason = foreign_page(self._host, hosts, origins, self._is_of_a_viewer)
        if reason:
            reason = f"{reason}; if a viewer of yours is there, add it to foxglove.origins"
            self._events.log(logging.WARNING, f"{viewer.address} is refused: {reason}", "foreign page")
            return viewer.respond(403, f"{reason}\n")
        if not self.clients.is_full:
            return None
        most = self.clients.limits.clients
        text = f"{viewer.address} is refused: {most} viewers are connected; close one of them"
        self._events.log(logging.WARNING, text, "refused")
        return viewer.respond(503, f"{most} viewers are connected already; close one of them.\n")

    def _is_of_a_viewer(self, origin: str) -> bool:
        """Return whether pages of this origin are viewers: Foxglove's, from the disk, or configured."""
        origin = origin.lower()
        return origin in self._origins or origin == _DESKTOP or bool(_FOXGLOVE.fullmatch(origin))

    async def _serve(self, viewer: FoxgloveViewer) -> None:
        """Serve a viewer until it disconnects."""
        self.clients.serve(viewer)
        logger.debug("foxglove: %s connected", viewer.address)
        try:
            viewer.send_control(self._info)
            viewer.send_control(connections.advertise(channel.text for channel in self._channels.values()))
            async for message in viewer:
                self._handle(viewer, message)
        except ConnectionClosed:
            pass
        except Exception as defect:  # noqa: BLE001 - the other viewers are served nevertheless
            self._defects.log(defect)
        finally:
            self.clients.close(viewer)  # it may have ended before this began
            for number in list(viewer.subscriptions):
                self._unsubscribe(viewer, number)
            logger.debug("foxglove: %s disconnected", viewer.address)

    def _handle(self, viewer: FoxgloveViewer, message: str | bytes) -> None:
        try:
            begun, ended = connections.parse_request(message)
        except QueryError as error:
            viewer.send_control(connections.status(connections.ERROR, str(error)))
            return
        problems = [self._subscribe(viewer, *subscription) for subscription in begun]
        for number in ended:
            self._unsubscribe(viewer, number)
        if problem := next(filter(None, problems), ""):  # one of them is enough for the user
            viewer.send_control(connections.status(connections.ERROR, problem))

    def _subscribe(self, viewer: FoxgloveViewer, number: int, channel_number: int) -> str:
        """Subscribe a viewer to a channel. Return why the subscription is ignored; "" if it is not."""
        if channel_number > self._last_number:
            return f"there has never been a channel {channel_number}; the subscription is ignored"
        if number in viewer.subscriptions:
            return f"the subscription {number} exists already; the second one is ignored"
        channel = self._channels.get(channel_number)
        if channel is None:
            return ""  # It has just been withdrawn, which the viewer did not know yet.
        if viewer in channel.subscribers:
            return f"channel {channel_number} has a subscription already; the second one is ignored"
        viewer.subscriptions[number] = channel_number
        channel.subscribers[viewer] = number
        channel.on_change(viewer)
        return ""

    def _unsubscribe(self, viewer: FoxgloveViewer, number: int) -> None:
        channel = self._channels.get(viewer.subscriptions.pop(number, -1))
        if channel is not None:
            del channel.subscribers[viewer]
            channel.on_change(None)


def send(channel: FoxgloveChannel, utime: int, data: bytes) -> list[FoxgloveViewer]:
    """Send a message to all subscribers; return those that lose it because they do not read fast enough."""
    subscribers = channel.subscribers.items()
    return [viewer for viewer, number in subscribers if not viewer.send_message(number, utime, data)]
