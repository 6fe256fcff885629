"""What a ``status_t`` says, in the words of the status line, and within limits whatever it contains."""

import itertools
from typing import Any

import pytest
import rtc3d

from gateway.messages.source_report import MAX_ENTRIES, MAX_STREAMS, Level, source_report, streams_text
from gateway.session.state import StreamState
from tests.support.statuses import count, loss, output, stream

SERVER = "192.0.2.9:3020"


def a_status(*streams: Any, outputs: tuple[Any, ...] = (), **fields: Any) -> rtc3d.status_t:
    """Return a status as it arrives."""
    status = rtc3d.status_t()
    status.source, status.server = "lab", SERVER
    status.streams, status.num_streams = [*streams], len(streams)
    status.outputs, status.num_outputs = [*outputs], len(outputs)
    for name, value in fields.items():
        setattr(status, name, value)
    decoded: rtc3d.status_t = rtc3d.status_t.decode(status.encode())
    return decoded


TEXTS = {
    StreamState.STREAMING: (Level.GOOD, "streaming 200.0 Hz"),
    StreamState.WAITING: (Level.BAD, f"waiting for {SERVER}"),
    StreamState.CONNECTING: (Level.BAD, f"waiting for {SERVER}"),
    StreamState.HANDSHAKING: (Level.WAITING, f"connected to {SERVER}, handshake in progress"),
    StreamState.IDLE: (Level.WAITING, f"connected to {SERVER}, no frames requested"),
    StreamState.NO_MEASUREMENT: (Level.WAITING, f"connected to {SERVER}, no measurement running"),
    StreamState.STALLED: (Level.BAD, f"no frames from {SERVER}"),
}


@pytest.mark.parametrize("state", StreamState)
@pytest.mark.parametrize(("tries", "counted"), [(0, ""), (1, ", 1 try"), (12, ", 12 tries")])
def test_every_state_of_the_gateway_has_a_level_and_a_text(
    state: StreamState, tries: int, counted: str
) -> None:
    """Tries are counted only where the next one is what people wait for."""
    level, text = TEXTS[state]
    [found] = source_report(a_status(stream(state=state.value, frame_rate_hz=199.96, tries=tries))).streams
    is_waiting = state in {StreamState.WAITING, StreamState.CONNECTING}
    assert (found.level, found.text) == (level, text + counted if is_waiting else text)


@pytest.mark.parametrize("num_streams", [0, 1, 2, 3])
def test_a_source_is_as_good_as_its_worst_stream(num_streams: int) -> None:
    """Lists have one mark per source: a dead stream beside others that are fine must show."""
    for states in itertools.product(StreamState, repeat=num_streams):
        found = source_report(a_status(*(stream(state=state.value) for state in states))).level
        levels = [TEXTS[state][0] for state in states] or [Level.WAITING]
        assert found is max(levels, key=[Level.GOOD, Level.WAITING, Level.BAD].index), states


def test_a_problem_or_the_state_of_another_version_is_the_text() -> None:
    rejected = stream(problem="frames come, and all are rejected: x")
    report = source_report(a_status(rejected, stream(state="dancing {server}")))
    assert [(each.level, each.text) for each in report.streams] == [
        (Level.BAD, "frames come, and all are rejected: x"),
        (Level.WAITING, "dancing {server}"),
    ]


def test_streams_share_a_text_or_are_listed_by_components() -> None:
    assert streams_text([]) == source_report(a_status()).text == ""
    assert streams_text([("3d", "idle"), ("analog", "idle")]) == "idle"
    report = source_report(a_status(stream("3d"), stream("analog", frame_rate_hz=2000.0)))
    assert report.text == "3d streaming 200.0 Hz, analog streaming 2000.0 Hz"


def test_a_source_has_the_name_that_it_was_found_by() -> None:
    assert source_report(a_status()).name == "lab"
    assert source_report(a_status(), "hall\n").name == r"hall\n"


EVIL = "\x1b[2J\r\n" + "x" * 100_000


def test_texts_of_a_hostile_status_are_escaped_and_cut() -> None:
    """Every text of a report is printed as it is: on terminals, in pages, in logs."""
    counts, lost = [count(EVIL, 1)], [loss(EVIL, 1, 1)]
    evil = dict.fromkeys(("problem", "byte_order", "rate", "last_error"), EVIL)
    streams = stream(EVIL, EVIL, limitations=[EVIL], drops=lost, **evil)
    outputs = output(EVIL, problem=EVIL, messages=counts, queries=counts, drops=lost)
    names = dict.fromkeys(("source", "server", "host", "gateway_version", "frame_id"), EVIL)
    report = source_report(a_status(streams, outputs=(outputs,), **names))
    texts = [*texts_of(report)]
    assert len(texts) == 19
    assert all(text.isprintable() and len(text) <= 500 for text in texts)


def texts_of(value: Any) -> list[str]:
    """Return all texts in a report but those that the status leaves empty."""
    if isinstance(value, str):
        return [value] if value else []
    if isinstance(value, dict):
        return [*value]
    if hasattr(value, "__slots__") and not isinstance(value, Level | tuple):
        value = [getattr(value, name) for name in value.__slots__]
    return [text for each in value for text in texts_of(each)] if isinstance(value, list | tuple) else []


def test_the_entries_of_a_hostile_status_are_bounded() -> None:
    many = MAX_ENTRIES + 10
    lost, counts = [loss("x", 1, 1)] * many, [count(str(number), 1) for number in range(many)]
    streams = [stream(limitations=["x"] * many, drops=lost)] * many
    outputs = (output(messages=counts, queries=counts, drops=lost),) * many
    report = source_report(a_status(*streams, outputs=outputs))
    assert (len(report.streams), len(report.outputs)) == (MAX_STREAMS, MAX_ENTRIES)
    assert report.problem == "it has 60 streams; 16 are shown"
    found, sent = report.streams[0], report.outputs[0]
    for entries in (found.limitations, found.losses, sent.messages, sent.queries, sent.losses):
        assert len(entries) == MAX_ENTRIES
    assert source_report(a_status(*streams[:MAX_STREAMS])).problem == ""
