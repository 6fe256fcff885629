"""How many messages the thread that receives requests takes."""

import pytest

from gateway.outputs.lcm.receiver import LcmReceiver
from gateway.token_bucket import TokenBucket
from tests.settable_clock import Clock


def test_messages_on_other_channels_leave_room_for_requests() -> None:
    """On udpm://, the gateway's own messages arrive, too: they must not delay the replies."""
    receiver = LcmReceiver("udpm://", "MOCAP", None, 64, lambda: None)
    receiver._received = bucket = TokenBucket(100.0, monotonic=Clock(0.0))
    requests: list[bytes] = []
    receiver.add("MOCAP_LAB_COMMAND_REQUEST", requests.append)
    for _ in range(100):
        receiver._handle("MOCAP_LAB_3D", b"message")
    assert bucket.left == pytest.approx(95.0)
    receiver._handle("MOCAP_LAB_COMMAND_REQUEST", b"request")
    assert bucket.left == pytest.approx(94.0)
    assert requests == [b"request"]
