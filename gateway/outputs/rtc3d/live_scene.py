"""A live source as a scene: the frames that its server sends now, and its own parameters."""

from collections import deque
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Final
from weakref import WeakValueDictionary

from gateway.errors import CommandError
from gateway.outputs.rtc3d.arrivals import Arrivals
from gateway.outputs.rtc3d.live_frames import LiveFrames
from gateway.rtc3d.components import WIRE_ORDER, ComponentType, described_rate_hz, num_described_items
from gateway.rtc3d.frames import Frame
from gateway.rtc3d.parameters import General, Parameters
from gateway.rtc3d.parameters_xml import cut_sections

_KEPT_CHOICES: Final = 2
_CACHED_SECTIONS: Final = 16  # clients can ask for 63 different choices


class LiveScene:
    """The scene of a live source (see Scene). Its time is that of the arrival of frames."""

    length_us = None

    def __init__(self, source: str) -> None:
        self._source = source
        self._arrivals = Arrivals()
        # What clients ask for, by its components. It is there while any client asks for it, and a bit longer,
        # because a client can ask for one frame after the other.
        self._frames: WeakValueDictionary[frozenset[ComponentType], LiveFrames] = WeakValueDictionary()
        self._recent: deque[LiveFrames] = deque(maxlen=_KEPT_CHOICES)
        self.has_new_frames = False
        """Whether there are frames for clients that were not there when this was set to False."""
        self.set_parameters(b"", Parameters())

    # For the output -------------------------------------------------------------------------

    def set_parameters(self, xml: bytes, parsed: Parameters) -> None:
        """Serve these parameters from now on; ``xml`` is empty if the server gives none."""
        self._xml = xml
        self._parsed = parsed
        self._announced_hz: Mapping[ComponentType, float] = {
            component: rate_hz
            for component in WIRE_ORDER
            if num_described_items(parsed, component)
            and (rate_hz := described_rate_hz(parsed, component)) is not None
        }
        self._xml_of = lru_cache(_CACHED_SECTIONS)(self._cut_sections)

    def add(self, frame: Frame, stream: int, wanted: frozenset[ComponentType], elapsed_us: int) -> bool:
        """Add a frame that arrives now on this stream; return whether it has ``wanted`` components."""
        return self._arrivals.add(frame, stream, wanted, elapsed_us) is not None

    def forget_frames(self) -> None:
        """Forget the frames so far, because none are added any more while no client asks for any."""
        self._arrivals.frames.clear()
        self._recent.clear()
        for frames in list(self._frames.values()):
            frames.forget()

    @property
    def newest_us(self) -> int:
        """When the newest frame arrived, on the clock of the measurement; -1 before the first."""
        return self._arrivals.newest_us

    # Scene ----------------------------------------------------------------------------------

    @property
    def parameters(self) -> Parameters:
        """See Scene."""
        return self._parsed

    def parameters_xml(self, sections: Sequence[str], general: General) -> bytes:  # noqa: ARG002 - its own
        """See Scene. General is that of the source's server.

        Raises CommandError if its server gives no parameters.
        """
        if not self._xml:
            raise CommandError(f"The server of source {self._source} has given no parameters")
        return self._xml_of(frozenset(sections))

    def _cut_sections(self, sections: frozenset[str]) -> bytes:
        return cut_sections(self._xml, self._parsed, sections)

    def start(self) -> None:
        """See Scene."""
        self.stop()

    def advance(self, elapsed_us: int) -> int | None:
        """See Scene. It takes new frames for all that clients ask for."""
        due_us: int | None = None
        for frames in list(self._frames.values()):
            next_frame = frames.next_frame
            its_due_us = frames.update(elapsed_us)
            self.has_new_frames = self.has_new_frames or frames.next_frame != next_frame
            if its_due_us is not None and (due_us is None or its_due_us < due_us):
                due_us = its_due_us
        return due_us

    def stop(self) -> None:
        """See Scene."""
        self._arrivals.restart()
        self._frames.clear()
        self._recent.clear()

    def frames(self, components: Sequence[ComponentType], event_bytes: int = 24) -> LiveFrames:  # noqa: ARG002
        """See Scene. Events have the size in which they arrive."""
        choice = frozenset(components)
        frames = self._frames.get(choice)
        if frames is None:
            frames = self._frames[choice] = LiveFrames(components, self._arrivals, self._announced_hz)
            self._recent.append(frames)
        return frames
