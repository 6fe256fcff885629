"""What is said if nothing arrives from gateways."""

import pytest

from gateway.live.live_data import LiveData
from gateway.subscriber.subscribe import silence_text


class Subscriber:
    """A subscriber that has found no gateway, for this reason, or one that does not send."""

    def __init__(self, reason: str) -> None:
        self.reason = reason

    def tick(self) -> None: ...

    def silence(self) -> str:
        return self.reason

    def close(self) -> None: ...


@pytest.mark.parametrize(
    ("reason", "sources", "text"),
    [
        ("no gateway found", [], "no gateway found"),
        ("", ["hall", "lab"], "a gateway serves hall, lab, but nothing arrives from it; try again"),
        ("", [], "a gateway serves this source, but nothing arrives from it; try again"),
    ],
)
def test_silence_has_a_reason_also_if_a_gateway_is_found(reason: str, sources: list[str], text: str) -> None:
    live = LiveData()
    for source in sources:
        live.source(source, source.upper(), is_known=True)
    assert silence_text(Subscriber(reason), live) == text
