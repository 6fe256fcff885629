"""The instruments themselves: what they report without an attack, and that they notice a standstill."""

import asyncio
import signal

import pytest

from tests.hostile.gateway_under_attack import GatewayUnderAttack, log_lines_per_minute

pytestmark = pytest.mark.netns

STOP_S = 0.5


async def test_without_an_attack_nothing_is_missing(gateway_under_attack: GatewayUnderAttack) -> None:
    async with gateway_under_attack() as gateway:
        await asyncio.sleep(1)
    report = gateway.report
    report.check()
    assert report.num_received > 0
    assert report.rss_before_kib > 0
    assert report.rss_after_kib > 0


async def test_a_standstill_of_the_gateway_is_noticed(gateway_under_attack: GatewayUnderAttack) -> None:
    async with gateway_under_attack() as gateway:
        await gateway.stop_for(STOP_S)
        await asyncio.sleep(0.5)
        await gateway.arrivals()
    assert set(gateway.report.longest_silence_s) == {"zenoh", "lcm"}
    assert min(gateway.report.longest_silence_s.values()) >= STOP_S / 2  # a busy recorder was late before
    assert gateway.report.num_missing == 0


async def test_the_end_of_the_gateway_is_noticed(gateway_under_attack: GatewayUnderAttack) -> None:
    async with gateway_under_attack() as gateway:
        gateway.process.send_signal(signal.SIGABRT)
        await gateway.process.wait()
    assert gateway.report.exit_status == -signal.SIGABRT
    assert any("during the attack" in problem for problem in gateway.report.problems())


def test_lines_of_the_log_are_counted_in_the_worst_minute_and_by_source() -> None:
    quiet = [f"2026-01-02 03:{minute:02}:30,000 INFO stopping" for minute in range(10, 20)]
    burst = [f"2026-01-02 03:20:{second:02},500 ERROR one: defect\nTraceback" for second in range(30)]
    other = [f"2026-01-02 03:20:{second:02},600 INFO two (3d): connected" for second in range(50)]
    assert log_lines_per_minute("\n".join(quiet), ()) == 2  # 60 s apart
    assert log_lines_per_minute("\n".join([*quiet, *burst, *other]), ("one", "two")) == 60
    assert log_lines_per_minute("\n".join([*quiet, *burst, *other]), ()) == 110
