"""``rtc3d-gateway view``: a live 3D view in the browser."""

import os
import shlex
import sys
import threading
import webbrowser
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from gateway.errors import ViewError
from gateway.outputs.listen_address import is_loopback
from gateway.runtime.safe_text import safe_text
from gateway.tools.cli import options
from gateway.tools.cli.completion import take_files
from gateway.tools.cli.run import StopSignals

if TYPE_CHECKING:
    from gateway.client.transport import GatewaySubscriber
    from gateway.tools.display.live import LiveData
    from gateway.tools.display.view.viewer import ViewServer

VISER: Final = "viser>=1.1,<2"
"""What the extra ``view`` installs; a test compares it with pyproject.toml."""

_SILENCE_S: Final = 2.0

_PAST_S: Final = 10.0
"""The page shows this much: of plots, visibility and events."""

_PATIENCE_S: Final = 1.0
"""How long live data wait for what was missed: a display prefers the newest."""

_INSTALL: Final = "pip install 'rtc3d-gateway[view]'"


@options.with_options
def view(
    take: Annotated[
        Path | None,
        typer.Argument(
            metavar="[TAKE]",
            autocompletion=take_files,
            help="Play this take (.lcmlog, or the folder of one) instead of live data.",
        ),
    ] = None,
    *,
    source: options.SourcesOption = None,
    lcm: options.LcmOption = False,
    where: options.AddressOptions,
    complete: Annotated[
        bool,
        typer.Option(
            "--complete", help="Fill gaps from the gateway's history; newer data wait for that, at most 1 s."
        ),
    ] = False,
    host: Annotated[
        str, typer.Option(callback=options.checked_host, help="The address where the page is served.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="The port of the page; 0 picks a free one.")
    ] = 8080,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Do not open the page.")] = False,
) -> None:
    """Show markers, tools and forces in the browser as they arrive, or from a take, until Ctrl-C."""
    where.check(lcm=lcm)
    if take is not None and (lcm or complete or where != options.AddressOptions()):
        raise typer.BadParameter(
            "a take is read from its file; --lcm, --connect, --prefix and --complete are for live data"
        )
    stop = StopSignals(lambda _: os._exit(0))
    with ExitStack() as stack:
        server = _open_server(host, port)
        stack.callback(server.stop)

        from gateway.client.client import GatewayClient
        from gateway.tools.display.live import LiveData
        from gateway.tools.display.view.viewer import Playback, Viewer
        from gateway.tools.display.view.watched import WatchedSubscriber

        live = LiveData(takes_poses=False)
        if take is None:
            client = GatewayClient(where.address(lcm=lcm))
            subscribe = partial(
                client.subscribe,
                *(source or (), None, live),
                complete=complete,
                last_s=_PAST_S,
                patience_s=_PATIENCE_S,
            )
            watched = WatchedSubscriber(live, subscribe, server.get_clients)
            stack.callback(watched.close)
            silence = threading.Timer(_SILENCE_S, _explain_silence, (live, watched.subscriber))
            silence.daemon = True
            silence.start()
            viewer, tick = Viewer(server, live), watched.tick
        else:
            playback = Playback(take, source or (), live)
            stack.callback(playback.close)
            viewer, tick = Viewer(server, live, playback), None
        _announce(host, server.get_port(), opens_browser=not no_browser)
        viewer.run(stop.wait, tick)


def _open_server(host: str, port: int) -> "ViewServer":
    """Return the server of the page. Raises ViewError."""
    try:
        from gateway.tools.display.view.viewer import open_server
    except ImportError as error:
        if not (error.name or "").startswith("viser"):
            raise
        raise ViewError(
            f"the view needs viser, which is not installed; install it: {_INSTALL}, "
            f"or only viser for this program: {shlex.quote(sys.executable)} -m pip install '{VISER}'"
        ) from error
    return open_server(host, port)


def _announce(host: str, port: int, *, opens_browser: bool) -> None:
    """Print where the page is, and open it. A computer without a browser is no error."""
    from gateway.tools.display.view.viewer import address_of

    address = address_of(host, port)
    print(f"{address} shows the data; press Ctrl-C to stop", flush=True)
    if not is_loopback(host):
        print(f"note: everybody who reaches {host}:{port} can watch; there is no password", file=sys.stderr)
    if opens_browser and _has_display():
        threading.Thread(target=webbrowser.open, args=(address,), name="open-browser", daemon=True).start()


def _has_display() -> bool:
    """Whether a browser can open a window: in a terminal, one would take the terminal."""
    return sys.platform != "linux" or any(name in os.environ for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def _explain_silence(live: "LiveData", subscriber: "GatewaySubscriber") -> None:
    """Print why nothing has arrived, if that is so. The page goes on waiting."""
    from gateway.client.transport import silence_text

    if live.first_heard_s is not None:
        return
    text = silence_text(subscriber, live)
    if live.first_heard_s is None:
        print(safe_text(text), file=sys.stderr, flush=True)
