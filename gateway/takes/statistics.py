"""What is in a take, and what is missing from it: one pass over its files, with bounded memory."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from gateway.takes.event_log import MAX_LISTED_DAMAGE
from gateway.takes.reader import TakeReader
from gateway.takes.source_statistics import SourceStatistics

_BATCH_BYTES: Final = 8 * 1024 * 1024
"""So many bytes of messages are analysed at once."""

_MAX_BATCH_MESSAGES: Final = 50_000
_MAX_SOURCES: Final = 100
_XML_OFFSET: Final = 36
"""Where a ``parameters_t`` has the version and the XML."""


class FileDamage(NamedTuple):
    """Bytes of a file that belong to no readable event."""

    file: Path
    offset: int
    num_bytes: int


@dataclass
class TakeStatistics:
    """What a take has, and what is missing.

    Times are in µs since 1970, on the clock of the recording computer. ``seconds`` is from the first event to
    the latest. ``unknown`` counts messages that are none of a gateway's, by channel.
    """

    path: Path
    files: list[Path]
    num_bytes: int
    start_utime: int
    end_utime: int = 0
    num_messages: int = 0
    sources: dict[str, SourceStatistics] = field(default_factory=dict)
    unknown: dict[str, int] = field(default_factory=dict)
    num_damaged: int = 0
    damaged_bytes: int = 0
    damage: list[FileDamage] = field(default_factory=list)
    """The first places of damage, at most MAX_LISTED_DAMAGE."""

    @property
    def seconds(self) -> float:
        """The duration in s."""
        return (self.end_utime - self.start_utime) / 1e6

    def seconds_at(self, utime: int) -> float:
        """Return a time as seconds since the beginning."""
        return (utime - self.start_utime) / 1e6

    @property
    def is_complete(self) -> bool:
        """Whether there is no damage, no gap, and no malformed message."""
        parts = [
            part
            for source in self.sources.values()
            for part in (*source.components.values(), *source.others.values())
        ]
        return not self.num_damaged and not any(part.gaps.missing or part.malformed for part in parts)


def take_statistics(path: Path, progress: Callable[[int, int], object] | None = None) -> TakeStatistics:
    """Return the statistics of a take. ``progress`` gets the bytes that were read, and those in all.

    Raises TakeError if there is no take.
    """
    reader = TakeReader(path)
    files = [log.path for log in reader.logs]
    num_bytes = sum(file.stat().st_size for file in files)
    statistics = TakeStatistics(path, files, num_bytes, reader.start_utime, reader.start_utime)
    batch: dict[tuple[str, str], list[bytes]] = {}
    parameters: dict[str, bytes] = {}
    batch_bytes = read_bytes = batch_messages = 0

    def flush() -> None:
        for (name, key), messages in batch.items():
            if name in statistics.sources or len(statistics.sources) < _MAX_SOURCES:
                statistics.sources.setdefault(name, SourceStatistics(name)).add(key, messages)
        batch.clear()

    for message in reader.messages():
        if message.key == "parameters" and parameters.get(message.source) != message.message[_XML_OFFSET:]:
            parameters[message.source] = message.message[_XML_OFFSET:]
            flush()  # what came before may have other labels under the same version
        batch.setdefault((message.source, message.key), []).append(message.message)
        batch_bytes += len(message.message)
        batch_messages += 1
        statistics.end_utime = max(statistics.end_utime, message.utime)
        if batch_bytes >= _BATCH_BYTES or batch_messages >= _MAX_BATCH_MESSAGES:
            flush()
            statistics.num_messages += batch_messages
            read_bytes += batch_bytes
            batch_bytes = batch_messages = 0
            if progress is not None:
                progress(read_bytes, num_bytes)
    flush()
    statistics.num_messages += batch_messages
    for source in statistics.sources.values():
        source.finish()
    _add_damage(statistics, reader)
    return statistics


def _add_damage(statistics: TakeStatistics, reader: TakeReader) -> None:
    statistics.unknown = dict(reader.unknown)
    statistics.num_messages += sum(reader.unknown.values())
    for log in reader.logs:
        statistics.num_damaged += log.num_damaged
        statistics.damaged_bytes += log.damaged_bytes
        statistics.damage += [FileDamage(log.path, *damage) for damage in log.damage]
    del statistics.damage[MAX_LISTED_DAMAGE:]
