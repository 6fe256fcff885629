"""Type the commands of the tutorial and of each how-to that needs no server, and compare the output."""

import shutil
import socket
import struct
import sysconfig
import venv
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import pytest
import zenoh

from gateway.takes.files.reader import TakeReader
from tests.support.documents import ROOT
from tests.support.fresh_clones import pip_environment
from tests.support.terminals import Terminal, folder, follow, terminals
from tests.unit.takes.export.exported import read_ezc3d
from tests.unit.takes.export.read_mcap import read_mcap
from tests.unit.takes.export.test_trc import read_trc

pytestmark = pytest.mark.netns

__all__ = ["folder", "terminals"]

SCOUTING: Final = ("224.0.0.224", 7446)
SECTION: Final = "\n## Try it without any server\n"
PAGES: Final = sorted(
    path.stem for path in (ROOT / "docs/how-to").glob("*.md") if SECTION in path.read_text(encoding="utf-8")
)


def test_pages_can_be_tried() -> None:
    """Other tests run the commands of the pages secure and service."""
    servers = {"first-principles", "wavefront", "several-servers"}
    outputs = {"lcm", "ros2", "rtc3d-clients", "vrpn", "lsl", "foxglove"}
    assert servers | outputs | {"router", "two-sites", "lecture-hall", "replay", "troubleshoot"} <= set(PAGES)


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
        scouts.settimeout(60)
        assert scouts.recv(1)


@pytest.mark.parametrize(("page", "count"), [("tutorial", 9), ("how-to/view", 3), ("how-to/first-hour", 7)])
def test_every_command_of_pages_that_search_by_multicast_prints_the_output_on_the_page(
    page: str, count: int, folder: Path, terminals: dict[str, Terminal]
) -> None:
    assert follow(f"docs/{page}.md", folder, terminals) >= count


def test_every_command_of_record_prints_the_output_on_the_page(
    folder: Path, terminals: dict[str, Terminal]
) -> None:
    assert follow("docs/how-to/record.md", folder, terminals) > 3
    keys = {message.key for message in TakeReader(folder / "walk.lcmlog").messages()}
    assert {"take", "parameters", "3d", "6d", "analog", "force", "event", "status", "clock"} <= keys


def test_every_command_of_take_to_biomechanics_prints_the_output_on_the_page(
    folder: Path, terminals: dict[str, Terminal]
) -> None:
    assert follow("docs/how-to/take-to-biomechanics.md", folder, terminals) == 6
    assert read_ezc3d(folder / "walk.c3d")["data"]["points"].shape[1] == 34
    assert len(read_trc(folder / "walk.trc").labels) == len(read_trc(folder / "walk/walk.trc").labels) == 34


def test_every_command_of_use_takes_prints_the_output_on_the_page(
    folder: Path, terminals: dict[str, Terminal]
) -> None:
    assert follow("docs/how-to/use-takes.md", folder, terminals) == 1


def test_every_command_of_take_to_data_science_prints_the_output_on_the_page(
    folder: Path, terminals: dict[str, Terminal]
) -> None:
    assert follow("docs/how-to/take-to-data-science.md", folder, terminals) > 4
    for extension in ("csv", "parquet"):
        components = sorted(path.name for path in folder.glob(f"walk-*.{extension}"))
        assert components == [f"walk-{key}.{extension}" for key in ("3d", "6d", "analog", "event", "force")]


def test_every_command_from_a_take_to_robotics_prints_the_output_on_the_page(
    folder: Path, terminals: dict[str, Terminal]
) -> None:
    assert follow("docs/how-to/take-to-robotics.md", folder, terminals) == 3
    assert {"/lab/markers", "/lab/tools", "/lab/forces"} < read_mcap(folder / "walk.mcap").topics.keys()


def test_every_command_of_take_to_bids_prints_the_output_on_the_page(
    folder: Path, terminals: dict[str, Terminal]
) -> None:
    assert follow("docs/how-to/take-to-bids.md", folder, terminals) == 5
    assert {path.name for path in (folder / "study").glob("sub-*")} == {"sub-01", "sub-02"}


@pytest.fixture
def installing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install packages to a virtual environment that sees the gateway and what it needs."""
    for name, value in pip_environment().items():
        monkeypatch.setenv(name, value)
    shutil.rmtree(folder / ".venv")
    venv.create(folder / ".venv", symlinks=True, with_pip=True)
    [packages] = (folder / ".venv").glob("lib/python*/site-packages")
    (packages / "gateway.pth").write_text(f"{ROOT}\n{ROOT / 'lcm_types'}\n{sysconfig.get_path('purelib')}\n")
    program = folder / ".venv/bin/rtc3d-gateway"
    program.write_text(f"#!{folder}/.venv/bin/python\nfrom gateway.__main__ import main\nmain()\n")
    program.chmod(0o755)


@pytest.mark.wheelhouse
@pytest.mark.usefixtures("installing")
def test_the_output_of_a_package_of_ones_own_works_as_on_the_page(
    folder: Path, terminals: dict[str, Terminal]
) -> None:
    assert follow("docs/how-to/write-an-output.md", folder, terminals) == 6


@pytest.mark.wheelhouse
@pytest.mark.usefixtures("installing")
def test_the_export_format_of_a_package_of_ones_own_works_as_on_the_page(
    folder: Path, terminals: dict[str, Terminal]
) -> None:
    assert follow("docs/how-to/write-an-export-format.md", folder, terminals) == 2
    first = np.loadtxt(folder / "walk-Head.tum")[0]
    assert first == pytest.approx([1795358960.727806, 0.2, -2.485, 1.552, 0, 0, 0, 1], abs=1e-6)


FRAME_12: Final = "frame 12: 23 of 24 markers in view\nframe 13: 24 of 24 markers in view\n"


@pytest.mark.parametrize(
    ("page", "printed", "is_same"),
    [
        (["frame 1: 2 of 3 markers in view", "…"], FRAME_12, True),
        (["frame 1: 2 of 3 tools in view"], FRAME_12, False),
        (["frame 1: 2 of 3 markers in view"] * 3, FRAME_12, False),
        (["walk: 8.4 s, 6.4 MB"], "walk: 1.2 s, 958.2 kB", True),
        (["walk: 8.4 s, 6.4 MB"], "walk: 1 h 2 min 3.4 s, 12 bytes", True),
        (["walk: 8.4 s, 6.4 MB"], "walk: 1.2 s, 958.2 kHz", False),
        (["walk: 8.4 s, 6.4 MB"], "walk: 1.2 ms, 958.2 kB", False),
        (["806 messages at -0.5 Hz"], "1,234,567 messages at 12 Hz", True),
        (["4 s"], "4 sources", False),
    ],
)
def test_lines_match_if_only_their_numbers_differ_and_units_of_size_and_time(
    page: list[str], printed: str, is_same: bool
) -> None:
    terminal = Terminal(Path())
    terminal.text = printed + "\n"
    assert terminal.shows(page) is is_same
