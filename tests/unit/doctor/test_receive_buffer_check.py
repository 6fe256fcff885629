"""The check of tcp_rmem against the load of a stream."""

from pathlib import Path

import pytest

from gateway.doctor.receive_buffer_check import check_receive_buffer
from gateway.findings import Finding, Result, Subject

LINUX = "4096\t131072\t6291456\n"


def check(folder: Path, tcp_rmem: str, load_bytes_per_s: float) -> Finding:
    path = folder / "tcp_rmem"
    path.write_text(tcp_rmem)
    return check_receive_buffer(Subject("lab"), load_bytes_per_s, path)


@pytest.mark.parametrize(
    ("load_bytes_per_s", "found"),
    [
        (150_000, "the kernel holds what the server sends in 21 s (0.15 MB/s)"),
        (1_500_000, "the kernel holds what the server sends in 2 s (1.5 MB/s)"),
        (100, "the kernel holds what the server sends in 60 s (0.0001 MB/s)"),
    ],
)
def test_a_buffer_for_two_seconds_passes(tmp_path: Path, load_bytes_per_s: float, found: str) -> None:
    finding = check(tmp_path, LINUX, load_bytes_per_s)
    assert (finding.result, finding.found) == (Result.PASSING, found)


def test_a_smaller_buffer_fails_with_what_to_set(tmp_path: Path) -> None:
    finding = check(tmp_path, LINUX, 2_252_000)
    assert (finding.subject, finding.check, finding.result) == ("lab", "buffer", Result.FAILING)
    assert finding.found == (
        "the kernel holds only what the server sends in 1.4 s (2.3 MB/s); "
        "if the gateway stops for longer, frames may be lost"
    )
    assert finding.remedy == (
        'Run sysctl -w net.ipv4.tcp_rmem="4096 131072 9437184", and put '
        "net.ipv4.tcp_rmem = 4096 131072 9437184 into /etc/sysctl.d/90-rtc3d.conf to keep it."
    )


def test_what_the_remedy_says_passes(tmp_path: Path) -> None:
    assert check(tmp_path, "4096 131072 9437184", 2_252_000).result is Result.PASSING


@pytest.mark.parametrize("tcp_rmem", ["", "4096 131072", "a b c"])
def test_an_unknown_size_is_not_tested(tmp_path: Path, tcp_rmem: str) -> None:
    finding = check(tmp_path, tcp_rmem, 1000)
    assert finding.result is Result.NOT_TESTED
    assert finding.found.startswith(f"{tmp_path}/tcp_rmem cannot be read: ")


def test_without_linux_it_is_not_tested(tmp_path: Path) -> None:
    finding = check_receive_buffer(Subject("lab"), 1000, tmp_path / "missing")
    assert finding.result is Result.NOT_TESTED


def test_without_frames_it_is_not_tested(tmp_path: Path) -> None:
    assert check(tmp_path, LINUX, 0.0).found == "no frames arrived"
