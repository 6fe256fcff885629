"""URLs of LCM: the receive buffer of subscribers, and host names."""

import os
from pathlib import Path

import pytest

from gateway.errors import OutputError
from gateway.outputs.lcm import connection
from gateway.outputs.lcm.connection import open_lcm, receiving_url
from tests.lcm_relay import LcmRelay
from tests.waiting import wait_until


@pytest.fixture
def rmem_max(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "rmem_max"
    monkeypatch.setattr(connection, "_RMEM_MAX", path)
    return path


@pytest.mark.parametrize(("allowed", "size"), [(212992, 212992), (2**23, 2**22)])
def test_a_multicast_subscriber_gets_as_large_a_buffer_as_the_kernel_allows(
    rmem_max: Path, allowed: int, size: int
) -> None:
    rmem_max.write_text(f"{allowed}\n")
    assert receiving_url("udpm://239.255.76.67:7667?ttl=0") == (
        f"udpm://239.255.76.67:7667?ttl=0&recv_buf_size={size}"
    )
    assert receiving_url("udpm://") == f"udpm://?recv_buf_size={size}"


@pytest.mark.parametrize(
    "url", ["udpm://239.255.76.67:7667?recv_buf_size=1000", "memq://", "tcpq://host:7700"]
)
def test_other_urls_stay_as_they_are(rmem_max: Path, url: str) -> None:
    rmem_max.write_text("212992\n")
    assert receiving_url(url) == url


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_a_relay_is_found_by_its_name(host: str) -> None:
    relay = LcmRelay()
    connection = open_lcm(relay.url.replace("127.0.0.1", host))
    connection.subscribe("NAME", lambda *_: None)
    wait_until(lambda: "NAME" in relay.subscribed)
    relay.close()


@pytest.mark.netns
def test_a_name_that_is_not_known_does_not_mean_this_computer() -> None:
    relay = LcmRelay()
    url = relay.url.replace("127.0.0.1", "nowhere.invalid")
    with pytest.raises(OutputError, match=f"the host name 'nowhere.invalid' of {url} cannot be resolved: "):
        open_lcm(url)
    relay.close()


def test_without_a_known_limit_the_kernel_decides(rmem_max: Path) -> None:
    assert not rmem_max.exists()
    assert receiving_url("udpm://") == "udpm://"


def test_a_pipe_of_another_thread_is_not_kept_open() -> None:
    """Whoever reads it waits until every copy of the other end is closed, as subprocess does."""
    reading, writing = os.pipe()
    try:
        with pytest.raises(OSError, match="non-socket"):
            connection._set_up_to_send(writing)
        os.close(writing)
        os.set_blocking(reading, False)
        assert os.read(reading, 1) == b""
    finally:
        os.close(reading)
