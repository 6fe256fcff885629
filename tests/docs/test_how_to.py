"""Type the commands of each how-to that can be tried without a server, and compare the output."""

import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
import zenoh

from tests.documents import ROOT
from tests.terminals import Terminal, folder, follow, terminals

pytestmark = pytest.mark.netns

__all__ = ["folder", "terminals"]

SCOUTING: Final = ("224.0.0.224", 7446)
SECTION: Final = "\n## Try it without any server\n"
PAGES: Final = sorted(
    path.stem for path in (ROOT / "docs/how-to").glob("*.md") if SECTION in path.read_text(encoding="utf-8")
)


def test_pages_can_be_tried() -> None:
    """Other tests run the commands of the pages record, use-takes, secure and service."""
    servers = {"first-principles", "wavefront", "several-servers"}
    outputs = {"lcm", "ros2", "rtc3d-clients", "vrpn", "lsl", "foxglove"}
    assert servers | outputs | {"router", "replay", "troubleshoot"} <= set(PAGES)


@pytest.fixture
def scouts() -> Iterator[socket.socket]:
    """A socket that receives what Zenoh sends by multicast to find others."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        receiver.bind(SCOUTING)
        group = struct.pack("4s4s", *map(socket.inet_aton, (SCOUTING[0], "127.0.0.1")))
        receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        receiver.setblocking(False)
        yield receiver


@pytest.mark.parametrize("page", PAGES)
def test_every_command_prints_the_output_on_the_page(
    page: str, folder: Path, terminals: dict[str, Terminal], scouts: socket.socket
) -> None:
    assert follow(f"docs/how-to/{page}.md", folder, terminals) > 2
    with pytest.raises(BlockingIOError):  # nothing was looked for in the network
        scouts.recv(1)


def test_searching_in_the_network_would_be_seen(scouts: socket.socket) -> None:
    with zenoh.open(zenoh.Config()):
        scouts.setblocking(True)
        scouts.settimeout(10)
        assert scouts.recv(1)
