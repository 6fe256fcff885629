"""The events of a measurement in a C3D file: the group EVENT."""

from typing import Final

import numpy as np

from gateway.descriptions.event_texts import MAX_EVENT_AGE_US, EventText, event_text
from gateway.descriptions.fitting_labels import printable
from gateway.export.c3d_format import MAX_LIST, Parameter
from gateway.export.job import ExportJob
from gateway.export.measurements import Measurement
from gateway.takes.component_rows import Array
from gateway.takes.series import Series

_MINUTE_S: Final = 60.0
_SIDES: Final = {"Left", "Right"}
_MARGIN_S: Final = 1.0
"""An event within this time before the first frame or after the last one belongs to the measurement."""


def event_times_us(events: Series) -> Array:
    """Return the server's time of each event: its own, or that of its frame if it is far from that."""
    own = events.items["timestamp"]
    is_near = abs(own.astype(np.float64) - events.timestamp_us) <= MAX_EVENT_AGE_US
    return np.where(is_near, own, events.timestamp_us)


def _context_of(text: EventText) -> str:
    """Return Left, Right or General, by a parameter of the event, or else by a word of its label.

    A parameter called Context, as the simulator has it for events of C3D files, can say something else.
    """
    named = _value_of(text, "context")
    if named:
        return named
    for words in ([value.strip() for _, value in text.values], text.label.split()):
        sides = _SIDES & {word.capitalize() for word in words}
        if len(sides) == 1:
            return sides.pop()
    return "General"


def _value_of(text: EventText, name: str) -> str:
    """Return the value of a parameter of the event; "" if it has none of this name."""
    return next((value for each, value in text.values if each.strip().casefold() == name), "")


def event_group(job: ExportJob, measurement: Measurement, first_row: int, num_rows: int) -> list[Parameter]:
    """Return the group EVENT with the events of these rows; [] if there are none."""
    events = measurement.source.events
    if events is None:
        return []
    rate_hz = measurement.grid.rate_hz
    seconds = measurement.seconds_of(event_times_us(events), events.capture_utime) - first_row / rate_hz
    (chosen,) = np.nonzero((seconds > -_MARGIN_S) & (seconds < num_rows / rate_hz + _MARGIN_S))
    chosen = chosen[np.argsort(seconds[chosen], kind="stable")]
    if len(chosen) > MAX_LIST:
        job.note(
            f"{len(chosen) - MAX_LIST} of {len(chosen)} events were left out: a C3D file has at most 255"
        )
        chosen = chosen[:MAX_LIST]
    if not len(chosen):
        return []
    count = len(chosen)
    subject = measurement.source.details.subject
    texts = [event_text(events.parameters_of(row), events.items[row]) for row in chosen.tolist()]
    minutes, rest = np.divmod(np.maximum(seconds[chosen], 0.0), _MINUTE_S)
    return [
        Parameter("USED", np.array(count, np.int16)),
        Parameter("CONTEXTS", [printable(_context_of(text)) for text in texts]),
        Parameter("LABELS", [printable(text.label) for text in texts]),
        Parameter("DESCRIPTIONS", [printable(text.description) for text in texts]),
        Parameter("SUBJECTS", [printable(_value_of(text, "subject") or subject) for text in texts]),
        Parameter("TIMES", np.stack([minutes, rest]).astype(np.float32)),
        Parameter("ICON_IDS", np.zeros(count, np.int16)),
        Parameter("GENERIC_FLAGS", np.zeros(count, np.int16)),
    ]
