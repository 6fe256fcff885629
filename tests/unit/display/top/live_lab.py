"""Live data of gateways that a test invents."""

import struct
from typing import Any

import numpy as np
import rtc3d

from gateway.client.series import FINGERPRINTS
from gateway.display.live.live_data import LiveData, LiveSource
from gateway.messages.encode import PREFIX
from gateway.messages.host_time import now_utime
from gateway.outputs.contract import ServerParameters
from gateway.outputs.parameters_message import encode_parameters
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ITEM_DTYPES, MISSING


class LiveLab:
    """Publishes as the gateway of a source does."""

    def __init__(self, live: LiveData | None = None, name: str = "lab") -> None:
        self.live = LiveData() if live is None else live
        self.name = name

    def frame(self, key: str, sequence: int, items: int, *, missing: tuple[int, ...] = ()) -> None:
        """Publish a component whose items are all 1, and NaN where they are ``missing``."""
        array = np.zeros(items, ITEM_DTYPES[COMPONENTS_BY_KEY[key]])
        for name in array.dtype.names or ():
            array[name] = 1
            for index in missing:
                array[name][index] = MISSING
        utime = now_utime()
        head = FINGERPRINTS[key] + PREFIX.pack(utime, utime - 2000, sequence, 1, 1)
        head += struct.pack(">iqi", sequence, 5000 * sequence, items)
        self.live.publish(self.name, key, head + array.tobytes())

    def labels(self, *labels: str, rate_hz: float = 200) -> None:
        """Publish parameters with these markers."""
        names = "".join(f"<Marker><Label><![CDATA[{label}]]></Label></Marker>" for label in labels)
        xml = (
            f"<Parameters><The_3D><Markers>{len(labels)}</Markers><Frequency>{rate_hz}</Frequency>{names}"
            "</The_3D></Parameters>"
        )
        parameters = ServerParameters(xml.encode(), 1, 1)
        self.live.publish(
            self.name, "parameters", encode_parameters(parameters, utime=1, arrived_utime=1, sequence=0)
        )

    def status(self, *streams: Any, outputs: tuple[Any, ...] = (), **fields: Any) -> None:
        """Publish a status."""
        message = rtc3d.status_t()
        message.source, message.server, message.host = self.name, "192.0.2.20:3020", "gw1"
        message.gateway_version = "1.2.3"
        message.streams, message.num_streams = [*streams], len(streams)
        message.outputs, message.num_outputs = [*outputs], len(outputs)
        for name, value in fields.items():
            setattr(message, name, value)
        self.live.publish(self.name, "status", message.encode())

    def source(self) -> LiveSource:
        """Return the source as it is now."""
        return next(source for source in self.live.update() if source.name == self.name)
