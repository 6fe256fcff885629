"""The demo on a busy machine, and how it distinguishes lost, skipped and late messages."""

import asyncio
import contextlib
import io
import os
import re
import signal
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.outputs.kind import DemoSide, Receive, Subscription
from gateway.outputs.lcm.settings import LCM
from gateway.outputs.registry import OUTPUTS
from gateway.rtc3d.components import ComponentType
from gateway.simulator.synthetic import SyntheticScene
from gateway.tools.cli import demo_lab
from tests.support.waiting import wait_until_async


class StallingScene(SyntheticScene):
    """Stops the whole process for a moment after two seconds, like a busy machine."""

    def __init__(self) -> None:
        super().__init__(markers=2, tools=1, analog=0, plates=0, rate_hz=200)
        self._has_stalled = False

    def items(self, component: ComponentType, samples: Any) -> Any:
        if samples[-1] >= 400 and not self._has_stalled:
            self._has_stalled = True
            time.sleep(0.4)
        return super().items(component, samples)


async def report(scene: SyntheticScene, seconds: float) -> tuple[bool, str]:
    """Run the demo; return its verdict and what it prints."""
    out = io.StringIO()
    verdict = await demo_lab.run_demo(scene, asyncio.Event(), Console(file=out, width=200), seconds=seconds)
    return verdict, out.getvalue()


def number_of(what: str, text: str) -> int:
    """Return the number before ``what``."""
    found = re.search(rf"(\d+) (?:messages )?(?:were |arrived ){what}", text)
    assert found, text
    return int(found[1])


async def test_the_demo_loses_nothing_on_a_busy_machine_and_says_what_is_late() -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "gateway", "demo", "--seconds", "3"),
        stdout=asyncio.subprocess.PIPE,
        env=os.environ | {"COLUMNS": "200"},
    )
    output = asyncio.create_task(process.communicate())
    with contextlib.suppress(ProcessLookupError):  # it has ended
        while True:  # a busy machine: the process runs for some time, then others do
            process.send_signal(signal.SIGSTOP)
            await asyncio.sleep(0.3)
            process.send_signal(signal.SIGCONT)
            await asyncio.wait([output], timeout=0.7)
    await output
    out = output.result()[0].decode()
    assert process.returncode == 0, out
    assert number_of("late", out) > 100
    assert number_of("skipped", out) == 0


async def test_what_the_gateway_skips_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    streams = (StreamSettings.model_validate({"backlog": "latest"}),)
    monkeypatch.setattr(demo_lab, "SourceSettings", partial(SourceSettings, streams=streams))
    is_complete, text = await report(StallingScene(), 3.0)
    assert is_complete, text
    assert "Nothing was lost." in text
    assert number_of("skipped", text) > 50


async def test_what_a_subscriber_misses_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(OUTPUTS, "lcm", _with_deaf_subscriber(every=10))
    is_complete, text = await report(SyntheticScene(markers=2, tools=0, analog=0, plates=0, rate_hz=100), 1.0)
    assert not is_complete
    lost = number_of("lost", text)
    [sent] = re.findall(r"│ 3d +│ +(\d+)", text)
    assert lost >= int(sent) // 10 > 0
    assert number_of("skipped", text) == 0


def _with_deaf_subscriber(every: int) -> Any:
    kind = LCM
    assert kind.demo is not None
    build = kind.demo

    def demo_side(use_network: bool) -> DemoSide:
        side = build(use_network)

        def subscribe(source: str, receive: Receive) -> Subscription:
            count = 0

            def receive_most(name: str, message: bytes) -> None:
                nonlocal count
                count += name.endswith("_3D")
                if not (name.endswith("_3D") and count % every == 0):
                    receive(name, message)

            return side.subscribe(source, receive_most)

        return side._replace(subscribe=subscribe)

    return replace(kind, demo=demo_side)


@pytest.mark.netns
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_a_demo_that_is_interrupted_ends_quietly(number: signal.Signals) -> None:
    """It publishes meanwhile, and reports no losses: it is not complete."""
    process = await started_demo()
    process.send_signal(number)
    output, errors = await process.communicate()
    assert process.returncode == 130
    assert all(b" WARNING " in line for line in errors.splitlines())  # the machine may be busy
    assert b"lost" not in output.splitlines()[-1]


@pytest.mark.netns
async def test_the_view_ends_with_a_demo_that_is_killed() -> None:
    process = await started_demo()
    views = children(process.pid)
    assert views != []
    process.kill()
    await process.communicate()
    await wait_until_async(lambda: not any(is_alive(each) for each in views))


async def started_demo() -> asyncio.subprocess.Process:
    """Start a demo that would run for long; return it when it has its view and shows what it receives."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "gateway", "demo", "--seconds", "1000"),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        env=os.environ | {"COLUMNS": "200", "FORCE_COLOR": "1"},
    )
    assert process.stdout is not None
    while b"3d" not in (line := await process.stdout.readline()):
        assert line
    return process


def children(pid: int) -> list[int]:
    return [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_alive(pid: int) -> bool:
    """Whether a process runs, and is no zombie."""
    try:
        return ") Z " not in Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
