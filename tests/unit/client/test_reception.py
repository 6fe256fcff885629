"""The messages of one key, counted, and when gateways are queried about their sources."""

from gateway.client.sources import ReceivedSeries, ReceivedSource
from gateway.messages.encode import NOT_PUBLISHED, PREFIX
from tests.support.clocks import Clock


def test_messages_without_a_number_are_counted_and_show_no_loss() -> None:
    """A status that answers a query has no number, and a time of its own."""
    series = ReceivedSeries(ReceivedSource("lab", "MOCAP_LAB"), "3d", "MOCAP_LAB_3D")
    for utime, number in ((10, 5), (99, NOT_PUBLISHED), (30, 7), (99, NOT_PUBLISHED)):
        series.count(bytes(8) + PREFIX.pack(utime, utime, number, 3, 1))
    assert (series.num_messages, series.check.num_lost, series.check.num_gaps) == (4, 1, 1)
    assert (series.first_utime, series.last_utime, series.check.session) == (10, 30, 3)


def test_queries_without_a_reply_become_rarer() -> None:
    """Many recorders of a gateway of an earlier version must not load the network for ever."""
    clock = Clock()
    source = ReceivedSource("lab", "MOCAP_LAB", clock)
    due_s = []
    for tick in range(36_000):  # an hour
        clock.now_s = 1000.0 + tick / 10
        if source.begin_query():
            due_s.append(tick / 10)
    assert sum(time_s < 1 for time_s in due_s) >= 3
    assert 360 < len(due_s) < 450
    assert due_s[-1] > 3580
