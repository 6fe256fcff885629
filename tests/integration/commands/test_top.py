"""``rtc3d-gateway top`` as a program of its own, on real terminals, Zenoh and LCM."""

import contextlib
import json
import os
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any, Final, NamedTuple

import pytest

from gateway.tools.display.top.pages import TWO_GATEWAYS
from tests.support.commands import Completed, run_command
from tests.support.configurations import write_config
from tests.support.errors import names
from tests.support.gateway_process import program, simulator
from tests.support.networks import free_endpoint, lcm_url, open_zenoh, zenoh_keys
from tests.support.pseudo_terminals import PseudoTerminal, in_terminal
from tests.support.waiting import wait_until

pytestmark = pytest.mark.netns

SCENE: Final = ("--rate", "50", "--analog-rate", "200", "--markers", "12", "--analog", "8", "--tools", "2")
COMPONENTS: Final = ["3d", "6d", "analog", "force", "event"]
SIDES: Final = ("zenoh", "lcm")


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
        config = write_config(
            folder / "gateway.yaml",
            port,
            source={"name": "Lab-1"},
            zenoh={"tool_poses": True, "config": zenoh_keys("client", connect=endpoint)},
            lcm={"url": url},
        )
        running: list[Any] = []

        def start() -> None:
            gateway = program("run", "--config", str(config), stderr=subprocess.DEVNULL)
            running.append(stack.enter_context(gateway))

        def stop() -> None:
            process = running.pop()
            process.kill()
            process.wait()

        start()
        wait_until(lambda: received)
        yield Lab(("--connect", endpoint), ("--lcm", "--url", url), start, stop, simulated)


def top(*commands: tuple[str, ...]) -> list[Completed]:
    """Run ``top`` with each of these options, all at once, without a terminal."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(lambda options: run_command("top", *options), commands))


def is_streaming(screen: str) -> bool:
    return (
        "Lab-1: " in screen and "streaming" in screen and bool(re.search(r"^3d +[1-9]", screen, re.MULTILINE))
    )


def wait_for_screens(terminals: list[PseudoTerminal], condition: Callable[[str], Any]) -> None:
    """Wait until ``condition`` holds for the screens of all terminals, and read all of them meanwhile."""

    def hold() -> bool:
        for terminal in terminals:
            terminal.read()
        return all(condition(terminal.screen) for terminal in terminals)

    wait_until(hold)


def assert_restored(terminal: PseudoTerminal) -> None:
    assert terminal.wait_for_end() == 0
    assert terminal.shows_keys()
    assert terminal.output.endswith(b"\x1b[?1049l")


def test_once_prints_every_table_or_one_object(lab: Lab) -> None:
    """Text without escapes; both networks show the same facts."""
    text, zenoh, lcm = top(
        ("--once", *lab.lcm),
        *(("--once", "--json", *lab.options(side), "--source", "Lab-1") for side in SIDES),
    )
    assert (text.status, text.stderr) == (0, "")
    assert "\x1b" not in text.stdout
    assert "refilled" not in text.stdout
    pages = [line for line in text.stdout.splitlines() if line.isalpha()]
    assert pages == ["overview", "markers", "tools", "server", "drops", "outputs", "questions", "events"]
    assert re.search(r"^Lab-1: .*streaming \d", text.stdout, re.MULTILINE)
    assert re.search(r"^3d +\d+\.\d +50\.0 ", text.stdout, re.MULTILINE)
    assert re.search(r"^Marker 12 +\d+\.\d %", text.stdout, re.MULTILINE)
    assert re.search(r"^Lab-1 +zenoh +connected", text.stdout, re.MULTILINE)
    for ended in (zenoh, lcm):
        assert (ended.status, ended.stderr) == (0, "")
        found = json.loads(ended.stdout)
        assert {"utime", "sources", "num_foreign", "num_beyond"} == found.keys()
        [source] = found["sources"]
        assert (source["source"], source["level"]) == ("Lab-1", "ok"), source["state"]
        data = {each["component"]: each for each in source["components"]}
        assert [key for key in data if not key.startswith("6d/")] == COMPONENTS
        assert (data["3d"]["announced_rate_hz"], data["3d"]["num_items"]) == (50, 12)
        assert data["3d"]["gateway_to_here_p99_ms"] is not None
        assert data["3d"]["num_refilled"] is None
        assert ("6d/*" in data) == (ended is zenoh)
        assert (len(source["markers"]), len(source["tools"])) == (12, 2)
        assert {each["output"] for each in source["outputs"]} == {"zenoh", "lcm"}


def test_json_prints_lines_until_it_is_interrupted(lab: Lab) -> None:
    """A program that reads the lines gets each when it is due, not when a buffer is full."""
    with program("top", "--json", "--complete", *lab.lcm, stdout=subprocess.PIPE, text=True) as process:
        objects = map(json.loads, process.stdout)
        times = [each["utime"] for each, _ in zip(objects, range(3), strict=False)]
        components = (each for line in objects for source in line["sources"] for each in source["components"])
        assert next(components)["num_refilled"] is not None
        process.send_signal(signal.SIGINT)
        assert process.wait(40) == 0
    assert times[-1] - times[0] > 1_000_000, "a line per second, not as many as possible"


def test_json_says_once_that_there_is_no_gateway_and_goes_on() -> None:
    """A log of the lines is complete, and its reader learns at once why it is empty."""
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with program("top", "--json", "--lcm", "--url", lcm_url(), **pipes) as process:
        assert names(process.stderr.readline(), "no gateway", "LCM")
        assert [json.loads(process.stdout.readline())["sources"] for _ in range(3)] == [[]] * 3
        process.send_signal(signal.SIGTERM)
        _, rest = process.communicate(timeout=120)
    assert (process.returncode, rest) == (0, "")


def test_a_source_that_nobody_serves_is_named_with_those_that_exist(lab: Lab) -> None:
    """The sources that exist are shown all the same."""
    [ended] = top(("--once", *lab.zenoh, "--source", "stage", "--source", "Lab-1"))
    assert ended.status == 3
    assert names(ended.stderr, "'stage'", "Lab-1")
    assert "Marker 12" in ended.stdout


def test_pages_on_a_terminal_of_any_size(lab: Lab) -> None:
    """Keys switch and filter pages, the screen follows the terminal, and q restores it."""
    with in_terminal("top", *lab.zenoh, columns=40, lines=10) as terminal:
        screen = terminal.wait_for_screen(is_streaming)
        assert not terminal.shows_keys()
        assert len(screen.splitlines()) == 10
        assert max(map(len, screen.splitlines())) <= 40
        terminal.press("?")
        screen = terminal.wait_for_screen(lambda screen: "any key back" in screen)
        assert (len(screen.splitlines()), "Ctrl-L" in screen) == (10, False)
        terminal.press("\x1b")
        terminal.wait_for_screen(is_streaming)
        terminal.resize(200, 60)
        screen = terminal.wait_for_screen(lambda screen: len(screen.splitlines()) == 60)
        assert "→here ms" in screen
        terminal.press("2")
        terminal.wait_for_screen(lambda screen: "Marker 12" in screen)
        terminal.press("/marker 1\r")
        screen = terminal.wait_for_screen(lambda screen: "Marker 2" not in screen and "Marker 1" in screen)
        assert "filter: marker 1" in screen
        terminal.press("\x1b[C\x1b")
        terminal.wait_for_screen(lambda screen: "Tool 2" in screen)
        terminal.press("6")
        terminal.wait_for_screen(lambda screen: "connected" in screen)
        terminal.press("?")
        terminal.wait_for_screen(lambda screen: "sort by the next column" in screen)
        terminal.press("?")
        terminal.wait_for_screen(lambda screen: "connected" in screen)
        terminal.press("/a?")
        terminal.wait_for_screen(lambda screen: "filter: a?" in screen)
        terminal.press("\r")
        terminal.press("q")
        assert_restored(terminal)


def test_every_signal_restores_the_terminal(lab: Lab) -> None:
    """Also while its output is held by Ctrl-S; a terminal that shows no keys would be unusable."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTERM)
    with ExitStack() as stack:
        terminals = [stack.enter_context(in_terminal("top", *lab.lcm)) for _ in numbers]
        wait_for_screens(terminals, is_streaming)
        terminals[-1].press("\x13")  # Ctrl-S
        for number, terminal in zip(numbers, terminals, strict=True):
            terminal.process.send_signal(number)
            assert_restored(terminal)


def test_while_it_is_stopped_the_terminal_is_as_before(lab: Lab) -> None:
    """The shell gets its terminal back during Ctrl-Z, and the screen returns afterwards."""
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


def test_the_screen_follows_gateways_that_come_and_go(lab: Lab) -> None:
    """Silence of a component, of the gateway, no gateway and two of them look different, and pass."""
    lab.stop()
    with ExitStack() as stack:
        terminals = [
            stack.enter_context(in_terminal("top", *lab.options(side), columns=200)) for side in SIDES
        ]
        wait_for_screens(terminals, lambda screen: "no gateway found on " in screen)
        assert all("no source so far" in terminal.screen for terminal in terminals)
        lab.start()
        wait_for_screens(terminals, lambda screen: is_streaming(screen) and "no gateway" not in screen)
        lab.simulator.send_signal(signal.SIGSTOP)
        wait_for_screens(terminals, lambda screen: re.search(r"^3d .*stopped$", screen, re.MULTILINE))
        lab.simulator.send_signal(signal.SIGCONT)
        wait_for_screens(terminals, lambda screen: is_streaming(screen) and "stopped" not in screen)
        lab.stop()
        wait_for_screens(terminals, lambda screen: "Lab-1: no status of its gateway for " in screen)
        lab.start()
        wait_for_screens(terminals, lambda screen: is_streaming(screen) and "stopped" not in screen)
        lab.start()
        wait_for_screens(terminals, lambda screen: TWO_GATEWAYS in screen)
        lab.stop()


def test_plain_terminals(lab: Lab) -> None:
    """NO_COLOR and encodings without arrows are obeyed; one that cannot place texts gets the tables once."""
    with (
        in_terminal("top", *lab.lcm, NO_COLOR="1", PYTHONIOENCODING="iso8859-1") as plain,
        in_terminal("top", *lab.lcm, TERM="dumb") as dumb,
    ):
        assert ">here ms" in plain.wait_for_screen(is_streaming)
        plain.press("?")
        assert "< >, h l" in plain.wait_for_screen(lambda screen: "sort by the next column" in screen)
        assert not re.search(rb"\x1b\[(?:\d;)?3\dm", plain.output)
        assert dumb.wait_for_end() == 0
        assert b"\x1b" not in dumb.output
        assert b"overview" in dumb.output
