"""Check that the kernel can hold what a server sends while the gateway stands still."""

from pathlib import Path
from typing import Final

from gateway.findings import Finding, Subject

CHECK: Final = "buffer"
_TCP_RMEM: Final = Path("/proc/sys/net/ipv4/tcp_rmem")
_STOP_S: Final = 2.0
_PAYLOAD_SHARE: Final = 0.5
"""The part of a receive buffer that data can use. The kernel needs the rest to manage packets."""


def check_receive_buffer(subject: Subject, load_bytes_per_s: float, tcp_rmem: Path = _TCP_RMEM) -> Finding:
    """Check that one connection's receive buffer can hold what arrives in 2 s.

    ``tcp_rmem`` has the smallest, the initial and the largest size of a receive buffer, in bytes. The gateway
    has the kernel provide the largest one (gateway/stream/tcp.py).
    """
    if not load_bytes_per_s:
        return subject.not_tested(CHECK, "no frames arrived")
    try:
        smallest, initial, largest = map(int, tcp_rmem.read_text("ascii").split())
    except (OSError, ValueError) as error:
        return subject.not_tested(CHECK, f"{tcp_rmem} cannot be read: {error}")
    holds_s = largest * _PAYLOAD_SHARE / load_bytes_per_s
    load = f"{load_bytes_per_s / 1e6:.2g} MB/s"
    if holds_s >= _STOP_S:
        text = f"the kernel holds what the server sends in {min(holds_s, 60):.0f} s ({load})"
        return subject.passing(CHECK, text)
    needed = _next_mebibyte(load_bytes_per_s * _STOP_S / _PAYLOAD_SHARE)
    return subject.failing(
        CHECK,
        f"the kernel holds only what the server sends in {holds_s:.1f} s ({load}); "
        "if the gateway stops for longer, frames may be lost",
        f'Run sysctl -w net.ipv4.tcp_rmem="{smallest} {initial} {needed}", and put '
        f"net.ipv4.tcp_rmem = {smallest} {initial} {needed} into /etc/sysctl.d/90-rtc3d.conf to keep it.",
    )


def _next_mebibyte(size: float) -> int:
    mebibyte = 1 << 20
    return (int(size) // mebibyte + 1) * mebibyte
