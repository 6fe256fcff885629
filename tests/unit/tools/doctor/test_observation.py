"""The rate of a component, by the server's time stamps and by arrival times. Worked out by hand."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import pytest

from gateway.rtc3d.components import ITEM_DTYPES, ComponentType, encode_component
from gateway.rtc3d.frames import encode_frame, split_frame
from gateway.tools.doctor.observation import ObservedComponent

ITEM: Final = np.zeros(1, ITEM_DTYPES[ComponentType.MARKERS])
REQUESTED_US: Final = 10**9
EVERY_10_MS: Final = range(0, 300_000, 10_000)
DELAYED_TOGETHER: Final = [200_000 + number for number in range(20)] + list(range(210_000, 310_000, 10_000))
"""The first 20 of 30 frames waited for 0.2 s, so 29 intervals took 0.1 s."""


@pytest.mark.parametrize(
    ("timestamps_us", "arrivals_us", "rate_hz"),
    [
        ([0], [5_000], 0.0),
        (EVERY_10_MS, EVERY_10_MS, 100.0),
        (EVERY_10_MS, [50_000] * 30, 100.0),
        (EVERY_10_MS, DELAYED_TOGETHER, 100.0),
        ([0] * 30, EVERY_10_MS, 100.0),
        ([*range(0, 290_000, 10_000), 0], EVERY_10_MS, 100.0),
        (range(0, 300, 10), EVERY_10_MS, 100.0),
        (range(0, 300_000_000, 10_000_000), EVERY_10_MS, 100.0),
        (range(0, 300_000, 10_000), range(0, 120_000, 4_000), 100.0),
        (range(0, 1_500_000, 50_000), range(0, 120_000, 4_000), 250.0),
    ],
    ids=[
        *("one frame", "on time", "at one moment", "delayed together", "constant stamps"),
        *("stamps that jump back", "stamps in ms", "stamps in ns"),
        *("faster for less than the wait", "faster for longer than the wait"),
    ],
)
def test_the_rate_follows_time_stamps_that_the_arrivals_allow(
    timestamps_us: Sequence[int], arrivals_us: Sequence[int], rate_hz: float
) -> None:
    observed = ObservedComponent(REQUESTED_US)
    for number, (timestamp_us, arrival_us) in enumerate(zip(timestamps_us, arrivals_us, strict=True)):
        part = encode_component(ComponentType.MARKERS, number, timestamp_us, ITEM)
        frame = split_frame(encode_frame([part]), "big")
        observed.add(frame.components[0], REQUESTED_US + 100_000 + arrival_us)
    assert observed.rate_hz == pytest.approx(rate_hz)
