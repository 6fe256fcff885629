"""Other gateways that publish a source of the same name: their messages are mixed with this gateway's."""

import logging
import threading
import time
from collections.abc import Callable
from typing import Final

from gateway.runtime.failures import FailureLog

HOLD_S: Final = 3.0
"""How long another gateway must be there: after a reload, it may be the former session of this one."""

MAX_OTHERS: Final = 16
"""How many others of one source are known. Anybody can claim to be one."""

logger = logging.getLogger(__name__)


class OtherGateways:
    """Knows the other gateways of each source on one output, by their ids, and logs that there are some.

    One that does not say that it is ``gone`` is forgotten if it has not been ``seen`` for ``expires_s``. Any
    thread may call the methods.
    """

    def __init__(
        self, output: str, expires_s: float = float("inf"), monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        self._output = output
        self._expires_s = expires_s
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._others: dict[str, dict[str, tuple[float, float]]] = {}
        """By source and id, when each was seen first and last."""
        self._logs: dict[str, FailureLog] = {}

    def seen(self, source: str, gateway: str) -> None:
        """Note that another gateway publishes a source."""
        now_s = self._monotonic()
        with self._lock:
            others = self._others.setdefault(source, {})
            first_s, _ = others.get(gateway, (now_s, now_s))
            if gateway in others or len(others) < MAX_OTHERS:
                others[gateway] = first_s, now_s

    def gone(self, source: str, gateway: str) -> None:
        """Note that it does so no more."""
        with self._lock:
            self._others.get(source, {}).pop(gateway, None)

    def forget(self, source: str) -> None:
        """Forget the others of a source that this gateway does not publish any more."""
        with self._lock:
            self._others.pop(source, None)
            self._logs.pop(source, None)

    def check(self) -> None:
        """Log once that there are others, and that they are gone. Called once a second."""
        for source, count in self._counts().items():
            log = self._logs.setdefault(source, FailureLog(logger, source))
            if count:
                log.failed(_text(count, self._output))
            else:
                log.recovered(f"no other gateway publishes this source on {self._output} any more")

    @property
    def warnings(self) -> list[str]:
        """A text for each source that others publish, too."""
        return [
            f"{source}: {_text(count, self._output)}" for source, count in self._counts().items() if count
        ]

    def _counts(self) -> dict[str, int]:
        """Return the number of others of each source."""
        now_s = self._monotonic()
        with self._lock:
            for others in self._others.values():
                for gateway, (_, last_s) in [*others.items()]:
                    if now_s - last_s > self._expires_s:
                        del others[gateway]
            return {
                source: sum(now_s - first_s >= HOLD_S for first_s, _ in others.values())
                for source, others in self._others.items()
            }


def _text(count: int, output: str) -> str:
    others = "another gateway publishes" if count == 1 else f"{count} other gateways publish"
    return (
        f"{others} a source of this name on {output}, so subscribers get the messages of both: give one of "
        "the sources another name, or one of the gateways another prefix"
    )
