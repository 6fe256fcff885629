"""The hosts that ``doctor --find`` names: which addresses are tried, and what is refused."""

import ipaddress
from collections.abc import Sequence
from typing import NamedTuple

from hypothesis import example, given, settings
from hypothesis import strategies as st

from gateway.config.section import validated
from gateway.config.values import Host
from gateway.errors import ConfigError
from gateway.tools.doctor.search import MAX_HOSTS, parse_hosts
from tests.support.errors import raises
from tests.support.examples import examples


class Part(NamedTuple):
    """A part of HOSTS, and the hosts that it names. It counts as too large by itself if they are None."""

    text: str
    hosts: list[str] | None


def _subnet(number: int, prefix: int, bits: int) -> Part:
    """Return a subnet with a host's bits; of more than two addresses, the first names the network itself."""
    kind = ipaddress.IPv4Address if bits == 32 else ipaddress.IPv6Address
    size = 1 << (bits - prefix)
    first = number - number % size
    numbers = range(first, first + size)
    if size > 2:
        numbers = numbers[1:-1] if bits == 32 else numbers[1:]  # the last one of IPv4 is for broadcasts
    text = f"{kind(number)}/{prefix}"
    return Part(text, None if size > 256 else [str(kind(each)) for each in numbers])


ADDRESSES = st.ip_addresses().map(lambda address: Part(address.exploded, [str(address)]))
NAMES = st.from_regex(r"[a-z]{1,10}(\.[a-z]{1,10})?", fullmatch=True).map(lambda name: Part(name, [name]))
NEAR = st.integers(0xC0000200, 0xC00002FF)  # 192.0.2.0/24, so that parts overlap
SUBNETS = st.one_of(
    st.builds(_subnet, NEAR | st.integers(0, 2**32 - 1), st.integers(22, 32), st.just(32)),
    st.builds(_subnet, st.integers(0, 2**128 - 1), st.integers(118, 128), st.just(128)),
)
PARTS = st.lists(ADDRESSES | NAMES | SUBNETS, min_size=1, max_size=6)


@settings(max_examples=examples(40))
@given(parts=PARTS, space=st.sampled_from(["", " ", "\t "]))
@example(parts=[_subnet(0xC0000200, 24, 32), Part("a", ["a"]), Part("b", ["b"])], space="")
@example(parts=[_subnet(0xC0000200, 24, 32), Part("a", ["a"]), Part("b", ["b"]), Part("c", ["c"])], space="")
def test_each_host_is_tried_once_and_in_order(parts: Sequence[Part], space: str) -> None:
    """A second connection to a port can disturb a server that serves one client only."""
    text = f"{space},{space}".join(part.text for part in parts)
    expected: dict[str, None] = {}
    for part in parts:
        if part.hosts is not None:
            expected |= dict.fromkeys(part.hosts)
    if len(expected) > MAX_HOSTS or any(part.hosts is None for part in parts):
        with raises(ConfigError, MAX_HOSTS):
            parse_hosts(text)
    else:
        assert parse_hosts(text) == list(expected)


@given(st.text() | st.text("0123456789abcdef.:/,%- \x1b[", max_size=40))
@example("fe80::%eth0/120")
@example("192.0.2.1,")
@example("192.0.2.1:3020")
@example("::/0")
def test_any_text_gives_hosts_or_one_printable_line(text: str) -> None:
    refusal, hosts = "", []
    try:
        hosts = parse_hosts(text)
    except ConfigError as error:
        refusal = str(error)
    assert refusal.isprintable()
    assert bool(refusal) is not bool(hosts)
    assert len(hosts) <= MAX_HOSTS
    assert [validated(Host, host) for host in hosts] == hosts


def test_a_link_local_address_keeps_its_interface() -> None:
    assert parse_hosts("FE80::1%eth0") == ["fe80::1%eth0"]
