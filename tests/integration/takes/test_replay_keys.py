"""The keys of ``rtc3d-gateway replay`` on a terminal, whose settings are restored in every way it ends."""

import contextlib
import os
import re
import signal
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Final

import pytest

from gateway.rtc3d.components import ComponentType
from tests.support.errors import names
from tests.support.networks import lcm_url
from tests.support.pseudo_terminals import PseudoTerminal, in_terminal
from tests.support.takes import START_UTIME, description, frame, markers, parameters, write_take

pytestmark = pytest.mark.netns

XML: Final = b"<Parameters></Parameters>"
SOME_MESSAGES: Final = re.compile(r"[1-9]\d* messages/s")


def replay_in_terminal(take: Path, *options: str) -> AbstractContextManager[PseudoTerminal]:
    return in_terminal("replay", str(take), "--lcm", "--url", lcm_url(), *options)


@pytest.fixture
def take(tmp_path: Path) -> Path:
    """A take of two minutes."""
    messages = [description(), parameters(XML)]
    messages += [markers(1, number, utime=START_UTIME + 10_000 * number) for number in range(12_000)]
    return write_take(tmp_path / "take.lcmlog", messages)


@pytest.fixture
def terminal(take: Path) -> Iterator[PseudoTerminal]:
    """A terminal in which some messages have been replayed."""
    with replay_in_terminal(take) as terminal:
        terminal.wait_for(SOME_MESSAGES.search)
        assert not terminal.shows_keys()
        yield terminal


def test_space_pauses_arrows_go_back_and_forth_and_q_quits(terminal: PseudoTerminal) -> None:
    for keys, shown in ((" ", "paused"), (" ", "messages/s"), ("\x1b[C" * 3, "0:00:3"), ("\x1b[D", "0:00:2")):
        terminal.press(keys)
        terminal.wait_for(lambda text: shown in text)  # noqa: B023
    terminal.press("xyzq")
    assert terminal.wait_for_end() == 0
    assert "component" in terminal.text
    assert terminal.shows_keys()


def test_every_signal_restores_the_terminal(take: Path) -> None:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
    with contextlib.ExitStack() as stack:  # at the same time, because each needs seconds to begin
        terminals = [stack.enter_context(replay_in_terminal(take)) for _ in numbers]
        for terminal, number in zip(terminals, numbers, strict=True):
            terminal.wait_for(SOME_MESSAGES.search)
            assert not terminal.shows_keys()
            terminal.process.send_signal(number)
            assert terminal.wait_for_end() == 0, number
            assert "component" in terminal.text
            assert terminal.shows_keys()


def test_a_replay_that_ends_before_the_first_message_says_so(tmp_path: Path) -> None:
    messages = [description(), markers(1, 0), frame(ComponentType.EVENT, [(1, 0, -1, -1, -1)], 100)]
    take = write_take(tmp_path / "take.lcmlog", messages)
    with replay_in_terminal(take, "--component", "event", "--rate", "0.01") as terminal:  # due after 100 s
        terminal.wait_for(lambda text: " 0 messages/s" in text)
        terminal.press("q")
        assert terminal.wait_for_end() == 0
        assert "nothing" in terminal.text
        assert "component" not in terminal.text


def test_an_error_restores_the_terminal(terminal: PseudoTerminal, take: Path) -> None:
    take.unlink()
    take.mkdir()
    terminal.press("\x1b[D")  # reads the file again
    assert terminal.wait_for_end() == 1
    assert names(terminal.text, take)
    assert terminal.shows_keys()


def test_while_it_is_stopped_the_terminal_has_its_own_settings(terminal: PseudoTerminal) -> None:
    os.kill(terminal.process.pid, signal.SIGTSTP)
    os.waitid(os.P_PID, terminal.process.pid, os.WSTOPPED)
    assert terminal.shows_keys()
    terminal.process.send_signal(signal.SIGCONT)
    terminal.wait_for(lambda _: not terminal.shows_keys())
    terminal.press("q")
    assert terminal.wait_for_end() == 0
    assert terminal.shows_keys()
