import socket

import pytest

from gateway.outputs.listen_address import family_of, from_this_computer, host_in_url, is_loopback

ALL_IPV4 = "0.0.0.0"  # noqa: S104 - not bound


def test_who_can_reach_an_address() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "127.1.2.3", "::1", "localhost")))
    assert not any(map(is_loopback, ("192.0.2.1", "lab-pc", "::", ALL_IPV4)))


@pytest.mark.parametrize(
    ("listens_on", "address", "in_url", "family"),
    [
        (ALL_IPV4, "127.0.0.1", "127.0.0.1", socket.AF_INET),
        ("::", "::1", "[::1]", socket.AF_INET6),
        ("192.0.2.1", "192.0.2.1", "192.0.2.1", socket.AF_INET),
        ("lab-pc", "lab-pc", "lab-pc", socket.AF_INET),
    ],
)
def test_how_to_connect_from_this_computer(
    listens_on: str, address: str, in_url: str, family: socket.AddressFamily
) -> None:
    assert from_this_computer(listens_on) == address
    assert host_in_url(address) == in_url
    assert family_of(listens_on) is family
