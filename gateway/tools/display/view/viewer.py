"""The view: its web server, and the loop that shows what has arrived, live or from a take."""

import errno
import logging
import socket
import sys
import time
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final

import rich
import viser
import websockets.asyncio.server
from viser.infra import Message
from viser.infra._async_message_buffer import AsyncMessageBuffer

from gateway.errors import GatewayError, SelectionError, ViewError
from gateway.outputs.listen_address import foreign_request
from gateway.runtime.safe_text import quoted, safe_text
from gateway.takes.files.reader import TakeReader
from gateway.tools.display.live import LiveData
from gateway.tools.display.view.panel import Panel, set_theme
from gateway.tools.display.view.scene import ViewScene
from gateway.tools.replay.play_list import Selection, take_length_us
from gateway.tools.replay.player import Player
from gateway.tools.replay.timeline import time_text

_push = AsyncMessageBuffer.push


def _push_from_any_thread(buffer: AsyncMessageBuffer, message: Message) -> None:
    """Queue a message for browsers.

    viser 1.1 wakes what waits for messages in the thread that pushes them, too. That fails if the event loop
    changes at this moment who waits. The message is in the queue by then, so it is enough to wake the loop.
    """
    try:
        _push(buffer, message)
    except RuntimeError as error:
        if str(error) != "deque mutated during iteration":
            raise
        with suppress(RuntimeError):  # the loop is closed
            buffer.event_loop.call_soon_threadsafe(buffer.message_event.set)


# mypy takes the function for a bound method, which has no parameter for the buffer.
AsyncMessageBuffer.push = _push_from_any_thread  # type: ignore[method-assign, assignment]


class ViewServer(viser.ViserServer):
    """A viser server that does not contact other computers."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Share nothing: viser would publish the page through a server on the internet, if a page asks."""


def open_server(host: str, port: int) -> ViewServer:
    """Serve the page at this address; port 0 picks a free one. Raises ViewError if that is not possible."""
    _check_address(host, port)
    rich.get_console().quiet = True  # viser prints there, also when a browser connects
    # It would log a traceback for each connection that is no browser's, as of a port scan.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", "Queued a ")  # to a browser that has left a moment ago
    with _refusing_foreign_sites(host):
        server = ViewServer(host, port, label="rtc3d-gateway", verbose=False)
    if port not in {0, server.get_port()}:  # taken since; viser chose another port
        server.stop()
        raise ViewError(_in_use(host, port))
    set_theme(server.gui, dark=True)
    server.gui.main_panel.dock_right()  # a floating one would cover the picture
    return server


@contextmanager
def _refusing_foreign_sites(host: str) -> Iterator[None]:
    """Let a server that viser opens meanwhile refuse what browsers send for other sites; viser would not."""
    serve: Any = websockets.asyncio.server.serve

    def guarded_serve(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            headers = request.headers
            refusal = foreign_request(host, headers.get_all("Host"), headers.get_all("Origin"))
            if refusal:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{refusal}\n")
            return process_request(connection, request)

        return serve(*arguments, process_request=process, **options)

    websockets.asyncio.server.serve = guarded_serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def address_of(host: str, port: int) -> str:
    """Return the address that a browser on this computer opens."""
    if host in {"", "0.0.0.0", "::"}:  # noqa: S104 - compared only
        host = "localhost"
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _check_address(host: str, port: int) -> None:
    """Raise ViewError if the address cannot be listened on: viser would try 1000 other ports."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind, protocol) as test:
            test.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            test.bind(address)
            test.listen(1)
    except OSError as error:
        if isinstance(error, socket.gaierror):
            raise ViewError(f"no address {host}: {error.strerror}; choose another one with --host") from None
        if port and error.errno == errno.EADDRINUSE:
            raise ViewError(_in_use(host, port)) from None
        raise ViewError(
            f"cannot serve the page on {host}:{port}: {error.strerror}; choose with --host and --port"
        ) from None


def _in_use(host: str, port: int) -> str:
    return f"port {port} of {host} is in use by another program; choose another one with --port"


RATES: Final = {"0.1 ×": 0.1, "0.25 ×": 0.25, "0.5 ×": 0.5, "1 ×": 1.0, "2 ×": 2.0, "5 ×": 5.0, "10 ×": 10.0}
"""The speeds to choose from."""

_STEP_S: Final = 0.01
_SHOW_S: Final = 0.25
"""How often the time and the slider are shown."""

_HOLD_S: Final = 1.0
"""For how long the slider stays where the user has moved it."""

_STOP_S: Final = 2.0


class Playback:
    """A take that plays into ``live``, and its controls.

    ``sources`` are the sources to play; empty means all. Raises TakeError if there is no take, or if it has
    none of these sources.
    """

    def __init__(self, path: Path, sources: Collection[str], live: LiveData) -> None:
        reader = self._reader = TakeReader(path)
        selection = Selection(sources=frozenset(sources) or None)
        if not any(selection.has(message.source, message.key) for message in reader.messages()):
            shown = f" of {', '.join(map(quoted, selection.sources))}" if selection.sources else ""
            existing = ", ".join(reader.source_names)
            raise SelectionError(f"{reader.path} has no messages{shown}; sources of the take: {existing}")
        self._live = live
        length_us = take_length_us(reader)
        if not length_us:  # its end is damaged, so all of it has to be read
            last_utimes = (batch.utimes[-1] for batches in reader.batches() for batch in batches)
            length_us = max([reader.start_utime, *last_utimes]) - reader.start_utime
        self._length_us = length_us
        self._player = Player(reader, selection, live, rate=1.0, is_watched=True)
        self._has_begun = False
        self._pages: frozenset[int] = frozenset()
        self._shown_s = 0.0
        self._moved_s = 0.0

    @property
    def is_paused(self) -> bool:
        """Whether the picture stands still on purpose: in a pause, or at the end."""
        return self._player.control.is_paused or self._player.control.is_at_end

    def add_controls(self, gui: viser.GuiApi) -> None:
        """Add the controls to the panel, in the container that is open."""
        self._state = gui.add_markdown("")
        self._button = gui.add_button("Pause")
        self._button.on_click(self._toggle)
        length_s = max(round(self._length_us / 1e6, 2), _STEP_S)
        self._slider = gui.add_slider("Time (s)", 0.0, length_s, _STEP_S, 0.0)
        self._slider.on_update(self._seek)
        self._rate = gui.add_dropdown("Speed", [*RATES], initial_value="1 ×")
        self._rate.on_update(lambda _event: self._player.control.set_rate(RATES[self._rate.value]))
        self._loop = gui.add_checkbox("Repeat", False)
        self._loop.on_update(lambda _event: self._repeat(self._loop.value))

    def follow(self, pages: Iterable[int]) -> None:
        """Play for the pages that are open now: all see the same moment.

        The take begins with the first page, and from the start for one that opens while no other is open, or
        at the end of the take. Without a page it pauses. Call it often.
        """
        before, self._pages = self._pages, frozenset(pages)
        if not self._pages:
            if before:
                self._player.control.pause(True)
        elif not self._has_begun:
            self._has_begun = True
            self._player.start()
        elif not before or (self._pages - before and self._player.control.is_at_end):
            self._play_from_start()

    def update(self) -> None:
        """Show the time and the state. Call it often; raises what ended the player."""
        if self._player.error is not None:
            raise self._player.error
        now_s = time.monotonic()
        if now_s - self._shown_s < _SHOW_S:
            return
        self._shown_s = now_s
        control, name = self._player.control, safe_text(self._reader.path.name).replace("`", "'")
        state = "at the end" if control.is_at_end else "paused" if control.is_paused else "playing"
        position, length = time_text(control.position_us), time_text(self._length_us)
        self._state.content = f"`{name}`  \n**{position}** of {length}, {state}"
        self._button.label = "Play" if self.is_paused else "Pause"
        if now_s - self._moved_s > _HOLD_S:
            self._slider.value = min(control.position_us / 1e6, self._slider.max)  # type: ignore[misc]

    def close(self) -> None:
        """Stop playing."""
        if self._has_begun:
            self._player.control.stop()
            self._player.join(_STOP_S)

    # In the threads of viser.

    def _toggle(self, _event: Any) -> None:
        control = self._player.control
        if control.is_at_end:
            self._play_from_start()
        else:
            control.pause(not control.is_paused)

    def _seek(self, event: Any) -> None:
        if event.client_id is not None:  # moved by a user, and not by `update`
            self._moved_s = time.monotonic()
            self._go_to(round(self._slider.value * 1e6))

    def _play_from_start(self) -> None:
        self._go_to(0)
        self._player.control.pause(False)

    def _go_to(self, position_us: int) -> None:
        self._live.begin_again()
        self._player.control.seek_to(position_us)

    def _repeat(self, is_repeated: bool) -> None:
        self._player.is_repeated = is_repeated


PERIOD_S: Final = 1 / 30
_PERIOD_WITHOUT_PAGE_S: Final = 0.1


class Viewer:
    """Shows the data of all sources, or of a take, to every browser that is connected."""

    def __init__(self, server: ViewServer, live: LiveData, playback: Playback | None = None) -> None:
        self._server = server
        self._live = live
        self._playback = playback
        if playback is not None:
            playback.add_controls(server.gui)
        tabs = server.gui.add_tab_group()
        self.panel = Panel(server, tabs, live, is_take=playback is not None)
        self.scene = ViewScene(server, tabs)
        self.num_defects = 0
        """How many pictures were not complete, because of a defect in this program."""

    def run(self, stops_within: Callable[[float], bool], tick: Callable[[], object] | None = None) -> None:
        """Show what arrives until ``stops_within``, which waits for some seconds, returns True.

        ``tick`` is called before each picture. The schedule is absolute, and pictures that are late are
        dropped. Without a browser, nothing is sent. A defect, or what a page should not send, does not end
        the view.
        """
        next_s = time.monotonic()
        while not stops_within(max(0.0, next_s - time.monotonic())):
            if tick is not None:
                tick()
            try:
                self.update()
            except GatewayError:
                raise
            except Exception as defect:  # noqa: BLE001 - the next picture may be whole
                if self.num_defects == 0:
                    text = f"defect in rtc3d-gateway view: {type(defect).__name__}: {defect}; report this"
                    print(safe_text(text), file=sys.stderr, flush=True)
                self.num_defects += 1
            now_s = time.monotonic()
            period_s = PERIOD_S if self._server.get_clients() else _PERIOD_WITHOUT_PAGE_S
            next_s += period_s * max(1, -(-(now_s - next_s) // period_s))

    def update(self) -> None:
        """Decode what has arrived, and show it. Raises what ended the playback of a take."""
        clients = self._server.get_clients()
        if self._playback is not None:
            self._playback.follow(clients)
        is_paused = self._playback is not None and self._playback.is_paused
        if is_paused:
            self._live.hold()
        sources = self._live.update()
        if clients:
            with self._server.atomic():
                self.scene.update(sources, clients)
        else:
            self.scene.pause()
        self.panel.update(sources, is_paused=is_paused)
        if self._playback is not None:
            self._playback.update()
