import time

from gateway.messages.host_time import now_utime


def test_the_hosts_time_is_in_microseconds_since_the_unix_epoch() -> None:
    before_ns = time.time_ns()
    utime = now_utime()
    assert before_ns // 1000 <= utime <= time.time_ns() // 1000
