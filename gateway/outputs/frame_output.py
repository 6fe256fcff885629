"""What outputs of whole frames have in common, and those among them that serve clients."""

import asyncio
import logging
from abc import abstractmethod
from collections.abc import Awaitable, Callable
from typing import Final, TypeVar

from gateway.config.settings import OutputSettings
from gateway.errors import PortError
from gateway.logs.failures import DefectLog, FailureLog, defect_text
from gateway.messages.topics import Topic
from gateway.outputs.contract import IgnoringPublisher, Output, Publisher
from gateway.outputs.threads import LoopThread

_FIRST_RETRY_S: Final = 0.2
_MAX_RETRY_S: Final = 1.0
"""How long to wait before a port that was in use is tried again: longer each time, up to this."""

_Result = TypeVar("_Result")


class FrameOutput(Output):
    """An output of whole frames that is replaced if its settings change."""

    settings: OutputSettings

    def publisher(self, topic: Topic) -> Publisher:  # noqa: ARG002 - for all topics
        """Return a publisher that does nothing: status and clock are not published."""
        return IgnoringPublisher()

    def is_configured_like(self, other: Output) -> bool:
        """Return whether the settings are the same."""
        return isinstance(other, FrameOutput) and self.settings == other.settings


class ServerOutput(FrameOutput):
    """An output that serves clients in a thread of its own, so that they cost the sources nothing."""

    close_s: float = 1.0
    """How long ``close`` waits for the thread to end: it has to close all connections."""

    def __init__(self) -> None:
        self._thread: LoopThread | None = None  # from ``start`` on
        self._is_closed = False

    def start(self) -> None:
        """Start the thread, and serve clients there."""
        if self._thread is None and not self._is_closed:
            self._thread = LoopThread(self.name)
            self._serve(self._thread)

    def close(self) -> None:
        """Disconnect all clients and stop listening."""
        self._is_closed = True
        if self._thread is not None:
            self._thread.close(self._stop, self.close_s)

    @abstractmethod
    def _serve(self, thread: LoopThread) -> None:
        """Have the thread, which has just started, serve clients."""

    @abstractmethod
    async def _stop(self) -> None:
        """Disconnect all clients and stop listening. Called in the thread, as the last thing there."""

    def _offer(self, call: Callable[[], None], num_bytes: int = 0) -> bool:
        """See LoopThread.offer; False if the thread has not started."""
        return self._thread is not None and self._thread.offer(call, num_bytes)


class PortOpener:
    """Opens the port of a server, again and again until it can be used.

    ``subject`` is that of FailureLog. ``problem`` is what to say before the first attempt.
    """

    def __init__(self, logger: logging.Logger, subject: str, problem: str) -> None:
        self.problem = problem
        """Why clients cannot connect, and what to do; "" if they can."""
        self._failures = FailureLog(logger, subject)
        self._defects = DefectLog(logger, subject)

    async def open(self, attempt: Callable[[], Awaitable[_Result]], opened: str) -> _Result:
        """Return what ``attempt`` returns once it does not raise, and log ``opened``.

        ``attempt`` raises PortError, which says what to do, if the port cannot be used.
        """
        delay_s = _FIRST_RETRY_S
        while True:
            try:
                result = await attempt()
            except PortError as error:
                self.problem = str(error)
                self._failures.failed(self.problem)
            except Exception as defect:  # noqa: BLE001 - the next attempt may succeed
                self.problem = f"{defect_text(defect)}; report this with the log"
                self._defects.log(defect)
            else:
                self.problem = ""
                self._failures.succeeded(opened)
                return result
            await asyncio.sleep(delay_s)
            delay_s = min(2 * delay_s, _MAX_RETRY_S)
