"""Test that the benchmarks with two sites count exactly, even if Python replaces the programs in Rust."""

import pytest

from benchmarks.processes import Worker, source
from benchmarks.sites.fan_out import connect
from benchmarks.sites.subscribers import Received, received
from benchmarks.sites.two_sites import TwoSites
from benchmarks.workbench import GATEWAY
from benchmarks.workloads import DENSE, Paced, cuts, send

FRAMES = 100
RATE_HZ = 100
SENT_BYTES = FRAMES * sum(cut.last - cut.first for cut in cuts(DENSE.packet()))


def counts(total: Received) -> tuple[int, int, int]:
    """Return the messages, their bytes, and how many are missing."""
    return total.messages, total.message_bytes, total.missing


@pytest.mark.netns
def test_without_loss_the_counts_are_exact_and_the_link_carries_one_copy() -> None:
    with (
        Worker(send, DENSE, [GATEWAY]) as sender,
        TwoSites() as sites,
        sites.a.gateway("gateway", [source(GATEWAY, sender.started[GATEWAY])]),
        sites.a.subscribers(1) as at_a,
        sites.b.subscribers(2) as at_b,
    ):
        connect(sender, (at_a, at_b))
        before = sites.network.bytes_to_b()
        sender.ask(Paced(GATEWAY, FRAMES, RATE_HZ))
        assert counts(received(at_a.wait_for(5 * FRAMES))) == (5 * FRAMES, SENT_BYTES, 0)
        assert counts(received(at_b.wait_for(10 * FRAMES))) == (10 * FRAMES, 2 * SENT_BYTES, 0)
        assert SENT_BYTES < sites.network.bytes_to_b() - before < 2 * SENT_BYTES
