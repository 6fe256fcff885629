"""The messages between the gateway and its process for LSL."""

import json

import numpy as np

from gateway.outputs.lsl.wire import (
    Kind,
    Message,
    MessageReader,
    Report,
    decode_samples,
    json_content,
    opening_content,
    samples_content,
)


def test_messages_are_cut_from_any_pieces() -> None:
    messages = [Message(Kind.OPEN, 1, b"{}"), Message(Kind.CLOSE, 2), Message(Kind.TEXTS, 300, b"x" * 5000)]
    data = b"".join(message.encode() for message in messages)
    for size in (1, 7, 1000, len(data)):
        reader = MessageReader()
        found = [
            message
            for start in range(0, len(data), size)
            for message in reader.feed(data[start : start + size])
        ]
        assert found == messages


def test_the_bytes_of_a_message() -> None:
    assert Message(Kind.CLOSE, 258).encode() == bytes([2, 2, 1, 0, 0, 0, 0, 0, 0])


def test_samples_keep_times_and_values() -> None:
    values = np.array([[1, 2, 3], [4, np.nan, 6]], np.float32)
    times, found = decode_samples(samples_content([100.000001, 100.000002], values))
    assert times.tolist() == [100.000001, 100.000002]
    assert np.array_equal(found, values, equal_nan=True)


def test_reports_are_lines() -> None:
    report = Report("118", (1, 2), "lab_3d: a\nproblem", "why")
    line = report.encode()
    assert line.count(b"\n") == 1
    assert Report.decode(line) == report


def test_a_tree_is_json_as_if_it_was_encoded_at_once() -> None:
    tree = (("channels", (("channel", (("label", 'a "b" \\ é'), ("type", "X"))),)), ("setup", ()))
    assert json.loads(opening_content({"name": "lab_3d"}, tree)) == json.loads(
        json.dumps([{"name": "lab_3d"}, tree])
    )


def test_texts_are_json() -> None:
    assert json_content(([1.5], ["é"])) == b'[[1.5], ["\\u00e9"]]'
