"""Takes for tests: messages as a gateway publishes them, event logs of them, and those of whole scenes."""

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import rtc3d

from gateway.messages.encode import Stamp, encode_message
from gateway.messages.topics import lcm_channel
from gateway.rtc3d.components import ITEM_DTYPES, WIRE_ORDER, Component, ComponentType, encode_component
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.parameters_xml import encode_parameters
from gateway.session.server.measurement import exact_rate
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes.files.description import SourceDescription, TakeDetails
from gateway.takes.files.event_log import SYNC

START_UTIME = 1_700_000_000_000_000

SERVER_START_US = 5_000_000
"""The server's time of the first sample of a scene."""

Message = tuple[str, bytes]
"""A channel and a message."""


def frame(
    component: ComponentType,
    items: Sequence[Any],
    sequence: int = 0,
    *,
    utime: int | None = None,
    session: int = 1,
    version: int = 1,
    timestamp_us: int | None = None,
    frame_number: int | None = None,
    source: str = "lab",
) -> Message:
    """Return a message with these items; without times, it belongs to 100 frames per second."""
    number = sequence if frame_number is None else frame_number
    time_us = sequence * 10_000 if timestamp_us is None else timestamp_us
    array = np.array(list(items), ITEM_DTYPES[component])
    content = encode_component(component, number, time_us, array)[8:]
    found = Component(component, number, time_us, len(array), array.itemsize, "big", content)
    arrival = START_UTIME + sequence * 10_000 if utime is None else utime
    message = encode_message(found, Stamp(arrival, arrival - 2000, session, version), sequence)
    return lcm_channel("MOCAP", source, component.key), message


def markers(labels_or_number: int, sequence: int = 0, **options: Any) -> Message:
    """Return a message with markers whose x is their position, and y the sequence number."""
    items = [(place, sequence, 0.5, 0.1) for place in range(labels_or_number)]
    return frame(ComponentType.MARKERS, items, sequence, **options)


def parameters(
    content: Parameters | bytes, version: int = 1, *, utime: int = START_UTIME, source: str = "lab"
) -> Message:
    """Return a ``parameters_t``."""
    message = rtc3d.parameters_t()
    message.utime = message.capture_utime = utime
    message.parameters_version = version
    message.xml = (content if isinstance(content, bytes) else encode_parameters(content)).decode()
    return lcm_channel("MOCAP", source, "parameters"), message.encode()


def description(source: str = "lab", server: str = "192.0.2.20:3020") -> Message:
    """Return a ``take_t``."""
    message = rtc3d.take_t()
    message.utime = START_UTIME
    message.name, message.source, message.server = "take", source, server
    message.channels = lcm_channel("MOCAP", source)
    message.gateway_version = message.recorder = "1.0"
    return lcm_channel("MOCAP", source, "take"), message.encode()


def details(subject: str = "", session: str = "", note: str = "", source: str = "lab") -> Message:
    """Return a ``take_details_t``."""
    about = SourceDescription(
        source, lcm_channel("MOCAP", source), details=TakeDetails(subject, session, note)
    )
    channel, message = about.beginning("take", START_UTIME)[1]
    return channel.decode(), message


def encode_event(number: int, utime: int, channel: bytes, message: bytes) -> bytes:
    """Return an event as in a file; ``utime`` is its time in µs since the Unix epoch."""
    header = struct.pack(">4sqqii", SYNC, number, utime, len(channel), len(message))
    return b"%b%b%b" % (header, channel, message)


def log_bytes(messages: Iterable[Message]) -> bytes:
    """Return an event log; the time of an event is the ``utime`` of its message, if it is long enough."""
    return b"".join(
        encode_event(number, _utime(message), channel.encode(), message)
        for number, (channel, message) in enumerate(messages)
    )


def _utime(message: bytes) -> int:
    utime: int = struct.unpack_from(">q", message, 8)[0] if len(message) >= 16 else START_UTIME
    return utime


def write_take(path: Path, messages: Iterable[Message]) -> Path:
    """Write an event log; return its path."""
    path.write_bytes(log_bytes(messages))
    return path


def scene_messages(
    scene: C3dScene | SyntheticScene,
    num_frames: int,
    *,
    source: str = "lab",
    session: int = 1,
    start_us: int = 0,
    server_start_us: int = SERVER_START_US,
    sequence: int = 0,
    keep: Callable[[ComponentType, int], bool] = lambda _component, _sample: True,
) -> Iterator[Message]:
    """Yield the messages of so many frames of a scene, with its time stamps, in the order of time.

    ``keep`` says which samples of a component arrive. The times of capture have a jitter of up to 0.4 ms.
    """
    jitter = np.random.default_rng(7)
    slowest = exact_rate(scene.measurement_rate_hz)
    due: list[tuple[Fraction, ComponentType, int]] = []
    items = {}
    for component in WIRE_ORDER:
        if component in scene.rates_hz:
            rate = exact_rate(scene.rates_hz[component])
            count = int(num_frames * rate / slowest)
            items[component] = scene.items(component, np.arange(count))
            due += [(number / rate, component, number) for number in range(count)]
    for time_s, component, number in sorted(due, key=lambda entry: entry[0]):
        if keep(component, number):
            time_us = start_us + int(time_s * 1_000_000)
            yield frame(
                component,
                items[component][number].tolist(),
                sequence + number,
                utime=START_UTIME + time_us + 3000 + int(jitter.integers(400)),
                session=session,
                timestamp_us=server_start_us + time_us,
                frame_number=number + 1,
                source=source,
            )


def record_scene(path: Path, scene: C3dScene | SyntheticScene, num_frames: int) -> Path:
    """Write a take of a scene; return its path."""
    return write_take(path, [description(), parameters(scene.parameters), *scene_messages(scene, num_frames)])
