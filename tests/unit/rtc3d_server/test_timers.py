import asyncio
from collections.abc import Callable

import pytest

from gateway.rtc3d_server.timers import call_after_us


@pytest.mark.parametrize(
    ("delay_us", "delay_s"), [(-1500, 0), (0, 0), (0.5, 0.001), (1000, 0.001), (1001, 0.002), (29_000, 0.029)]
)
def test_a_delay_is_rounded_up_to_whole_milliseconds(
    delay_us: float, delay_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[float] = []

    class Loop:
        def call_later(self, delay_s: float, callback: Callable[[], object]) -> None:  # noqa: ARG002 - not called
            called.append(delay_s)

    monkeypatch.setattr(asyncio, "get_running_loop", Loop)
    call_after_us(delay_us, lambda: None)

    assert called == [delay_s]
