"""Where the header of a C3D file contradicts its parameters: the header is right.

ezc3d believes the parameters alone. With an ANALOG:RATE of 1 Hz it would leave out all channels, and with
999.9 Hz instead of 1000 Hz read positions from the wrong bytes, both without a word.
"""

import math
import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

from gateway.session.c3d_files.receiving import BIG_ENDIAN, DEC, parameter_places, parameters_start

_SAME_RATE: Final = 1e-4
"""The relative difference of rates that are equal but for rounding, such as 59.94 and 59.94006 Hz."""

_NO_NUMBER: Final = 0xFFFF
"""The number of the last frame in files with more frames than the header can count."""

_SCALE_OFFSET: Final = 12
"""Where the header has the scale."""

_FORMATS: Final = {2: "H", 4: "f"}
"""Numbers by their size in bytes; those of items and of frames go up to 65535."""


class Correction(NamedTuple):
    """A parameter that becomes what the header says: its ``value``, and the one that is ``stated`` there.

    ``content`` are the new bytes, and ``position`` is where they are in the file.
    """

    parameter: str
    value: float
    stated: float
    position: int
    content: bytes

    @property
    def is_rounding(self) -> bool:
        """Whether both are equal but for rounding."""
        return _are_equal(self.value, self.stated)


class _Header(NamedTuple):
    """The part of the header that describes the frames."""

    num_points: int
    num_analog_values: int
    first_frame: int
    last_frame: int
    scale: float
    samples_per_frame: int
    rate_hz: float


def corrections(head: bytes) -> list[Correction]:
    """Return what to change in a file so that its parameters say what its header says.

    ``head`` are its first PARAMETERS_END_BYTES, which ``problem_of_sizes`` has found possible.
    """
    processor = head[parameters_start(head) + 3]
    if processor == DEC:  # whose floating-point numbers struct does not know
        return []
    order = ">" if processor == BIG_ENDIAN else "<"
    words = struct.unpack_from(f"{order}4H2xf2xHf", head, 2)
    header, corrector = _Header(*words), _Corrector(head, order)
    return [*corrector.of_rates(header), *corrector.of_counts(header), *corrector.of_scale(header)]


def stated_frames(head: bytes) -> int | None:
    """Return how many frames the header says that the file has; None if it does not say.

    ``head`` is as for ``corrections``.
    """
    order = ">" if head[parameters_start(head) + 3] == BIG_ENDIAN else "<"
    first, last = struct.unpack_from(f"{order}2H", head, 6)
    return last - first + 1 if 0 < first <= last < _NO_NUMBER else None


class _Corrector:
    """Compares the parameters in ``head`` with the header."""

    def __init__(self, head: bytes, order: str) -> None:
        self._head = head
        self._order = order
        self._places = {
            name: (element_bytes, at)
            for name, element_bytes, at, num_bytes in parameter_places(
                head, parameters_start(head) + 4, order
            )
            if num_bytes >= element_bytes and element_bytes in _FORMATS
        }

    def of_rates(self, header: _Header) -> Iterator[Correction]:
        """Yield what to change so that each frame has as many analog samples as the header says."""
        point_hz, analog_hz = self._number("POINT:RATE"), self._number("ANALOG:RATE")
        says_rate = header.rate_hz > 0 and math.isfinite(header.rate_hz)
        if says_rate and point_hz is not None and not _are_equal(point_hz, header.rate_hz):
            yield self._correction("POINT:RATE", point_hz, header.rate_hz)
            point_hz = header.rate_hz
        says_samples = header.samples_per_frame and header.num_analog_values
        if says_samples and point_hz and analog_hz is not None:
            stated_hz = header.samples_per_frame * point_hz
            if analog_hz != stated_hz:
                yield self._correction("ANALOG:RATE", analog_hz, stated_hz)

    def of_counts(self, header: _Header) -> Iterator[Correction]:
        """Yield what to change so that there are as many points, channels and frames as the header says."""
        counts = {"POINT:USED": header.num_points}
        if not header.num_analog_values:
            counts["ANALOG:USED"] = 0
        elif header.samples_per_frame:
            counts["ANALOG:USED"] = header.num_analog_values // header.samples_per_frame
        if 0 < header.first_frame <= header.last_frame < _NO_NUMBER:
            counts["POINT:FRAMES"] = header.last_frame - header.first_frame + 1
        for name, count in counts.items():
            found = self._number(name)
            if found is not None and (int(found) - count) % (_NO_NUMBER + 1):
                yield self._correction(name, found, count)

    def of_scale(self, header: _Header) -> Iterator[Correction]:
        """Yield what to change so that both scales are equal: ezc3d reads parts of a frame by either."""
        scale = self._number("POINT:SCALE")
        if scale is None:
            return
        if not header.scale or not math.isfinite(header.scale):
            content = struct.pack(self._order + "f", scale)
            yield Correction("POINT:SCALE", scale, scale, _SCALE_OFFSET, content)
        elif not _are_equal(scale, header.scale):
            yield self._correction("POINT:SCALE", scale, header.scale)

    def _number(self, name: str) -> float | None:
        if name not in self._places:
            return None
        element_bytes, at = self._places[name]
        (number,) = struct.unpack_from(self._order + _FORMATS[element_bytes], self._head, at)
        return float(number) if math.isfinite(number) else 0.0

    def _correction(self, name: str, found: float, stated: float) -> Correction:
        element_bytes, at = self._places[name]
        kind = _FORMATS[element_bytes]
        content = struct.pack(self._order + kind, int(stated) if kind == "H" else stated)
        return Correction(name, found, stated, at, content)


def _are_equal(first_hz: float, second_hz: float) -> bool:
    return math.isclose(first_hz, second_hz, rel_tol=_SAME_RATE)
