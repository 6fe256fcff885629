"""Takes with any content and damage: the arrays are those of LCM's own decoder, or an error is reported."""

import json
import struct
import tempfile
from io import StringIO
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from gateway.cli.take_report import statistics_json, write_report
from gateway.errors import ProtocolError, TakeError
from gateway.messages.decode import decode
from gateway.messages.encode import MESSAGE_TYPES
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ITEM_DTYPES, ComponentType
from gateway.takes import open_take
from gateway.takes.files.event_log import EventLogReader, encode_event
from gateway.takes.files.reader import TakeReader
from gateway.takes.files.statistics import take_statistics
from tests.strategies import damaged
from tests.takes import START_UTIME, Message, description, parameters
from tests.vectors import COMPONENTS

HEADER_BYTES = 28
int64s = st.integers(-(2**63), 2**63 - 1) | st.sampled_from((0, -1, 2**63 - 1, -(2**63))) | st.integers(0, 50)
int32s = st.integers(-(2**31), 2**31 - 1) | st.integers(0, 3)
utimes = int64s | st.integers(START_UTIME, START_UTIME + 10**9)
SPEC_XML = [path.read_bytes() for path in sorted((Path(__file__).parents[1] / "data/spec_xml").glob("*.xml"))]


@st.composite
def component_messages(draw: st.DrawFn) -> Message:
    component = draw(st.sampled_from(ComponentType))
    source = draw(st.sampled_from(["LAB", "LAB_2"]))
    number = draw(st.integers(0, 3))
    size = number * ITEM_DTYPES[component].itemsize
    head = struct.pack(
        ">qqqiiiqi",
        draw(utimes),
        draw(utimes),
        draw(int64s),
        draw(int32s),
        draw(int32s),
        draw(int32s),
        draw(int64s),
        number,
    )
    fingerprint = MESSAGE_TYPES[component]._get_packed_fingerprint()
    items = draw(st.binary(min_size=size, max_size=size))
    return f"MOCAP_{source}_{component.key.upper()}", fingerprint + head + items


other_messages = st.one_of(
    st.builds(
        parameters,
        st.sampled_from(SPEC_XML).filter(lambda xml: xml.isascii()),
        st.integers(0, 3),
        utime=utimes,
    ),
    st.just(description()),
    st.tuples(st.text(min_size=1, max_size=20).filter(str.isprintable), st.binary(max_size=80)),
)
events = st.lists(
    st.tuples(component_messages() | other_messages, utimes).map(
        lambda event: encode_event(7, event[1], event[0][0].encode()[:255], event[0][1])
    ),
    min_size=1,
    max_size=12,
)


def written(folder: str, content: bytes) -> Path:
    path = Path(folder) / "take.lcmlog"
    path.write_bytes(content)
    return path


@given(events)
def test_arrays_have_the_values_of_lcms_own_decoder(log: list[bytes]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = written(folder, b"".join(log))
        try:
            take = open_take(path)
        except TakeError:
            return
        expected: dict[tuple[str, str], list[bytes]] = {}
        for message in TakeReader(path).messages():
            expected.setdefault((message.source, message.key), []).append(message.message)
    for name, source in take.sources.items():
        for key, component in COMPONENTS_BY_KEY.items():
            naive = [decode(message) for message in expected.get((name, key), [])]
            if component is ComponentType.EVENT:
                naive = [message for message in naive for _ in range(message.num_events)]
            series = source.series.get(key)
            assert (0 if series is None else len(series)) == len(naive)
            if series is None:
                continue
            for column in ("utime", "capture_utime", "sequence", "session", "frame_number"):
                assert getattr(series, column).tolist() == [getattr(message, column) for message in naive]
            assert series.timestamp_us.tolist() == [message.timestamp for message in naive]
            runs = series.runs()
            assert sum(map(len, runs)) == len(series)
            assert np.array_equal(np.concatenate([run.utime for run in runs]), series.utime)
            if component is not ComponentType.EVENT:
                recorded = b"".join(run.items.astype(ITEM_DTYPES[component]).tobytes() for run in runs)
                assert recorded == b"".join(message[56:] for message in expected[name, key])
                assert series.items.shape == (len(series), len(series.labels))


@settings(max_examples=200)
@given(damaged(events.map(b"".join)))
def test_damage_is_reported_and_never_raises_another_error(log: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = written(folder, log)
        reader = EventLogReader(path)
        try:
            found = list(reader.events())
        except TakeError:
            found = []
        sizes = [HEADER_BYTES + len(event.channel.encode()) + len(event.message) for event in found]
        if found:
            assert sum(sizes) + reader.damaged_bytes == len(log)
            for event, size in zip(found, sizes, strict=True):
                encoded = encode_event(event.number, event.utime, event.channel.encode(), event.message)
                assert log[event.offset : event.offset + size] == encoded
        try:
            take = open_take(path)
            statistics = take_statistics(path)
        except TakeError:
            return
    assert statistics.num_messages == len(found)
    for source_arrays in take.sources.values():
        for series in source_arrays.series.values():
            _ = (series.items, series.runs(), series.measured_rate_hz, series.seconds, series.event_labels)
    json.dumps(statistics_json(statistics))
    write_report(statistics, Console(file=StringIO()))


@given(st.sampled_from([part.wire["big"] for part in COMPONENTS]), st.binary(max_size=30))
def test_a_message_of_the_wrong_size_is_malformed(wire: bytes, rest: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for key, component in COMPONENTS_BY_KEY.items():
            message = MESSAGE_TYPES[component]._get_packed_fingerprint() + bytes(32) + wire[8:] + rest
            path = written(folder, encode_event(0, 1, f"MOCAP_LAB_{key.upper()}".encode(), message))
            try:
                decode(message)
                is_whole = len(message) == len(decode(message).encode())
            except ProtocolError:
                is_whole = False
            source = open_take(path).sources["lab"]
            assert source.malformed == ({} if is_whole else {key: 1})
