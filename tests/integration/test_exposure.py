"""``doctor --exposure`` against the sockets that the kernel has for a running gateway."""

import contextlib
import json
import re
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.support.commands import run_in_process
from tests.support.configurations import write_config
from tests.support.gateway_process import program
from tests.support.needs import has_ipv6
from tests.support.networks import free_port, lcm_url
from tests.support.waiting import wait_until

pytestmark = pytest.mark.netns


class Socket(NamedTuple):
    """A socket that listens, or that has a UDP port."""

    protocol: str
    host: str
    port: int


def sockets(process: int) -> list[Socket]:
    """Return what ``ss -lntup`` prints of a process and of those that it has started."""
    inodes = set()
    for number in [process, *children(process)]:
        for descriptor in Path(f"/proc/{number}/fd").glob("*"):  # none, if it has ended meanwhile
            with contextlib.suppress(OSError):  # closed meanwhile
                if found := re.fullmatch(r"socket:\[(\d+)\]", str(descriptor.readlink())):
                    inodes.add(found[1])
    return [found for inode, found in _table(process) if inode in inodes]


def children(process: int) -> list[int]:
    found: list[int] = []
    for task in Path(f"/proc/{process}/task").iterdir():
        with contextlib.suppress(OSError):  # the thread has ended meanwhile
            found.extend(map(int, (task / "children").read_text().split()))
    return found


def _table(process: int) -> Iterator[tuple[str, Socket]]:
    for name in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/{process}/net/{name}").read_text().splitlines()[1:]:
            fields = line.split()
            address, _, port = fields[1].partition(":")
            if name.startswith("tcp") and fields[3] != "0A":  # not listening
                continue
            words = struct.unpack(f">{len(address) // 8}I", bytes.fromhex(address))
            host = str(ip_address(struct.pack(f"={len(words)}I", *words)))
            yield fields[9], Socket(name[:3], host, int(port, 16))


def listed(*options: str | Path) -> list[Socket]:
    ended = run_in_process("doctor", "--exposure", "--json", *options)
    assert ended.stdout, ended.stderr
    ports = json.loads(ended.stdout)["ports"]
    return [Socket(port["protocol"], port["host"], port["port"]) for port in ports]


def unlisted(process: int, ports: Sequence[Socket]) -> list[Socket]:
    """Return the sockets that no port stands for. One without a number stands for one socket."""
    without_number = Counter(port.protocol for port in ports if not port.port)
    remaining = []
    for each in sockets(process):
        if each in ports:
            continue
        if without_number[each.protocol]:
            without_number[each.protocol] -= 1
        else:
            remaining.append(each)
    return remaining


def test_a_quick_try_opens_exactly_what_is_listed() -> None:
    """Zenoh and LCM are on, and open to other computers."""
    options = ("--server", f"127.0.0.1:{free_port()}")
    with program("run", *options) as process:
        ports = listed(*options)
        only_sent_to = {port for port in ports if port.port == 7667}  # subscribers of LCM open it
        numbered = {port for port in ports if port.port}

        def opens_what_is_listed() -> bool:  # at the start, LCM also has sockets to try multicast with
            opened = sockets(process.pid)
            is_complete = numbered - only_sent_to <= set(opened)
            return is_complete and len(opened) == len(ports) - len(only_sent_to)

        wait_until(opens_what_is_listed)
        assert unlisted(process.pid, ports) == []


def test_a_full_configuration_opens_nothing_that_is_not_listed(tmp_path: Path) -> None:
    """All outputs with ports are on, except for LSL, whose ports depend on its streams."""
    ports = iter([free_port() for _ in range(5)])
    config = write_config(
        tmp_path / "gateway.yaml",
        free_port(),
        zenoh={"enabled": True, "config": {"listen": {"endpoints": [f"tcp/127.0.0.1:{next(ports)}"]}}},
        lcm={"enabled": True, "url": lcm_url()},
        metrics={"enabled": True, "port": next(ports)},
        rtc3d={"enabled": True, "host": "127.0.0.1", "ports": {"lab": next(ports)}},
        vrpn={"enabled": True, "port": next(ports)},
        foxglove={"enabled": True, "host": "::1" if has_ipv6() else "127.0.0.1", "port": next(ports)},
        takes={"enabled": True, "directory": str(tmp_path / "takes")},
    )
    expected = listed("--config", config)
    with program("run", "--config", str(config)) as process:
        tcp = {each for each in expected if each.protocol == "tcp"}
        assert len(tcp) == 5
        wait_until(lambda: tcp <= set(sockets(process.pid)) and not unlisted(process.pid, expected))


def test_the_demo_is_open_on_this_computer_only() -> None:
    """Who tries it on a laptop in a café publishes nothing there."""
    with program("demo", "--seconds", "60", "--no-browser", start_new_session=True) as process:
        wait_until(lambda: len(sockets(process.pid)) >= 2)
        hosts = {each.host for each in sockets(process.pid)}
    assert all(ip_address(host).is_loopback for host in hosts)
