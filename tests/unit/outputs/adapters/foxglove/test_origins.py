"""Which web pages may connect: browsers send the page's address as Origin, and the server's as Host."""

import logging
import socket

import pytest

from gateway.outputs.adapters.foxglove.settings import FoxgloveSettings
from tests.support.errors import names
from tests.support.foxglove_viewer import HandshakeRefusedError, Viewer
from tests.support.records import kinds
from tests.unit.outputs.adapters.foxglove.live import serving

HOST = "127.0.0.1"
ALL = "0.0.0.0"  # noqa: S104 - in a test's network
NAME = socket.gethostname().lower()


async def is_accepted(settings: FoxgloveSettings, *headers: str) -> bool:
    async with serving("lab", settings=settings) as (port, _):
        try:
            async with await Viewer.open(port, "foxglove.sdk.v1", *headers):
                return True
        except HandshakeRefusedError as refusal:
            if "HTTP/1.1 403 " not in str(refusal):
                raise
            return False


@pytest.mark.parametrize(
    ("listens_on", "host", "origin", "accepts"),
    [
        (HOST, "127.0.0.1:8765", "https://app.foxglove.dev", True),
        (HOST, "127.0.0.1:8765", "https://a.b.foxglove.dev", True),
        (HOST, "127.0.0.1:8765", "http://localhost:8080", True),  # Lichtblick in a container
        (ALL, "192.0.2.5:8765", "http://127.0.0.1:8080", True),  # one on the computer of the browser
        (ALL, "192.0.2.5:8765", "http://192.0.2.5:8080", True),  # one beside the gateway
        (ALL, f"{NAME}:8765", f"http://{NAME}:8080", True),
        (HOST, "127.0.0.1:8765", "file://", True),  # Lichtblick for the desktop
        (HOST, "127.0.0.1:8765", "HTTP://Viewer.lab:8080", True),  # in foxglove.origins
        (HOST, "127.0.0.1:8765", "http://viewer.lab", False),
        (HOST, "127.0.0.1:8765", "http://app.foxglove.dev", False),  # anyone on the way can change it
        (HOST, "127.0.0.1:8765", "https://evilfoxglove.dev", False),
        (HOST, "127.0.0.1:8765", "https://foxglove.dev.evil.example", False),
        (HOST, "127.0.0.1:8765", "https://evil.example", False),
        (HOST, "127.0.0.1:8765", "http://localhost.evil.example", False),
        (HOST, "127.0.0.1:8765", "null", False),  # what any site can make a frame of its own send
        (HOST, "127.0.0.1:8765", "", False),
        (HOST, "evil.example:8765", "http://evil.example:8765", False),  # a name that leads here
        (ALL, "192.0.2.5:8765", "http://192.0.2.6:8080", False),
    ],
)
async def test_pages_of_viewers_may_connect_and_others_not(
    listens_on: str, host: str, origin: str, accepts: bool
) -> None:
    """Otherwise any web page that someone in the lab opens could send what is measured to its own server."""
    settings = FoxgloveSettings(enabled=True, host=listens_on, origins=("http://viewer.lab:8080",))
    assert await is_accepted(settings, f"Host: {host}", f"Origin: {origin}") is accepts


async def test_programs_may_connect_under_any_name_and_two_origins_are_refused(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """PlotJuggler sends no Origin; the log says which page was refused, and what to do."""
    settings = FoxgloveSettings(enabled=True)
    assert await is_accepted(settings, "Host: gateway.lab")
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    twice = ("Origin: https://evil.example", "Origin: https://app.foxglove.dev")
    assert not await is_accepted(settings, "Host: 127.0.0.1:8765", *twice)
    [warning] = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert kinds(caplog) == [("WARNING", "foreign page")]
    assert names(warning, "'https://evil.example'", "foxglove.origins")
