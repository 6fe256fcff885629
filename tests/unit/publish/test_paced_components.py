"""The frames of a paced component that are published: by server time or, without a clock, by arrival."""

import numpy as np

from gateway.messages.decode import decode
from gateway.messages.stamp import Stamp
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType, encode_component
from gateway.rtc3d.frames import encode_frame, split_frame
from tests.toy_output import ToyOutput

MARKERS = frozenset({ComponentType.MARKERS})


def published_numbers(times: list[tuple[int, int]], *, has_clock: bool) -> list[int]:
    """Publish frames with these (server's, host's) times in µs at 50 Hz; return the numbers of those sent."""
    output = ToyOutput()
    output.max_rate_hz = {ComponentType.MARKERS: 50.0}
    fan_out = FanOut("lab", [output])
    for number, (timestamp_us, utime) in enumerate(times):
        items = np.zeros(1, ITEM_DTYPES[ComponentType.MARKERS])
        component = encode_component(ComponentType.MARKERS, number, timestamp_us, items)
        stamp = Stamp(utime=utime, capture_utime=utime, session=1, parameters_version=1, has_clock=has_clock)
        fan_out.publish(split_frame(encode_frame([component]), "big"), stamp, MARKERS)
    return [decode(message).frame_number for _, message in output.messages]


def test_the_first_frame_and_every_second_one_after_it_are_published() -> None:
    times = [(10_000 * number, 0) for number in range(6)]
    assert published_numbers(times, has_clock=True) == [0, 2, 4]


def test_without_a_clock_the_arrivals_decide() -> None:
    times = [(20_000 * number, 10_000 * number) for number in range(6)]
    assert published_numbers(times, has_clock=False) == [0, 2, 4]
    assert published_numbers(times, has_clock=True) == [0, 1, 2, 3, 4, 5]
