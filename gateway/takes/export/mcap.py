"""Export to MCAP with Foxglove's types, for Foxglove, Lichtblick and rerun."""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from gateway.messages.foxglove.messages import FIELD_NOUNS, NUMBERS_PER_ITEM, FoxgloveSource
from gateway.messages.foxglove.topics import MAX_FIELDS, FloatTopics, TopicMessages, field_names
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.takes.export.job import ExportJob
from gateway.takes.export.mcap_file import SourceExport, export_to_mcap
from gateway.takes.files.component_rows import Array
from gateway.takes.files.series import Series
from gateway.takes.files.take import TakeSource

_MAX_CONVERTERS: Final = 100

_ARROWS_HZ: Final = 100
"""About how often arrows of forces are drawn at most: screens show no more, and programs read them slowly."""


def export_mcap(job: ExportJob) -> None:
    """Write the sources of a take to one file, each with topics of its own, and all their parameters."""
    export_to_mcap(job, _FoxgloveExport, "frames")


class _FoxgloveExport(SourceExport):
    """One source: what its frames become."""

    def __init__(self, source: TakeSource) -> None:
        super().__init__()
        self._parameters = source.parameters
        self._topics = FloatTopics(source.name)
        self._converters: dict[int, FoxgloveSource] = {}  # by the index of the parameters, -1 without any

    def messages_of(self, key: str, run: Series, rows: Array) -> Iterator[TopicMessages]:
        """Yield the messages of each part with the same parameters: not only labels may change."""
        component = COMPONENTS_BY_KEY[key]
        items = run.items[:, None] if component is ComponentType.EVENT else run.items
        if items.shape[1] * NUMBERS_PER_ITEM.get(component, 0) > MAX_FIELDS:
            self.count(f"messages with more than {MAX_FIELDS} numbers in {key}", rows >= 0)
            return
        interval = 1
        if component is ComponentType.FORCE:
            interval = max(1, round((run.measured_rate_hz or _ARROWS_HZ) / _ARROWS_HZ))
            if interval > 1:
                self.notes[f"arrows of forces drawn for one in {interval} frames"] = None
        entries = run.content.entries
        for part in np.split(rows, np.flatnonzero(np.diff(entries[rows])) + 1):
            utimes = run.capture_utime[part].tolist()
            index = int(entries[part[0]])
            converter = self._converters.get(index)
            if converter is None:
                converter = self._new_converter(index, int(run.parameters_version[part[0]]))
                for message in converter.describe(utimes[0]):
                    yield TopicMessages(message.topic, [message.utime], [message.data])
            times = (utimes, run.timestamp_us[part].tolist())
            yield from converter.convert_frames(component, items[part], *times, interval)

    def labels_of(self, run: Series) -> Sequence[str]:
        """Return the names of fields of numbers; markers and tools keep their labels."""
        noun = FIELD_NOUNS.get(run.component)
        return run.labels if noun is None else field_names(run.labels, noun)

    def _new_converter(self, index: int, version: int) -> FoxgloveSource:
        parameters = Parameters() if index < 0 else self._parameters[index].parameters
        if len(self._converters) == _MAX_CONVERTERS:
            self._converters.clear()
        converter = self._converters[index] = FoxgloveSource(self._topics, parameters, version)
        if converter.problem:
            self.notes[f"{self._topics.source}: {converter.problem}"] = None
        return converter
