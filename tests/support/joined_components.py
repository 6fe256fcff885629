"""What examples/join.py and examples/join.cpp have to make of markers and analog samples, in any order."""

from typing import Final, NamedTuple

MARKERS: Final = "3d"
ANALOG: Final = "analog"


class Pair(NamedTuple):
    """The time stamps, in µs, of a frame of markers and of the analog samples that belong to it."""

    frame_us: int
    samples_us: tuple[int, ...]


class Scenario(NamedTuple):
    """Messages in the order in which they arrive, as component and time stamp in µs, and the pairs."""

    name: str
    messages: tuple[tuple[str, int], ...]
    pairs: tuple[Pair, ...]

    def __str__(self) -> str:
        return self.name


def _samples(start_us: int, stop_us: int) -> list[tuple[str, int]]:
    return [(ANALOG, timestamp_us) for timestamp_us in range(start_us, stop_us, 500)]


def _frames(start_us: int, stop_us: int) -> list[tuple[str, int]]:
    return [(MARKERS, timestamp_us) for timestamp_us in range(start_us, stop_us, 5000)]


def _pair(frame_us: int, first_us: int | None = None, last_us: int | None = None) -> Pair:
    """Return the pair of a frame and of all samples between two times, both included."""
    first_us = frame_us - 4500 if first_us is None else first_us
    return Pair(frame_us, tuple(range(first_us, (frame_us if last_us is None else last_us) + 1, 500)))


SCENARIOS: Final = (
    Scenario(
        "analog ahead",
        (*_samples(0, 20_000), *_frames(0, 20_000)),
        (_pair(5000), _pair(10_000), _pair(15_000)),
    ),
    Scenario(
        "markers ahead",
        (*_frames(0, 20_000), *_samples(0, 15_500)),
        (_pair(5000), _pair(10_000), _pair(15_000)),
    ),
    Scenario(
        "a later sample shows that the one of its time is missing",
        (*_frames(0, 10_000), *_samples(0, 5000), *_samples(5500, 6000)),
        (_pair(5000, 500, 4500),),
    ),
    Scenario(
        "a missing frame: the next one has the samples since the one before",
        (*_frames(0, 5001), *_frames(15_000, 15_001), *_samples(0, 15_500)),
        (_pair(5000), _pair(15_000, 5500)),
    ),
    Scenario(
        "analog begins later",
        (*_frames(0, 15_000), *_samples(7000, 10_500)),
        (Pair(5000, ()), _pair(10_000, 7000)),
    ),
    Scenario(
        "both time stamps start again, markers first",
        (
            *_samples(100_000, 105_500), *_frames(100_000, 105_001),
            *_frames(0, 5001), *_samples(0, 5500), *_frames(10_000, 10_001), *_samples(5500, 10_500),
        ),
        (_pair(105_000), _pair(5000), _pair(10_000)),
    ),
    Scenario(
        "both time stamps start again, analog first",
        (
            *_samples(100_000, 105_500), *_frames(100_000, 105_001),
            *_samples(0, 10_500), *_frames(0, 10_001),
        ),
        (_pair(105_000), _pair(5000), _pair(10_000)),
    ),
    Scenario(
        "a frame of the old times arrives after the first samples of the new ones",
        (
            *_samples(100_000, 105_500), *_frames(100_000, 105_001),
            *_samples(0, 2500), *_frames(110_000, 110_001), *_frames(0, 10_001), *_samples(2500, 10_500),
        ),
        # When the frames start again, too, what has arrived of the samples is forgotten.
        (_pair(105_000), _pair(5000, 2500), _pair(10_000)),
    ),
)  # fmt: skip
