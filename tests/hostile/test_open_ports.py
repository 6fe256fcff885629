"""``doctor --exposure`` against the kernel: a gateway with every output opens the listed ports only."""

import contextlib
import ipaddress
import json
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from gateway.outputs.zenoh.output import TEXTS
from tests.support.commands import run_command
from tests.support.configurations import write_config
from tests.support.gateway_process import program
from tests.support.networks import free_endpoint, free_port
from tests.support.waiting import wait_until

Place = tuple[str, str, int | str]
"""Protocol, address and port."""

_LISTEN: Final = "0A"
ANY: Final = "any"


def open_sockets(pid: int) -> Iterator[Place]:
    """Yield where a process receives: its listening TCP sockets and its UDP sockets."""
    inodes = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        name = str(link.readlink()) if link.is_symlink() else ""
        if name.startswith("socket:["):
            inodes.add(name[8:-1])
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            _, local, _, state, _, _, _, _, _, inode, *_ = line.split()
            if inode in inodes and (table.startswith("udp") or state == _LISTEN):
                address, _, port = local.partition(":")
                yield table[:3], _address_text(address), int(port, 16)


def _address_text(words: str) -> str:
    """Return an address that the kernel prints as words of 32 bits in the computer's own byte order."""
    numbers = [int(words[start : start + 8], 16) for start in range(0, len(words), 8)]
    return str(ipaddress.ip_address(b"".join(number.to_bytes(4, sys.byteorder) for number in numbers)))


def children(pid: int) -> list[int]:
    """Return the processes that any thread of a process has started."""
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # the thread has ended meanwhile
            found += map(int, (task / "children").read_text().split())
    return found


def listed_ports(config: Path) -> list[dict[str, Any]]:
    report = run_command("doctor", "--exposure", "--config", config, "--json")
    ports: list[dict[str, Any]] = json.loads(report.stdout)["ports"]
    return ports


@pytest.mark.netns
@pytest.mark.parametrize("zenoh", ["peer", "listens"])
def test_a_gateway_with_every_output_opens_the_listed_ports_and_no_other(
    tmp_path: Path, healthy_server: int, zenoh: str
) -> None:
    """The numbers of sockets agree, too, so that one more on a port that the kernel has chosen is noticed."""
    listen = {
        "mode": "router",
        "listen": {"endpoints": [free_endpoint()]},
        "scouting": {"multicast": {"enabled": False}},
    }
    config = write_config(
        tmp_path / "gateway.yaml",
        healthy_server,
        zenoh={"config": {} if zenoh == "peer" else listen},
        lcm={"enabled": True},
        takes={"enabled": True, "directory": str(tmp_path / "takes")},
        ros2={"enabled": True},
        rtc3d={"enabled": True, "ports": {"lab": free_port()}},
        vrpn={"enabled": True, "port": free_port()},
        lsl={"enabled": True},
        foxglove={"enabled": True, "port": free_port()},
        metrics={"enabled": True, "port": free_port()},
    )
    log = tmp_path / "gateway.log"
    with log.open("wb") as stderr, program("run", "--config", str(config), stderr=stderr) as process:

        def is_open(port: dict[str, Any]) -> bool:
            """Whether it is open, or is that of the group to which LCM only sends, which nobody opens."""
            return port["is_open"] is not False or (port["output"], port["access"]) == ("lcm", "publish")

        wait_until(lambda: all(text in log.read_text() for text in ("→ streaming", TEXTS.opened)))
        wait_until(lambda: all(map(is_open, listed_ports(config))))
        listed = listed_ports(config)
        places = {
            is_lsl: [
                (port["protocol"], port["host"], port["port"] or ANY)
                for port in listed
                if (port["output"] == "lsl") is is_lsl and port["is_open"] is not False
            ]
            for is_lsl in (True, False)
        }
        numbers = {port["port"] for port in listed}

        def found(pid: int) -> list[Place]:
            return [(kind, at, port if port in numbers else ANY) for kind, at, port in open_sockets(pid)]

        # LCM opens the socket that sends replies only when it sends something there.
        wait_until(lambda: Counter(found(process.pid)) == Counter(places[False]))
        [lsl_process] = children(process.pid)
        everywhere = {"0.0.0.0": "::"}  # noqa: S104 - LSL binds both
        wait_until(  # a port of each stream, and streams appear one after the other
            lambda: (
                {(kind, everywhere.get(at, at), port) for kind, at, port in found(lsl_process)}
                == set(places[True])
            )
        )
