"""The receive buffer of subscribers on LCM."""

from pathlib import Path

import pytest

from gateway.outputs.lcm import connection
from gateway.outputs.lcm.connection import receiving_url


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


def test_without_a_known_limit_the_kernel_decides(rmem_max: Path) -> None:
    assert not rmem_max.exists()
    assert receiving_url("udpm://") == "udpm://"
