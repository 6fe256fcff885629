"""``top`` on a terminal: pages that are drawn twice a second, and the keys that change them."""

import contextlib
import select
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

from gateway.live.live_data import LiveData, LiveSource
from gateway.outputs.discovery import DISCOVERY_S
from gateway.subscriber.subscribe import GatewaySubscriber, silence_text
from gateway.terminal.keyboard import Keyboard, is_in_front
from gateway.terminal.screen import Screen
from gateway.top.display import Display

_UPDATE_S: Final = 0.1
_DRAW_S: Final = 0.5
_DRAW_SHARE: Final = 20
"""Drawing waits this many times as long as it takes, so that huge tables cost 5 % of a core at most."""

_ASK_AGAIN_S: Final = 3.0


class App:
    """The program between the keyboard and the screen."""

    def __init__(
        self,
        live: LiveData,
        subscriber: GatewaySubscriber,
        screen: Screen,
        keyboard: Keyboard | None,
        notices: deque[str],
        title: str,
    ) -> None:
        self._live = live
        self._subscriber = subscriber
        self._screen = screen
        self._keyboard = keyboard
        self._notices = notices
        self._display = Display(title, has_keys=keyboard is not None)
        self._sources: Sequence[LiveSource] = ()
        self._is_suspending = False
        self._silence = ""
        self._next_ask_s = time.monotonic() + DISCOVERY_S
        self._asking: threading.Thread | None = None

    def run(self) -> None:
        """Show the pages until q, or until a signal raises an exception; the terminal is restored."""
        next_draw_s = 0.0
        size = self._screen.size
        with _suspending(self._suspend):
            try:
                while not self._display.is_over:
                    has_changed = self._read_keys()
                    if self._is_suspending:
                        self._stop_process()
                        has_changed = True
                    self._subscriber.tick()
                    self._sources = self._live.update()
                    self._check_silence()
                    has_changed |= size != self._screen.size
                    start_s = time.monotonic()
                    if has_changed or start_s >= next_draw_s:
                        size = self._screen.size
                        self._draw()
                        end_s = time.monotonic()
                        next_draw_s = start_s + max(_DRAW_S, _DRAW_SHARE * (end_s - start_s))
            finally:
                self._give_back()

    def _read_keys(self) -> bool:
        """Wait for a key, but not longer than until the next update; return whether there was one."""
        self._take()
        keyboard = self._keyboard
        if keyboard is None or not keyboard.is_taken:
            time.sleep(_UPDATE_S)
            return False
        if not select.select([keyboard.descriptor], [], [], _UPDATE_S)[0]:
            return False
        names = keyboard.read()
        if names is None:
            self._display.is_over = True
        for name in names or ():
            if name == "ctrl-l":
                self._screen.redraw()
            self._display.press(name)
        return True

    def _take(self) -> None:
        """Take the terminal, once the program is in front."""
        if not self._screen.is_open and is_in_front(self._screen.descriptor):
            if self._keyboard is not None:
                self._keyboard.take()
            self._screen.open()

    def _give_back(self) -> None:
        self._screen.close()
        if self._keyboard is not None:
            self._keyboard.give_back()

    def _suspend(self) -> None:
        self._is_suspending = True

    def _stop_process(self) -> None:
        """Stop the process, as Ctrl-Z does, with the terminal as it was; return when it continues."""
        self._is_suspending = False
        self._give_back()
        signal.raise_signal(signal.SIGSTOP)

    def _check_silence(self) -> None:
        """If nothing is heard, find out why, in another thread: it may take a second."""
        if self._live.first_heard_s is not None:
            self._silence = ""
        elif time.monotonic() >= self._next_ask_s and not (self._asking and self._asking.is_alive()):
            self._next_ask_s = time.monotonic() + _ASK_AGAIN_S
            self._asking = threading.Thread(target=self._ask, name="top-silence", daemon=True)
            self._asking.start()

    def _ask(self) -> None:
        self._silence = silence_text(self._subscriber, self._live)

    def _draw(self) -> None:
        if not self._screen.is_open:
            return
        notices = [self._silence] if self._silence else []
        if self._live.defect is not None:
            notices.append(f"a defect in this program: {self._live.defect!r}")
        notices += [*self._notices][-1:]
        size = self._screen.size
        self._screen.draw(self._display.lines(self._sources, notices, size.columns, size.lines))


@contextlib.contextmanager
def _suspending(suspend: Callable[[], None]) -> Iterator[None]:
    """Call ``suspend`` at Ctrl-Z, during the block."""
    former: Any = signal.signal(signal.SIGTSTP, lambda *_: suspend())
    try:
        yield
    finally:
        signal.signal(signal.SIGTSTP, former)
