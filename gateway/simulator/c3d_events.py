"""The events of a C3D file as events of RTC3D: what they are called (§6.6), and when they happen."""

import logging
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from gateway.descriptions.event_texts import UNUSED
from gateway.descriptions.labels import common
from gateway.rtc3d.components import LONG_EVENT, Items
from gateway.rtc3d.parameters import EventDefinition, EventParameter, ExpectedValue, ParametersEvents
from gateway.rtc3d_server.scene import NO_EVENTS

_WORD_BYTES: Final = 2
_COUNT_OFFSET: Final = 150 * _WORD_BYTES
"""Where the header has the number of its events. It has room for 18."""
_MAX_HEADER_EVENTS: Final = 18
_SECOND_US: Final = 1_000_000
_NO_LABEL: Final = "Event"
_log = logging.getLogger(__name__)


class _Texts(NamedTuple):
    """The times of events in s, and their texts, one for each event or none."""

    seconds: npt.NDArray[np.float64]
    labels: list[str]
    contexts: list[str]
    subjects: list[str]
    descriptions: list[str]


def read_events(
    path: Path, content: Any, head: bytes, frame_rate_hz: float, length_s: float
) -> tuple[ParametersEvents, Items]:
    """Return the events of the group EVENT, or else those of the header, in µs since the first frame.

    ``content`` is what ezc3d reads, ``head`` the first block of the file. Times count from frame 1 of the
    trial (Vicon, Qualisys), also if the file begins with a later frame, or else from the first frame of the
    file: what places more events in it.
    """
    texts = _from_group(content["parameters"].get("EVENT", {})) or _from_header(content["header"], head)
    if texts is None:
        return ParametersEvents(), NO_EVENTS
    period_s = 1.0 / frame_rate_hz
    starts_s = [(number - 1) * period_s for number in _first_frames(content)]
    choices_s = [texts.seconds - start_s for start_s in (*starts_s, 0.0)]
    within = [(seconds > -period_s) & (seconds < length_s + period_s) for seconds in choices_s]
    best = int(np.argmax([each.sum() for each in within]))
    (chosen,) = np.nonzero(within[best])
    # A frame has the events up to its own time, so those after the last frame would come in the next pass.
    seconds = np.clip(choices_s[best], 0.0, max(length_s - period_s, 0.0))
    chosen = chosen[np.argsort(seconds[chosen], kind="stable")]
    count, left_out = len(texts.seconds), len(texts.seconds) - len(chosen)
    if left_out:
        _log.warning("%s: %d of %d events are outside of its frames and are left out", path, left_out, count)
    definitions, numbers = _define(texts)
    items = np.full(len(chosen), UNUSED, LONG_EVENT)
    items["timestamp"] = np.round(seconds[chosen] * _SECOND_US)
    for name, values in numbers.items():
        items[name] = values[chosen]
    return definitions, items


def texts_of(group: Any, name: str) -> list[str]:
    """Return a parameter's texts, including its continuations: LABELS, LABELS2, … (255 texts each)."""
    return [text.strip() for values in _parts(group, name) for text in values]


def _parts(group: Any, name: str) -> list[Any]:
    """Return the values of a parameter and of its continuations."""
    parts = []
    for part in (name, *(f"{name}{number}" for number in range(2, 100))):
        if part not in group:
            break
        parts.append(group[part]["value"])
    return parts


def _from_group(group: Any) -> _Texts | None:
    """Return the events of the group EVENT, whose times are minutes and seconds; None if it has none."""
    labels = texts_of(group, "LABELS")
    times = [np.asarray(part, np.float64) for part in _parts(group, "TIMES")]
    if len(times) == 1 and times[0].ndim == 1 and len(labels) == times[0].size:
        seconds = times[0]  # as some programs write them
    else:
        minutes_and_seconds = [part[: part.size // 2 * 2].reshape(2, -1) for part in times if part.size]
        seconds = np.concatenate([[60.0, 1.0] @ part for part in minutes_and_seconds] or [np.zeros(0)])
    if "USED" in group and len(group["USED"]["value"]):
        seconds = seconds[: int(group["USED"]["value"][0]) & 0xFFFF]
    if not len(seconds):
        return None
    others = (texts_of(group, name) for name in ("CONTEXTS", "SUBJECTS", "DESCRIPTIONS"))
    return _Texts(seconds, labels, *others)


def _from_header(header: Any, head: bytes) -> _Texts | None:
    """Return the events of the header; None if it has none."""
    count = max(head[_COUNT_OFFSET : _COUNT_OFFSET + _WORD_BYTES])  # one of both bytes is 0
    if not 0 < count <= _MAX_HEADER_EVENTS:
        return None
    events = header["events"]
    seconds = np.array(events["events_time"][:count], np.float64)
    labels = [text.strip("\0 ") for text in events["events_label"][:count]]
    return _Texts(seconds, labels, [], [], [])


def _first_frames(content: Any) -> list[int]:
    """Return the number of the first frame in TRIAL:ACTUAL_START_FIELD, if it is there, and in the header."""
    numbers = [int(content["header"]["points"]["first_frame"]) + 1]
    field = content["parameters"].get("TRIAL", {}).get("ACTUAL_START_FIELD", {"value": []})["value"]
    if len(field):
        words = [int(word) & 0xFFFF for word in np.ravel(field)[:2]]
        numbers.insert(0, words[0] + (words[1] << 16 if len(words) > 1 else 0))
    return numbers


def _define(texts: _Texts) -> tuple[ParametersEvents, dict[str, npt.NDArray[np.int64]]]:
    """Return a definition for each label, and the fields of the events: their ids, context and subject."""
    count = len(texts.seconds)
    labels = [label or _NO_LABEL for label in _padded(texts.labels, count)]
    # A description of a single event, such as the number of a plate, is not that of all.
    descriptions: dict[str, set[str]] = {}
    for label, description in zip(labels, _padded(texts.descriptions, count), strict=True):
        descriptions.setdefault(label, set()).add(description)
    parameters: list[EventParameter] = []
    numbers: dict[str, npt.NDArray[np.int64]] = {}
    for name, values in (("Context", texts.contexts), ("Subject", texts.subjects)):
        different = [text for text in dict.fromkeys(_padded(values, count)) if text]
        if different:
            number = len(parameters) + 1
            codes = {text: code for code, text in enumerate(different, start=1)}
            expected = tuple(ExpectedValue(str(code), str(code), text) for text, code in codes.items())
            parameters.append(EventParameter(str(number), "int", name, expected))
            numbers[f"param{number}"] = np.array([codes.get(text, UNUSED) for text in _padded(values, count)])
    ids = {label: number for number, label in enumerate(dict.fromkeys(labels), start=1)}
    numbers["id"] = np.array([ids[label] for label in labels])
    definitions = tuple(
        EventDefinition(str(number), label, common(descriptions[label]) or "", tuple(parameters))
        for label, number in ids.items()
    )
    return ParametersEvents(definitions), numbers


def _padded(texts: list[str], count: int) -> list[str]:
    return texts[:count] + [""] * (count - len(texts))
