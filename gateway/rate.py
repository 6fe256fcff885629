"""Which rate is asked of a server, and what is asked when it refuses."""

from collections.abc import Sequence

from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor, Rate, StreamFrames
from gateway.rtc3d.components import WIRE_ORDER, ComponentType


def stream_requests(
    rate: Rate, components: Sequence[ComponentType], server_rate_hz: float | None
) -> list[StreamFrames]:
    """Return the StreamFrames commands to try, in order, the wanted one first.

    Some servers know neither ``Frequency:n`` nor ``AllFrames`` nor component names (field note 2): then
    the same rate is asked for without names, a frequency as the nearest divisor of ``server_rate_hz``
    (the rate that the parameters tell, if any), and at last whatever the server sends by default.
    """
    names = () if set(components) == set(WIRE_ORDER) else tuple(components)
    rates: list[Rate] = [rate]
    if isinstance(rate, AllFrames):
        rates.append(FrequencyDivisor(1))
    elif isinstance(rate, Frequency) and server_rate_hz:
        rates.append(FrequencyDivisor(max(1, round(server_rate_hz / rate.hz))))
    wanted = [StreamFrames(rate, names), *(StreamFrames(each) for each in rates), StreamFrames()]
    return list(dict.fromkeys(wanted))
