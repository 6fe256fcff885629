"""The publisher of one source: it hands whole frames over to the thread of the clients."""

from collections.abc import Callable, Collection
from functools import partial
from typing import Final

from gateway.errors import OutputError
from gateway.messages.stamp import Stamp
from gateway.outputs.loop_thread import LoopThread
from gateway.outputs.rtc3d.live_server import SourceState
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import Frame, FrameLayout

QUEUE_FULL: Final = "queue full"
"""The cause of frames that nobody got because the thread of the clients cannot keep up."""

Take = Callable[[str, Frame, int, frozenset[ComponentType]], None]
"""Takes the source, a frame, the number of its stream, and the components to send. Called in the thread."""


class Rtc3dPublisher:
    """Hands frames of one source over, while any client wants frames."""

    def __init__(self, state: SourceState, thread: Callable[[], LoopThread | None], take: Take) -> None:
        self._state = state
        self._thread = thread
        self._take = take
        self._is_closed = False

    @property
    def wanted(self) -> bool:
        """Whether any client asks for frames."""
        return self._state.wanted and not self._is_closed

    def wants(self, _components: Collection[ComponentType]) -> bool:
        """See FramePublisher."""
        return self.wanted

    def prepare(self, _layout: FrameLayout, _components: frozenset[ComponentType]) -> bool:
        """See FramePublisher."""
        return self.wanted

    def publish(
        self,
        frame: Frame,
        stamp: Stamp,
        sequence: int,  # noqa: ARG002 - frames keep the server's own numbers
        components: frozenset[ComponentType],
    ) -> None:
        """Hand a frame over. Raises OutputError if too many wait."""
        if self._is_closed:
            raise OutputError(
                f"rtc3d: {self._state.source} is closed; ask for a new publisher", cause="closed"
            )
        thread = self._thread()
        if not self._state.wanted or thread is None:
            return
        call = partial(self._take, self._state.source, frame, stamp.session, components)
        if not thread.offer(call, len(frame.body)):
            raise OutputError(
                f"rtc3d: the frames of {self._state.source} arrive faster than they can be sent to all "
                "clients; let fewer clients connect, or let them ask for fewer frames",
                cause=QUEUE_FULL,
            )

    def close(self) -> None:
        """Close the publisher."""
        self._is_closed = True
