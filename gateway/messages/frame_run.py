"""Frames that the history keeps as they arrived, and the messages that are made of them when somebody asks.

A frame in memory costs one object for its bytes, however many components it has. Few messages are ever asked
for again, and those are the same bytes as the outputs got.
"""

from collections.abc import Sequence
from typing import Final

from gateway.messages.encode import PREFIX, ComponentEncoder, Stamp
from gateway.rtc3d.components import ComponentType

FRAME_OVERHEAD_BYTES: Final = 128
"""What a frame needs in memory besides its bytes: the heads of three objects, and a reference to each."""

RUN_BYTES: Final = 1000
"""What a run needs in memory besides its frames."""


class MessageNumbers:
    """The sequence numbers of one component's messages; ``next`` is that of the next one."""

    def __init__(self, component_type: ComponentType) -> None:
        self.type = component_type
        self.key = component_type.key
        self.next = 0


class NumberedLayout:
    """Which components of the frames with one layout have messages, and with which numbers."""

    def __init__(self, components: Sequence[tuple[MessageNumbers, ComponentEncoder]]) -> None:
        self.encoders: dict[MessageNumbers, list[ComponentEncoder]] = {}
        """Usually one of each component, but a frame may repeat it."""
        for numbers, encoder in components:
            self.encoders.setdefault(numbers, []).append(encoder)


class FrameRun:
    """Frames of one layout and one session, which arrived one after the other: one at least."""

    def __init__(self, layout: NumberedLayout, stamp: Stamp) -> None:
        self.layout = layout
        self.session = stamp.session
        self.parameters_version = stamp.parameters_version
        self.bodies: list[bytes] = []
        self.utimes: list[int] = []
        self.capture_utimes: list[int] = []
        self._components = {
            numbers.key: (numbers.next, encoders) for numbers, encoders in layout.encoders.items()
        }

    def messages(self, key: str) -> "FrameMessages | None":
        """Return the messages of the component with this key; None if the frames have none."""
        component = self._components.get(key)
        return None if component is None else FrameMessages(self, *component)

    @property
    def keys(self) -> Sequence[str]:
        """The keys of the components."""
        return list(self._components)

    def message(self, number: int, encoder: ComponentEncoder, sequence: int) -> bytes:
        """Return the message of a component of one frame, with a sequence number."""
        times = self.utimes[number], self.capture_utimes[number]
        prefix = PREFIX.pack(*times, sequence, self.session, self.parameters_version)
        return encoder.message(self.bodies[number], prefix)


class FrameMessages:
    """The messages of one component of a run, the oldest at position 0."""

    def __init__(self, run: FrameRun, first: int, encoders: Sequence[ComponentEncoder]) -> None:
        self._run = run
        self._first = first
        self._encoders = encoders

    def __len__(self) -> int:
        return len(self._run.bodies) * len(self._encoders)

    def message(self, position: int) -> bytes:
        """Return the message at a position."""
        number, repeated = divmod(position, len(self._encoders))
        return self._run.message(number, self._encoders[repeated], self._first + position)

    def sequence(self, position: int) -> int:
        """Return its sequence number."""
        return self._first + position

    def utime(self, position: int) -> int:
        """Return when it was published, in µs since the Unix epoch."""
        return self._run.utimes[position // len(self._encoders)]
