"""``top``: pages on a terminal that keys change, all tables once, or a line of JSON every second."""

import select
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final, TextIO

from rich.cells import cell_len

from gateway.client.transport import GatewaySubscriber, silence_text
from gateway.errors import QueryError
from gateway.messages.decode import json_text
from gateway.messages.host_time import now_utime
from gateway.outputs.kind import DISCOVERY_S, missing_source
from gateway.runtime.quantities import counted
from gateway.runtime.safe_text import safe_json, safe_text
from gateway.tools.display.live import DisplayedSource, LiveData
from gateway.tools.display.terminal import Keyboard, Line, Screen, Style, encoded, is_in_front, line_text
from gateway.tools.display.top.facts import source_facts
from gateway.tools.display.top.keys import ACTIONS, Do, help_page, short_keys
from gateway.tools.display.top.pages import PAGES
from gateway.tools.display.top.table import LaidOut, Order, TopTable, filtered, laid_out, sorted_by, wrapped

_MAX_FILTER: Final = 60
_MAX_NOTICE_LINES: Final = 3
_HELP_FOOTER: Final[Line] = (("any key ", Style.STRONG), ("back to the page", Style.FAINT))


class Display:
    """The page that is shown, which ``press`` changes and ``lines`` returns as text."""

    def __init__(self, title: str, *, has_keys: bool) -> None:
        self._title = title
        self._has_keys = has_keys
        self._page = 0
        self._offsets = [0] * len(PAGES)
        self._orders: list[Order | None] = [None] * len(PAGES)  # None: the usual one of the page
        self._filter = ""
        self._is_typing = False
        self._is_helping = False
        self._shown = TopTable((), (), "")
        self._num_rows = 1  # that fit on the screen
        self.is_over = False
        """Whether q was pressed."""

    def press(self, key: str) -> None:
        """Do what a key is for."""
        if self._is_typing:
            self._type(key)
        elif self._is_helping:
            self._is_helping = False
        elif key in ACTIONS:
            self._do(*ACTIONS[key])

    def _do(self, action: Do, number: int) -> None:
        match action:
            case Do.OPEN_PAGE:
                self._page = number
            case Do.TURN_PAGE:
                self._page = (self._page + number) % len(PAGES)
            case Do.SCROLL_LINES:
                self._scroll(number)
            case Do.SCROLL_SCREENS:
                self._scroll(number * max(self._num_rows - 1, 1))
            case Do.SORT | Do.REVERSE:
                self._sort(is_reverse=action is Do.REVERSE)
            case Do.FILTER:
                self._is_typing = True
            case Do.CLEAR_FILTER:
                self._filter = ""
            case Do.HELP:
                self._is_helping = True
            case Do.QUIT:
                self.is_over = True

    def _scroll(self, num_lines: int) -> None:
        self._offsets[self._page] = max(self._offsets[self._page] + num_lines, 0)

    def _type(self, key: str) -> None:
        match key:
            case "enter":
                self._is_typing = False
            case "escape":
                self._filter, self._is_typing = "", False
            case "backspace":
                self._filter = self._filter[:-1]
            case "ctrl-u":
                self._filter = ""
            case _:
                text = " " if key == "space" else key
                if len(text) == 1:
                    self._filter = (self._filter + text)[:_MAX_FILTER]
        self._offsets[self._page] = 0

    @property
    def _order(self) -> Order | None:
        return self._orders[self._page] or self._shown.order

    def _sort(self, *, is_reverse: bool) -> None:
        """Sort by the next column, or in the other direction."""
        order = self._order
        titles = [column.title for column in self._shown.columns]
        if is_reverse and order is not None:
            self._orders[self._page] = Order(order.title, not order.is_reversed)
        elif titles and not is_reverse:
            index = titles.index(order.title) + 1 if order is not None and order.title in titles else 0
            self._orders[self._page] = Order(titles[index % len(titles)])

    def lines(
        self, sources: Sequence[DisplayedSource], notices: Sequence[str], width: int, height: int
    ) -> list[Line]:
        """Return what the screen shows: titles, the page or the help, and at the bottom what the keys do."""
        above: list[Line] = [self._title_line(len(sources), width), self._tabs(width)]
        shown_notices = [line for text in notices for line in wrapped(safe_text(text), width)]
        above += [[(line, Style.BAD)] for line in shown_notices[:_MAX_NOTICE_LINES]]
        num_rows = max(height - len(above) - 2, 1)  # without the titles of the columns and the last line
        if self._is_helping:
            table = help_page(width)
            body, footer = table.body[:num_rows], _HELP_FOOTER
        else:
            self._num_rows = num_rows
            table = self._table(sources, width)
            body, footer = self._scrolled(table.body, width)
        body += [[]] * (num_rows - len(body))
        return [*[*above, table.titles, *body][: max(height - 1, 0)], footer]

    def _title_line(self, num_sources: int, width: int) -> Line:
        clock = time.strftime("%H:%M:%S")
        left = f"{self._title}  {counted(num_sources, 'source')}"
        if len(long := f"rtc3d-gateway top  {left}") + len(clock) + 2 <= width:
            left = long
        return [(left.ljust(width - len(clock)), Style.STRONG), (clock, Style.FAINT)]

    def _table(self, sources: Sequence[DisplayedSource], width: int) -> LaidOut:
        self._shown = PAGES[self._page].table(sources)
        order = self._order
        return laid_out(sorted_by(filtered(self._shown, self._filter), order), width, order)

    def _scrolled(self, lines: list[Line], width: int) -> tuple[list[Line], Line]:
        """Return those lines of the page that are in sight, and the last line of the screen."""
        last = max(len(lines) - self._num_rows, 0)
        offset = self._offsets[self._page] = min(self._offsets[self._page], last)
        return lines[offset : offset + self._num_rows], self._footer(offset, len(lines), width)

    def _tabs(self, width: int) -> Line:
        """Return the names of the pages; if they do not fit, the numbers of those that are not shown."""
        names = [f" {number} {page.name} " for number, page in enumerate(PAGES, start=1)]
        if sum(map(len, names)) > width:  # 80 columns are enough without the second space
            names = [name.rstrip() for name in names]
        if sum(map(len, names)) > width:
            names = [name if number == self._page else f" {number + 1} " for number, name in enumerate(names)]
        tabs = [(name, Style.PLAIN) for name in names]
        tabs[self._page] = (names[self._page], Style.MARKED)
        return tabs

    def _footer(self, offset: int, num_lines: int, width: int) -> Line:
        if self._is_typing:
            return [("filter: ", Style.STRONG), (self._filter, Style.PLAIN), (" ", Style.MARKED)]
        parts: list[tuple[str, Style]] = []
        if self._filter:
            parts.append((f"filter: {self._filter}  ", Style.WARNING))
        if self._has_keys:
            parts += short_keys(is_filtered=bool(self._filter))
        if num_lines <= self._num_rows:
            return _cut(parts, width)
        place = f" {offset + 1}–{min(offset + self._num_rows, num_lines)} of {num_lines}"
        return [*_cut(parts, width - len(place)), (place, Style.PLAIN)]


def _cut(parts: Sequence[tuple[str, Style]], width: int) -> list[tuple[str, Style]]:
    """Return the first parts that fit, filled up with spaces."""
    shown: list[tuple[str, Style]] = []
    for text, style in parts:
        if cell_len(text) > width:
            break
        shown.append((text, style))
        width -= cell_len(text)
    return [*shown, (" " * max(width, 0), Style.PLAIN)]


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
        self._silence = ""
        self._next_ask_s = time.monotonic() + DISCOVERY_S
        self._asking: threading.Thread | None = None

    def run(self) -> None:
        """Show the pages until q, or until a signal raises an exception; the terminal is restored."""
        next_draw_s = 0.0
        size = self._screen.size
        is_suspending = False

        def suspend(*_: object) -> None:  # at Ctrl-Z
            nonlocal is_suspending
            is_suspending = True

        former: Any = signal.signal(signal.SIGTSTP, suspend)
        try:
            while not self._display.is_over:
                self._take()
                has_changed = self._read_keys()
                if is_suspending:
                    is_suspending = False
                    self._give_back()
                    signal.raise_signal(signal.SIGSTOP)  # returns when the process continues
                    has_changed = True
                self._subscriber.tick()
                self._subscriber.query_routers()
                sources = self._live.update()
                self._check_silence()
                has_changed |= size != self._screen.size
                start_s = time.monotonic()
                if self._screen.is_open and (has_changed or start_s >= next_draw_s):
                    size = self._screen.size
                    notices = [self._silence] if self._silence else []
                    if self._live.defect is not None:
                        notices.append(f"a defect in this program: {self._live.defect!r}")
                    notices += [*self._notices][-1:]
                    self._screen.draw(self._display.lines(sources, notices, *size))
                    end_s = time.monotonic()
                    next_draw_s = start_s + max(_DRAW_S, _DRAW_SHARE * (end_s - start_s))
        finally:
            self._give_back()
            signal.signal(signal.SIGTSTP, former)

    def _read_keys(self) -> bool:
        """Wait for a key, but not longer than until the next update; return whether there was one."""
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

    def _check_silence(self) -> None:
        """If nothing is heard, find out why, in another thread: it may take a second."""
        if self._live.first_heard_s is not None:
            self._silence = ""
        elif time.monotonic() >= self._next_ask_s and not (self._asking and self._asking.is_alive()):
            self._next_ask_s = time.monotonic() + _ASK_AGAIN_S

            def ask() -> None:
                self._silence = silence_text(self._subscriber, self._live)

            self._asking = threading.Thread(target=ask, name="top-silence", daemon=True)
            self._asking.start()


_PICTURE_S: Final = 2.5
"""How long after the first message a picture is complete: rates are over 2 s, statuses come every second."""

_LINE_S: Final = 1.0


def wait_for_picture(live: LiveData, subscriber: GatewaySubscriber) -> list[DisplayedSource]:
    """Receive until the picture is complete; raises QueryError ("no-gateway") if nothing is heard."""
    start_s = time.monotonic()
    while True:
        sources = receive_once(live, subscriber)
        now_s = time.monotonic()
        first_s = live.first_heard_s
        if first_s is not None and now_s - first_s >= _PICTURE_S:
            return sources
        if first_s is None and now_s - start_s >= DISCOVERY_S:
            problem = silence_text(subscriber, live)
            if live.first_heard_s is None:
                raise QueryError(problem, code="no-gateway")


def missing_sources(sources: Sequence[DisplayedSource], wanted: Sequence[str]) -> list[QueryError]:
    """Return an error for each of the ``wanted`` sources that is not found."""
    found = [source.name for source in sources if source.heard_s is not None]
    return [
        QueryError(missing_source([name], found), code="no-gateway") for name in wanted if name not in found
    ]


def receive_once(live: LiveData, subscriber: GatewaySubscriber) -> list[DisplayedSource]:
    """Wait for a moment, and return the sources with what has come meanwhile."""
    time.sleep(_UPDATE_S)
    subscriber.tick()
    subscriber.query_routers()
    return live.update()


def print_tables(sources: Sequence[DisplayedSource], out: TextIO, width: int, *, is_coloured: bool) -> None:
    """Print every page, one below the other."""
    encoding = out.encoding or "ascii"
    for page in PAGES:
        table = page.table(sources)
        lines = laid_out(sorted_by(table, table.order), width, table.order)
        titles = [lines.titles] if any(section.rows for section in table.sections) else []
        shown: list[Line] = [[(page.name, Style.MARKED)], *titles, *lines.body, []]
        for line in shown:
            plain = [(text, Style.PLAIN) for text, _ in line]
            text = line_text(line if is_coloured else plain, width, has_colours=is_coloured)
            print(encoded(text.rstrip(), encoding).decode(encoding, "replace"), file=out)
    out.flush()


def json_line(live: LiveData, sources: Sequence[DisplayedSource]) -> str:
    """Return one JSON object, in one line, with everything about the sources."""
    facts = {"utime": now_utime(), "sources": [source_facts(source) for source in sources]}
    counts = {"num_foreign": live.num_foreign, "num_beyond": live.num_beyond}
    return safe_json(json_text(facts | counts))


def print_json_lines(
    live: LiveData, subscriber: GatewaySubscriber, out: TextIO, warn: Callable[[str], None]
) -> None:
    """Print a JSON object every second until an interrupt; ``warn`` once if nothing is heard."""
    start_s = next_s = time.monotonic()
    has_warned = False
    while True:
        sources = receive_once(live, subscriber)
        now_s = time.monotonic()
        if now_s - next_s >= _LINE_S:
            next_s += _LINE_S * ((now_s - next_s) // _LINE_S)
            print(json_line(live, sources), file=out, flush=True)
        if not has_warned and live.first_heard_s is None and now_s - start_s >= DISCOVERY_S:
            has_warned = True
            warn(silence_text(subscriber, live))
