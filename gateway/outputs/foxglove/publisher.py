"""The way of one source's frames from the gateway's event loop to the thread that serves viewers."""

from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from typing import Final

from gateway.errors import OutputError
from gateway.foxglove_schemas.messages import NUMBERS_PER_ITEM
from gateway.losses import Losses
from gateway.messages.stamp import Stamp
from gateway.outputs.contract import ServerParameters
from gateway.outputs.event_loop import in_this_loop
from gateway.outputs.foxglove.live_source import LiveSource, has_too_many_numbers
from gateway.outputs.foxglove.server import FoxgloveServer
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import ComponentLayout, Frame, FrameLayout

QUEUE_FULL: Final = "queue full"


class ServedSource:
    """One source: whether viewers want it, and the calls of its LiveSource in the thread.

    ``call`` has the thread make a call. ``call_in_time`` does so if not too many wait, and returns whether it
    does; it takes the call and the number of bytes that it holds.
    """

    def __init__(
        self,
        name: str,
        server: FoxgloveServer,
        call: Callable[[Callable[[], None]], None],
        call_in_time: Callable[[Callable[[], None], int], bool],
    ) -> None:
        self.wanted: frozenset[ComponentType] = frozenset()
        """The components that a viewer has subscribed to."""
        self.losses: Losses | None = None
        """Where to count what viewers lose."""
        self._name = name
        self._server = server
        self._call = call
        self._call_in_time = call_in_time
        self._report_wanted: Callable[[frozenset[ComponentType]], None] = lambda _wanted: None
        self._on_change: Callable[[], None] = lambda: None
        self._source: LiveSource | None = None  # assigned in the thread only
        self._opened: set[ComponentType] = set()  # with numbers, since the newest parameters
        self._is_closed = False

    def watch_wanted(self, on_change: Callable[[], None]) -> None:
        """Call ``on_change`` in this event loop when ``wanted`` has changed."""
        self._on_change = on_change
        self._report_wanted = in_this_loop(self._set_wanted)

    def open(self) -> None:
        """Advertise the channels of the source."""
        self._call(self._open)

    def set_parameters(self, parameters: ServerParameters) -> None:
        """Convert the next frames with these parameters."""
        self._call(partial(self._set_parameters, parameters))
        self._opened.clear()
        self._on_change()  # so that frames are looked at again for what the parameters do not mention

    def open_for(self, layouts: Iterable[ComponentLayout]) -> None:
        """Open the channels of numbers in these components, as far as the parameters do not mention them."""
        for each in layouts:
            is_new = each.type in NUMBERS_PER_ITEM and each.num_items and each.type not in self._opened
            # If the queue is full, another layout or subscriber does it.
            if is_new and self._call_in_time(partial(self._open_for, each), 0):
                self._opened.add(each.type)

    def offer(self, frame: Frame, stamp: Stamp, components: frozenset[ComponentType]) -> bool:
        """Have the components of a frame sent; return False if too many frames wait."""
        return self._call_in_time(partial(self._send, frame, stamp, components), len(frame.body))

    @property
    def field_names(self) -> Mapping[str, Mapping[str, str]]:
        """See ``Output.topic_names``."""
        return {} if self._source is None else self._source.field_names

    def close(self) -> None:
        """Withdraw the channels of the source."""
        self._is_closed = True
        self.wanted = frozenset()
        self._call(self._close)

    # In the thread.

    def _open(self) -> None:
        if self._source is None:
            self._source = LiveSource(self._name, self._server, self._report_wanted)
            self._source.losses = self.losses

    def _set_parameters(self, parameters: ServerParameters) -> None:
        if self._source is not None:
            self._source.set_parameters(parameters)

    def _open_for(self, layout: ComponentLayout) -> None:
        if self._source is not None:
            self._source.open_for(layout)

    def _send(self, frame: Frame, stamp: Stamp, components: frozenset[ComponentType]) -> None:
        if self._source is not None:
            self._source.send_frame(frame, stamp, components)

    def _close(self) -> None:
        if self._source is not None:
            self._source.close()
            self._source = None

    # In the gateway's loop.

    def _set_wanted(self, wanted: frozenset[ComponentType]) -> None:
        if wanted != self.wanted and not self._is_closed:
            self.wanted = wanted
            self._on_change()


class FoxglovePublisher:
    """Hands over the frames of one source to the thread, while a viewer wants them."""

    def __init__(self, name: str, source: ServedSource) -> None:
        self._name = name
        self._source = source
        self._is_closed = False

    def wants(self, components: Collection[ComponentType]) -> bool:
        """Return whether a viewer has subscribed to any of these components."""
        return not self._is_closed and not self._source.wanted.isdisjoint(components)

    def prepare(self, layout: FrameLayout, components: frozenset[ComponentType]) -> bool:
        """Open channels for frames of ``layout``; return whether a viewer has subscribed to what they have.

        Nobody can subscribe to too many numbers. They count as lost while viewers watch the source.
        """
        found = [each for each in layout.components if each.type in components]
        if not self._is_closed:
            self._source.open_for(found)
        is_lost = any(map(has_too_many_numbers, found)) and bool(self._source.wanted)
        return self.wants([each.type for each in found]) or is_lost

    def publish(
        self,
        frame: Frame,
        stamp: Stamp,
        sequence: int,  # noqa: ARG002 - the signature is that of FramePublisher
        components: frozenset[ComponentType],
    ) -> None:
        """Hand over a frame; see FramePublisher."""
        if self._is_closed:
            raise OutputError(f"foxglove: {self._name} is closed; ask for a new publisher", cause="closed")
        if self._source.wanted and not self._source.offer(frame, stamp, components):
            raise OutputError(
                f"foxglove: the frames of {self._name} come faster than they can be converted; show fewer "
                "topics in the viewers",
                cause=QUEUE_FULL,
            )

    def close(self) -> None:
        """Refuse all frames from now on."""
        self._is_closed = True
