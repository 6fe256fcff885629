"""The stamps of the messages of one source."""

from collections.abc import Collection
from typing import Final

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import FrameLayout

_MAX_MOVED_US: Final = 10_000
"""How much later a stamp may become so that it differs; a clock that was set further back is followed."""


class DistinctStamps:
    """Makes the stamps of each component's frames differ: of several with one stamp, tf2 keeps only one.

    While the clock of a server is being measured, many frames that come together have the time of their
    arrival.
    """

    def __init__(self) -> None:
        self._newest: dict[ComponentType, int] = {}

    def distinct(self, utime: int, layout: FrameLayout, components: Collection[ComponentType]) -> int:
        """Return the time for a frame captured at ``utime``, in µs since the Unix epoch.

        That is 1 µs after the one before, if the frame is not really later. The components of a frame have
        one time, and so have those of two streams that were captured together.
        """
        newest = self._newest
        kinds = [each.type for each in layout.components if each.type in components]
        for kind in kinds:
            before = newest.get(kind)
            if before is not None and 0 <= before - utime < _MAX_MOVED_US:
                utime = before + 1
        for kind in kinds:
            newest[kind] = utime
        return utime
