"""``rtc3d-gateway top`` as a program of its own, on real terminals, Zenoh and LCM."""

import contextlib
import json
import os
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any, Final, NamedTuple

import pytest
import yaml

from gateway.top.pages import TWO_GATEWAYS
from tests.gateway_process import PROGRAM, program, simulator
from tests.networks import free_endpoint, lcm_url, open_zenoh, zenoh_keys
from tests.pseudo_terminals import in_terminal
from tests.waiting import wait_until

pytestmark = pytest.mark.netns

SCENE: Final = ("--rate", "50", "--analog-rate", "200", "--markers", "12", "--analog", "8", "--tools", "2")
COMPONENTS: Final = ["3d", "6d", "analog", "force", "event"]
STATUS_3: Final = 3


class Lab(NamedTuple):
    """A simulator, and a gateway with the source Lab-1 on Zenoh, with a router, and on LCM.

    ``zenoh`` and ``lcm`` are the options of ``top``.
    """

    zenoh: tuple[str, ...]
    lcm: tuple[str, ...]
    start: Callable[[], None]
    stop: Callable[[], None]
    simulator: "subprocess.Popen[str]"

    def options(self, side: str) -> tuple[str, ...]:
        return self.lcm if side == "lcm" else self.zenoh


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    """The gateway runs at the beginning and at the end of each test."""
    folder = tmp_path_factory.mktemp("lab")
    endpoint, url = free_endpoint(), lcm_url()
    received: list[str] = []
    with ExitStack() as stack:
        router = stack.enter_context(contextlib.closing(open_zenoh("router", listen=endpoint)))
        router.declare_subscriber("mocap/Lab-1/3d", lambda sample: received.append(str(sample.key_expr)))
        port, simulated = stack.enter_context(simulator(*SCENE))
        configuration = {
            "sources": [{"name": "Lab-1", "host": "127.0.0.1", "port": port}],
            "zenoh": {"tool_poses": True, "config": zenoh_keys("client", connect=endpoint)},
            "lcm": {"url": url},
            "metrics": {"enabled": False},
        }
        (folder / "gateway.yaml").write_text(yaml.safe_dump(configuration))
        running: list[Any] = []

        def start() -> None:
            gateway = program("run", "--config", str(folder / "gateway.yaml"), stderr=subprocess.DEVNULL)
            running.append(stack.enter_context(gateway))

        def stop() -> None:
            process = running.pop()
            process.kill()
            process.wait()

        start()
        wait_until(lambda: received)
        yield Lab(("--connect", endpoint), ("--lcm", "--url", url), start, stop, simulated)


def top(*options: str, **environ: str) -> "subprocess.CompletedProcess[str]":
    """Run ``top`` without a terminal."""
    return subprocess.run(
        [*PROGRAM, "top", *options],
        capture_output=True,
        text=True,
        env={**os.environ, **environ},
        timeout=60,
        check=False,
    )


def is_streaming(screen: str) -> bool:
    return (
        "Lab-1: " in screen and "streaming" in screen and bool(re.search(r"^3d +[1-9]", screen, re.MULTILINE))
    )


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
def test_once_prints_every_table(lab: Lab, side: str) -> None:
    ended = top("--once", *lab.options(side))
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "\x1b" not in ended.stdout
    pages = [line for line in ended.stdout.splitlines() if line.isalpha()]
    assert pages == ["overview", "markers", "tools", "server", "drops", "outputs", "questions", "events"]
    assert re.search(r"^Lab-1: .*streaming \d", ended.stdout, re.MULTILINE)
    assert re.search(r"^3d +[45]\d\.\d +50\.0 ", ended.stdout, re.MULTILINE)
    assert re.search(r"^Marker 12 +\d+\.\d %", ended.stdout, re.MULTILINE)
    assert re.search(r"^Lab-1 +zenoh +connected", ended.stdout, re.MULTILINE)


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
def test_once_as_json_is_one_object(lab: Lab, side: str) -> None:
    ended = top("--once", "--json", *lab.options(side), "--source", "Lab-1")
    assert (ended.returncode, ended.stderr) == (0, "")
    found = json.loads(ended.stdout)
    assert {"utime", "sources", "num_foreign", "num_beyond"} == found.keys()
    [source] = found["sources"]
    assert source["source"] == "Lab-1"
    assert source["level"] == "ok"
    data = {each["component"]: each for each in source["components"]}
    assert [key for key in data if not key.startswith("6d/")] == COMPONENTS
    assert data["3d"]["announced_rate_hz"] == 50
    assert data["3d"]["num_items"] == 12
    assert data["3d"]["gateway_to_here_p99_ms"] is not None
    assert ("6d/*" in data) == (side == "zenoh")
    assert len(source["markers"]) == 12
    assert len(source["tools"]) == 2
    assert {each["output"] for each in source["outputs"]} == {"zenoh", "lcm"}


def test_json_prints_a_line_every_second_until_it_is_interrupted(lab: Lab) -> None:
    with program("top", "--json", *lab.lcm, stdout=subprocess.PIPE, text=True) as process:
        times = [json.loads(process.stdout.readline())["utime"] for _ in range(4)]
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
    assert 2_500_000 < times[-1] - times[0] < 30_000_000


def test_json_says_once_that_there_is_no_gateway_and_goes_on() -> None:
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with program("top", "--json", "--lcm", "--url", lcm_url(), **pipes) as process:
        assert process.stderr.readline().startswith("no gateway found on LCM (")
        assert [json.loads(process.stdout.readline())["sources"] for _ in range(4)] == [[]] * 4
        process.send_signal(signal.SIGTERM)
        _, rest = process.communicate(timeout=20)
    assert (process.returncode, rest) == (0, "")


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
@pytest.mark.parametrize("options", [["--once"], ["--once", "--json"], []], ids=["once", "json", "piped"])
def test_without_a_gateway_it_says_so_with_status_3(side: str, options: list[str]) -> None:
    endpoint = free_endpoint()
    with contextlib.closing(open_zenoh("peer", listen=endpoint)):
        where = ["--lcm", "--url", lcm_url()] if side == "lcm" else ["--connect", endpoint]
        ended = top(*options, *where)
    assert ended.returncode == STATUS_3
    assert ended.stdout == ""
    assert ended.stderr.startswith(f"no gateway found on {'LCM' if side == 'lcm' else 'Zenoh'} (")
    assert ended.stderr.count("\n") == 1


def test_a_source_that_nobody_serves_is_said_with_those_that_there_are(lab: Lab) -> None:
    ended = top("--once", *lab.zenoh, "--source", "stage")
    assert ended.returncode == STATUS_3
    assert ended.stderr == "no gateway serves source 'stage'; sources found: Lab-1\n"
    assert ended.stdout == ""


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
def test_one_of_two_sources_is_shown_and_the_other_one_is_said_to_be_missing(lab: Lab, side: str) -> None:
    ended = top("--once", *lab.options(side), "--source", "stage", "--source", "Lab-1")
    assert ended.returncode == STATUS_3
    assert "Marker 12" in ended.stdout
    assert ended.stderr == "no gateway serves source 'stage'; sources found: Lab-1\n"


def test_wrong_options_are_status_2() -> None:
    assert top("--lcm", "--connect", "tcp/127.0.0.1:1").returncode == 2
    assert top("--url", "udpm://239.255.76.67:7667").returncode == 2


def test_a_locale_other_than_utf_8_gets_tables_without_escapes(lab: Lab) -> None:
    ended = top("--once", *lab.lcm, PYTHONIOENCODING="ascii")
    assert ended.returncode == 0
    assert "\\u" not in ended.stdout
    assert ">gateway" in ended.stdout


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
def test_pages_on_a_terminal(lab: Lab, side: str) -> None:
    with in_terminal("top", *lab.options(side)) as terminal:
        terminal.wait_for_screen(is_streaming)
        assert not terminal.shows_keys()
        terminal.press("2")
        terminal.wait_for_screen(lambda screen: "Marker 12" in screen)
        terminal.press("/marker 1\r")
        screen = terminal.wait_for_screen(lambda screen: "Marker 2" not in screen and "Marker 1" in screen)
        assert "filter: marker 1" in screen
        terminal.press("\x1b[C\x1b")
        terminal.wait_for_screen(lambda screen: "Tool 2" in screen)
        terminal.press("6")
        terminal.wait_for_screen(lambda screen: "connected" in screen)
        terminal.press("q")
        assert terminal.wait_for_end() == 0
        assert terminal.shows_keys()
        assert terminal.output.endswith(b"\x1b[?1049l")


def test_the_screen_follows_the_size_of_the_terminal(lab: Lab) -> None:
    with in_terminal("top", *lab.lcm, columns=40, lines=10) as terminal:
        screen = terminal.wait_for_screen(is_streaming)
        assert len(screen.splitlines()) == 10
        assert max(map(len, screen.splitlines())) <= 40
        terminal.resize(200, 60)
        screen = terminal.wait_for_screen(lambda screen: len(screen.splitlines()) == 60)
        assert "→here p50/p99 ms" in screen


@pytest.mark.parametrize(
    "number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name
)
def test_every_signal_restores_the_terminal(lab: Lab, number: signal.Signals) -> None:
    with in_terminal("top", *lab.lcm) as terminal:
        terminal.wait_for_screen(is_streaming)
        terminal.process.send_signal(number)
        assert terminal.wait_for_end() == 0
        assert terminal.shows_keys()
        assert terminal.output.endswith(b"\x1b[?1049l")


def test_a_terminal_whose_output_is_held_is_restored(lab: Lab) -> None:
    with in_terminal("top", *lab.lcm) as terminal:
        terminal.wait_for_screen(is_streaming)
        terminal.press("\x13")  # Ctrl-S
        terminal.process.terminate()
        assert terminal.wait_for_end() == 0
        assert terminal.shows_keys()
        assert terminal.output.endswith(b"\x1b[?1049l")


def test_while_it_is_stopped_the_terminal_is_as_before(lab: Lab) -> None:
    with in_terminal("top", *lab.lcm) as terminal:
        terminal.wait_for_screen(is_streaming)
        terminal.press("\x1a")  # Ctrl-Z; without a shell, the program is the leader of its session
        os.kill(terminal.process.pid, signal.SIGTSTP)
        os.waitid(os.P_PID, terminal.process.pid, os.WSTOPPED)
        terminal.read()
        assert terminal.shows_keys()
        assert terminal.screen == ""
        terminal.process.send_signal(signal.SIGCONT)
        terminal.wait_for_screen(is_streaming)
        assert not terminal.shows_keys()
        terminal.press("q")
        assert terminal.wait_for_end() == 0
        assert terminal.shows_keys()


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
def test_data_that_stop_and_a_gateway_that_goes_and_comes_back(lab: Lab, side: str) -> None:
    with in_terminal("top", *lab.options(side)) as terminal:
        terminal.wait_for_screen(is_streaming)
        lab.simulator.send_signal(signal.SIGSTOP)
        terminal.wait_for_screen(lambda screen: re.search(r"^3d .*stopped$", screen, re.MULTILINE))
        lab.simulator.send_signal(signal.SIGCONT)
        terminal.wait_for_screen(lambda screen: is_streaming(screen) and "stopped" not in screen)
        lab.stop()
        terminal.wait_for_screen(lambda screen: "Lab-1: no status of its gateway for " in screen)
        lab.start()
        terminal.wait_for_screen(lambda screen: is_streaming(screen) and "stopped" not in screen)
        terminal.press("q")
        assert terminal.wait_for_end() == 0


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
def test_two_gateways_with_one_source_are_noticed(lab: Lab, side: str) -> None:
    lab.start()
    try:
        with in_terminal("top", *lab.options(side), columns=200) as terminal:
            terminal.wait_for_screen(lambda screen: TWO_GATEWAYS in screen)
    finally:
        lab.stop()


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
def test_without_a_gateway_the_screen_says_so_until_one_comes(lab: Lab, side: str) -> None:
    lab.stop()
    with in_terminal("top", *lab.options(side)) as terminal:
        terminal.wait_for_screen(lambda screen: "no gateway found on " in screen)
        assert "no source so far" in terminal.screen
        lab.start()
        terminal.wait_for_screen(lambda screen: is_streaming(screen) and "no gateway" not in screen)
        terminal.press("q")
        assert terminal.wait_for_end() == 0


def test_no_color_and_no_utf_8_on_a_terminal(lab: Lab) -> None:
    with in_terminal("top", *lab.lcm, NO_COLOR="1", PYTHONIOENCODING="iso8859-1") as terminal:
        screen = terminal.wait_for_screen(is_streaming)
        assert ">here p50/p99 ms" in screen
        assert not re.search(rb"\x1b\[(?:\d;)?3\dm", terminal.output)


def test_a_terminal_that_cannot_place_texts_gets_the_tables_once(lab: Lab) -> None:
    with in_terminal("top", *lab.lcm, TERM="dumb") as terminal:
        assert terminal.wait_for_end() == 0
        assert b"\x1b" not in terminal.output
        assert b"overview" in terminal.output
