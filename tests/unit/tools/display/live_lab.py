"""A source whose messages arrive as a test sends them."""

import re
import time
from collections.abc import Sequence
from typing import Any

import pytest
import rtc3d

from gateway.messages.host_time import now_utime
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ITEM_DTYPES, ComponentType
from gateway.tools.display.live import DisplayedSource, LiveData
from tests.support.takes import frame, parameters

NAN = float("nan")
MISSING = (NAN, NAN, NAN, 999.0)


class Lab:
    """The source lab, whose messages arrive as they are sent."""

    def __init__(self, name: str = "lab", live: LiveData | None = None) -> None:
        self.name = name
        self.live = LiveData() if live is None else live
        self._sequences: dict[ComponentType, int] = {}

    @property
    def source(self) -> DisplayedSource:
        """The source, with everything that was sent."""
        return next(source for source in self.live.update() if source.name == self.name)

    def send(self, component: ComponentType, items: Sequence[Any], **options: Any) -> None:
        """Send a message, by default captured now, with the next sequence number."""
        sequence = options.pop("sequence", self._sequences.get(component, 0))
        self._sequences[component] = sequence + 1
        _, message = frame(component, items, sequence, **{"utime": now_utime(), **options})
        self.live.publish(self.name, component.key, message)

    def send_markers(self, *visible: bool) -> None:
        """Send a frame with markers that are visible or not."""
        self.send(ComponentType.MARKERS, [(1, 2, 3, 0.1) if each else MISSING for each in visible])

    def send_ones(self, key: str, sequence: int, num_items: int, *, missing: tuple[int, ...] = ()) -> None:
        """Send a component whose items are all 1, and NaN where they are ``missing``."""
        component = COMPONENTS_BY_KEY[key]
        num_fields = len(ITEM_DTYPES[component].names or ())
        items = [(NAN if place in missing else 1,) * num_fields for place in range(num_items)]
        self.send(component, items, sequence=sequence)

    def send_labels(self, *labels: str) -> None:
        """Send parameters with these markers, at 200 Hz."""
        names = "".join(f"<Marker><Label><![CDATA[{label}]]></Label></Marker>" for label in labels)
        self.send_parameters(
            f"<The_3D><Markers>{len(labels)}</Markers><Frequency>200</Frequency>{names}</The_3D>"
        )

    def send_parameters(self, xml: str) -> None:
        """Send parameters."""
        _, message = parameters(f"<Parameters>{xml}</Parameters>".encode())
        self.live.publish(self.name, "parameters", message)

    def send_status(self, *streams: rtc3d.stream_status_t, **fields: Any) -> None:
        """Send a status with these streams."""
        status = rtc3d.status_t()
        status.source, status.server, status.gateway_version = self.name, "192.0.2.9:3020", "1.2.3"
        status.host = "gatewaypc"
        for name, value in fields.items():
            setattr(status, name, value)
        status.streams, status.num_streams = list(streams), len(streams)
        status.num_outputs = len(status.outputs)
        self.live.publish(self.name, "status", status.encode())


def text_of(html: str) -> str:
    """Return the text of a page, with | between cells and lines."""
    return re.sub(r"\s*(<[^>]*>\s*)+", "|", html)


def wait(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Let the monotonic clock stand still at a time that is so much later."""
    now_s = time.monotonic() + seconds
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
