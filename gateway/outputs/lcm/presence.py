"""Messages by which gateways that answer requests on LCM notice each other."""

import contextlib
import functools
import math
import secrets
import time
from collections.abc import Callable
from typing import Final

import rtc3d

from gateway.errors import OutputError
from gateway.messages.topics import lcm_channel
from gateway.outputs.lcm.receiver import MAX_REQUEST_BYTES, LcmReceiver
from gateway.outputs.lcm.sender import LcmSender, LcmThreadSender
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.other_gateways import OtherGateways

PRESENCE_S: Final = 5.0
"""How often a gateway shows itself to others on the URL of requests."""

_PRESENCE: Final = "GATEWAY"
_PRESENCE_FINGERPRINT: Final[bytes] = rtc3d.command_request_t._get_packed_fingerprint()  # noqa: SLF001 - see decode.py


class GatewayPresence:
    """Shows this gateway to others that have sources of the same names, and notices theirs.

    ``serves`` returns whether requests about a source are answered.
    """

    def __init__(
        self, settings: LcmSettings, sender: LcmSender | LcmThreadSender, serves: Callable[[str], bool]
    ) -> None:
        self.others = OtherGateways("lcm", expires_s=3 * PRESENCE_S)
        """Other gateways that answer requests about the same sources."""
        self._prefix = settings.prefix
        self._is_shown = settings.queries  # otherwise, nothing else would be sent on the URL of requests
        self._sender = sender
        self._serves = serves
        self._id = secrets.token_hex(8)
        self._sources: dict[str, None] = {}
        self._shown_s = -math.inf

    def add(self, source: str, receiver: LcmReceiver) -> None:
        """Notice other gateways with this source, too."""
        self._sources[source] = None
        receiver.add(self._channel(source), functools.partial(self._take, source))

    def maintain(self) -> None:
        """Log that there are others, and show this gateway to them. Called once a second."""
        self.others.check()
        now_s = time.monotonic()
        if self._is_shown and now_s - self._shown_s >= PRESENCE_S:
            self._shown_s = now_s
            message = rtc3d.command_request_t()
            message.requester = self._id
            for source in filter(self._serves, self._sources):
                with contextlib.suppress(OutputError):  # replies cannot be sent either, which is counted then
                    self._sender.send(self._channel(source), message.encode())

    def _channel(self, source: str) -> str:
        return lcm_channel(self._prefix, source, _PRESENCE)

    def _take(self, source: str, data: bytes) -> None:
        """Note, in the receiving thread, that another gateway answers requests about a source."""
        if len(data) <= MAX_REQUEST_BYTES:
            try:
                gateway = str(rtc3d.command_request_t.decode(data).requester)
            except Exception:  # noqa: BLE001 - lcm-gen's decoders raise anything
                return
            if gateway != self._id and self._serves(source):
                self.others.seen(source, gateway)


def is_presence(channel: str, message: bytes) -> bool:
    """Return whether a gateway shows itself to others with this message, which is for no subscriber.

    The poses of a tool of that name are on such a channel, too.
    """
    return message[:8] == _PRESENCE_FINGERPRINT and channel.endswith(f"_{_PRESENCE}")
