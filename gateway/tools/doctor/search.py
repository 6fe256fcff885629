"""Search for RT servers on hosts that the user names, for somebody who does not know a server's address."""

import asyncio
import ipaddress
import itertools
import shlex
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple, TypeVar

from gateway.config.section import validated
from gateway.config.settings import SourceSettings, StreamSettings
from gateway.config.values import Host
from gateway.config.words import describe
from gateway.errors import (
    ConfigError,
    ConnectError,
    LinkError,
    PacketError,
    ReplyTimeoutError,
    ServerError,
    system_reason,
)
from gateway.outputs.listen_address import host_in_url
from gateway.rtc3d.commands import Version
from gateway.rtc3d.packets import decode_text
from gateway.runtime.quantities import counted
from gateway.runtime.safe_text import quoted, safe_text
from gateway.session.process_clock import RunningTimeout
from gateway.session.session import Session
from gateway.session.status import StreamStatus
from gateway.session.tcp import is_address, look_up
from gateway.tools.doctor.source_checks import USUAL_PORTS

MAX_HOSTS: Final = 256
"""How many hosts are tried at most: a usual subnet (/24). More would be a scan of a large network."""

_MAX_PARALLEL: Final = 32
"""How many connections, or look-ups, there are at a time. Two ports of 254 silent hosts take 16 s then."""

_LOOK_UP_S: Final = 5.0
_CONNECT_S: Final = 1.0
_REPLY_S: Final = 2.0

_MAX_PACKET_BYTES: Final = 64 * 1024
"""Any program may answer, with anything; each connection may cost so much memory. Replies are short."""

_MAX_REPLY_CHARACTERS: Final = 200
_PORTS: Final = " and ".join(map(str, USUAL_PORTS))


# The hosts that the user names -------------------------------------------------------------


def parse_hosts(text: str) -> list[str]:
    """Return the hosts in ``text``, each once, in order: names, addresses and subnets, separated by commas.

    Of a subnet, these are the addresses that computers can have. Raises ConfigError if a part is something
    else, or if there are more than MAX_HOSTS.
    """
    hosts: dict[str, None] = {}
    for part in map(str.strip, text.split(",")):
        hosts.update(dict.fromkeys(_hosts_in(part)))
        if len(hosts) > MAX_HOSTS:
            raise ConfigError(f"found more than {MAX_HOSTS} addresses; expected at most {MAX_HOSTS} in all")
    return list(hosts)


def _hosts_in(part: str) -> Iterator[str]:
    """Return the hosts of one part. Raises ConfigError."""
    try:
        if is_address(part):  # in one form, so that no host is tried twice
            return iter([str(ipaddress.ip_address(validated(Host, part)))])
        if "/" not in part or "%" in part:  # ip_network would drop the network interface of fe80::%eth0/120
            return iter([validated(Host, part)])
        subnet = ipaddress.ip_network(part, strict=False)
    except (ValueError, ConfigError):
        raise ConfigError(
            f"found {describe(part)}; expected host names, addresses or a subnet such as 192.0.2.0/24, "
            f"separated by commas and without ports, because {_PORTS} are tried"
        ) from None
    if subnet.num_addresses > MAX_HOSTS:
        raise ConfigError(
            f"the subnet {subnet} has {subnet.num_addresses} addresses; expected at most {MAX_HOSTS} in all"
        )
    return map(str, subnet.hosts())


# The search --------------------------------------------------------------------------------


class Found(NamedTuple):
    """A program that accepts connections.

    ``text`` is what an RT server answers to Version, or why the program seems to be no RT server.
    """

    host: str
    port: int
    is_rt_server: bool
    text: str

    @property
    def server(self) -> str:
        """Host and port as ``--server`` takes them."""
        return f"{host_in_url(self.host)}:{self.port}"


class SearchResult(NamedTuple):
    """What a search has found.

    ``num_hosts`` is the number of hosts that were tried. ``unknown`` has a sentence for each host name
    without an address. ``failures`` counts the ports that accept no connection, by reason.
    """

    found: list[Found]
    num_hosts: int
    unknown: list[str]
    failures: Counter[str]

    @property
    def is_ok(self) -> bool:
        """Whether there is an RT server."""
        return any(each.is_rt_server for each in self.found)


async def search(hosts: Sequence[str], show: Callable[[str, int, int], None]) -> SearchResult:
    """Try the usual ports of ``hosts``, and ask what accepts a connection for its version.

    ``show`` is called with what is done, how much of it, and how much there is. The result is in the order
    of the hosts.
    """
    addresses, unknown = await _addresses_of(hosts)
    targets = [(host, port) for host in addresses for port in USUAL_PORTS]
    num_done = itertools.count(1)

    async def try_target(target: tuple[str, int]) -> Found | str:
        host, port = target
        result = await _try_port(host, addresses[host], port)
        show("trying ports", next(num_done), len(targets))
        return result

    results = await _map(try_target, targets)
    found = [result for result in results if isinstance(result, Found)]
    failures = Counter(result for result in results if isinstance(result, str))
    return SearchResult(found, len(addresses), unknown, failures)


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


async def _map(call: Callable[[_Item], Awaitable[_Result]], items: Sequence[_Item]) -> list[_Result]:
    """Return the result of ``call`` for each item; _MAX_PARALLEL calls run at a time."""
    results: dict[int, _Result] = {}
    waiting = iter(enumerate(items))

    async def work() -> None:
        for number, item in waiting:
            results[number] = await call(item)

    async with asyncio.TaskGroup() as group:
        for _ in range(_MAX_PARALLEL):
            group.create_task(work())
    return [results[number] for number in range(len(items))]


async def _addresses_of(hosts: Sequence[str]) -> tuple[dict[str, list[str]], list[str]]:
    """Return the addresses of each host, and a sentence for each that has none.

    If several hosts have the same address, only one of them keeps it, so that there are never two
    connections to a port: some servers serve one client only.
    """
    addresses = {host: [host] for host in hosts if is_address(host)}
    taken = set(addresses)
    names = [host for host in hosts if host not in addresses]
    unknown = []
    for name, found in zip(names, await _map(_look_up, names), strict=True):
        if isinstance(found, str):
            unknown.append(found)
        elif remaining := [address for address in found if address not in taken]:
            addresses[name] = remaining
            taken.update(remaining)
    return addresses, unknown


async def _look_up(name: str) -> list[str] | str:
    """Return the addresses of a host name, or why there are none."""
    try:
        async with RunningTimeout(_LOOK_UP_S):
            return await look_up(name)
    except OSError as error:  # includes TimeoutError, which has no text
        reason = error.strerror or f"no answer within {_LOOK_UP_S:g} s"
        return f"the host name {name!r} cannot be resolved: {reason}"


async def _try_port(host: str, addresses: Sequence[str], port: int) -> Found | str:
    """Return the program that accepts a connection, at the first address where one does, or why none does."""
    reason = ""
    for address in addresses:
        source = SourceSettings(
            name="search",
            host=address,
            port=port,
            connect_timeout_s=_CONNECT_S,
            reply_timeout_s=_REPLY_S,
            max_packet_bytes=_MAX_PACKET_BYTES,
        )
        status = StreamStatus("", name="search")
        session = Session(source, StreamSettings(), status, lambda *_: None)
        try:
            await session.connect()
        except ConnectError as error:
            cause = error.__cause__  # none if the time is over
            reason = (
                system_reason(cause) if isinstance(cause, OSError) else f"no answer within {_CONNECT_S:g} s"
            )
            continue
        is_rt_server, text = await _ask_version(session, status)
        await session.close()
        return Found(host, port, is_rt_server, text)
    return reason


async def _ask_version(session: Session, status: StreamStatus) -> tuple[bool, str]:
    """Send Version; return whether an RT server answers, and ``Found.text``."""
    try:
        async with RunningTimeout(_REPLY_S):  # ``ask`` waits longer while a C3D file arrives
            reply = await session.ask(Version())
    except ServerError as error:
        return True, safe_text(str(error), _MAX_REPLY_CHARACTERS)
    except (ReplyTimeoutError, TimeoutError):
        if session.has_data:
            return True, "it sends data and does not reply to Version"
        sent = counted(status.bytes_in, "byte") if status.bytes_in else "nothing"
        return False, f"it sends {sent}, and no reply, within {_REPLY_S:g} s"
    except LinkError as error:
        if isinstance(error.__cause__, PacketError):
            first_bytes = error.__cause__.first_bytes.decode("latin-1")
            return False, f"its first bytes are {quoted(first_bytes, 60)}"
        return False, "it closes the connection; perhaps it serves one client only and has one"
    return True, safe_text(decode_text(reply.body), _MAX_REPLY_CHARACTERS) or "an empty reply"


# The report --------------------------------------------------------------------------------


def result_lines(result: SearchResult) -> Iterator[str]:
    """Yield what was found, for people: each server, and the command that checks it."""
    for each in result.found:
        if each.is_rt_server:
            yield f"{each.server} answers as an RT server: {each.text}"
            yield f"  rtc3d-gateway doctor --server {shlex.quote(each.server)}"
        else:
            yield f"{each.server} accepts a connection but does not answer as an RT server: {each.text}"
    yield from result.unknown
    if not result.is_ok:
        failures = ", ".join(
            f"{counted(number, 'port')}: {reason}" for reason, number in result.failures.most_common()
        )
        yield (
            f"no RT server found: {counted(result.num_hosts, 'host')} tried, ports {_PORTS}"
            + (f" ({failures})" if failures else "")
        )
        yield (
            "Check the cable, that these addresses are in the server's subnet, that a firewall on its "
            "computer lets these ports through, and that the real-time output is enabled in the server's "
            "settings. If they show another port, use rtc3d-gateway doctor --server HOST:PORT."
        )


def result_json(result: SearchResult) -> dict[str, Any]:
    """Return the JSON object that docs/reference/commands.md describes."""
    return {
        "ok": result.is_ok,
        "found": [
            {"server": each.server, "is_rt_server": each.is_rt_server, "text": each.text}
            for each in result.found
        ],
        "num_hosts": result.num_hosts,
        "ports": USUAL_PORTS,
        "unknown": result.unknown,
        "failures": result.failures,
    }
