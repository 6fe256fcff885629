"""Takes with any content and damage.

The arrays are those of LCM's own decoder, or an error is reported. A take has what was published, and a seek
gives the same as reading everything.
"""

import asyncio
import json
import struct
import tempfile
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from gateway.errors import ProtocolError, TakeError
from gateway.messages.decode import decode
from gateway.messages.encode import MESSAGE_TYPES
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ITEM_DTYPES, ComponentType
from gateway.takes import open_take
from gateway.takes.files.event_log import EventLogReader
from gateway.takes.files.reader import TakeReader
from gateway.takes.files.statistics import take_statistics
from gateway.tools.cli.take_report import statistics_json, write_report
from gateway.tools.replay.play_list import Entry, SeekIndex, Selection, play_list
from gateway.tools.replay.timeline import ReplayTimeline
from tests.support.examples import examples
from tests.support.recording_output import events as recorded_events
from tests.support.recording_output import still_lab
from tests.support.strategies import damaged
from tests.support.takes import (
    START_UTIME,
    Message,
    description,
    encode_event,
    markers,
    parameters,
    write_take,
)
from tests.support.vectors import COMPONENTS

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
        if take.num_recordings > 1:  # they are sorted, and what several have occurs once
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


@settings(max_examples=examples(200))
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


STEPS = st.lists(
    st.one_of(
        st.tuples(st.sampled_from(["3d", "event", "6d"]), st.integers(0, 20)),
        st.tuples(st.just("parameters"), st.integers(0, 100)),
        st.tuples(st.sampled_from(["start", "stop", "pause"]), st.just(0)),
    ),
    max_size=60,
)


@settings(max_examples=examples(50))
@given(steps=STEPS)
def test_a_take_is_what_was_published(steps: list[tuple[str, int]]) -> None:
    """However starts, stops, frames and parameters follow each other."""
    with tempfile.TemporaryDirectory() as folder:
        expected = asyncio.run(_record(Path(folder), steps))
        for name, messages in expected.items():
            found = recorded_events(Path(folder) / "lab" / f"{name}.lcmlog")[1:]
            assert [event.message for event in found if not event.channel.endswith("_PARAMETERS")] == [
                message for message in messages if isinstance(message, bytes)
            ]
            assert [event.channel.endswith("_PARAMETERS") for event in found] == [
                not isinstance(message, bytes) for message in messages
            ]


async def _record(folder: Path, steps: list[tuple[str, int]]) -> dict[str, list[bytes | None]]:
    """Make the steps; return what each take must have, None for parameters."""
    takes: dict[str, list[bytes | None]] = {}
    running: list[bytes | None] | None = None
    has_parameters = False
    async with still_lab(folder) as lab:
        for number, (step, size) in enumerate(steps):
            match step:
                case "start" if running is None:
                    await lab.takes.start(str(number))
                    running = takes[str(number)] = [None] if has_parameters else []
                case "stop" if running is not None:
                    await lab.takes.stop()
                    running = None
                case "pause":
                    await lab.output.storage.written()
                case "parameters":
                    xml = b"<!--" + b"x" * (size * 1000) + b"-->"
                    sent = lab.output.publish_parameters("lab", ServerParameters(xml, 1, number))
                    if sent is not None:
                        await sent
                    has_parameters = True
                    if running is not None:
                        running.append(None)
                case "3d" | "event" | "6d":
                    message = lab.publish(step, size if step == "3d" else 0)
                    if running is not None:
                        running.append(message)
    return takes


XML = b"<Parameters><The_3D><Markers>1</Markers></The_3D></Parameters>"

steps = st.tuples(
    st.sampled_from(["lab", "stage"]),
    st.sampled_from(["frame", "frame", "frame", "parameters"]),
    st.sampled_from([0, *[300_000] * 5, 2_500_000, 60_000_000, -10_000_000]),  # gaps, steps of the clock
)


def entries(reader: TakeReader, start_us: int, index: SeekIndex | None) -> list[Entry]:
    return list(play_list(reader, Selection(), ReplayTimeline(), start_us, index))


@settings(max_examples=examples(60))
@given(
    st.lists(steps, min_size=15, max_size=60),
    st.integers(1, 3),
    st.lists(st.integers(0, 8_000_000), min_size=2, max_size=6),
)
def test_reading_from_the_index_gives_the_same(
    made: list[tuple[str, str, int]], num_files: int, starts: list[int]
) -> None:
    """Whatever the gaps, the steps of clocks and the division into files are."""
    utimes = dict.fromkeys(("lab", "stage"), START_UTIME)
    messages = [description(), description("stage")]  # one for each source
    for number, (source, kind, step_us) in enumerate(made):
        utimes[source] += step_us
        if kind == "frame":
            messages.append(markers(1, number, source=source, utime=utimes[source]))
        else:
            messages.append(parameters(XML, number, source=source, utime=utimes[source]))
    with TemporaryDirectory() as folder:
        size = -(-len(messages) // num_files)
        for place in range(0, len(messages), size):
            write_take(Path(folder) / f"{place:04}.lcmlog", messages[place : place + size])
        reader, index = TakeReader(Path(folder)), SeekIndex()
        for start_us in starts:
            assert entries(reader, start_us, index) == entries(reader, start_us, None)
