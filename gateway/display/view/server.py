"""The web server of the live view."""

import errno
import logging
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

import rich
import viser
import websockets.asyncio.server

from gateway.errors import ViewError
from gateway.outputs.listen_address import foreign_request


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


def set_theme(gui: viser.GuiApi, *, dark: bool) -> None:
    """Choose the colours of the page, of all browsers or of one."""
    gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)
