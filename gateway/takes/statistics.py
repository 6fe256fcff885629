"""What is in a take, and what is missing from it: one pass over its files, with bounded memory."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from gateway.takes.event_log import MAX_LISTED_DAMAGE
from gateway.takes.reader import TakeReader
from gateway.takes.source_statistics import SourceStatistics

_MAX_SOURCES: Final = 100


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
    empty_files: dict[Path, str] = field(default_factory=dict)
    """Files of a folder without any event, and why."""

    @property
    def seconds(self) -> float:
        """The duration in s."""
        return (self.end_utime - self.start_utime) / 1e6

    def seconds_at(self, utime: int) -> float:
        """Return a time as seconds since the beginning."""
        return (utime - self.start_utime) / 1e6

    @property
    def is_complete(self) -> bool:
        """Whether there is no damage, no gap, no malformed message, and the recorder lost nothing."""
        parts = [
            part
            for source in self.sources.values()
            for part in (*source.components.values(), *source.others.values())
        ]
        return (
            not self.num_damaged
            and not any(part.gaps.missing or part.malformed for part in parts)
            and not self.was_cut_short
        )

    @property
    def was_cut_short(self) -> bool:
        """Whether the recorder was cut off, or lost messages."""
        return any(source.is_cut_off or source.num_lost for source in self.sources.values())


def take_statistics(path: Path, progress: Callable[[int, int], object] | None = None) -> TakeStatistics:
    """Return the statistics of a take. ``progress`` gets the bytes that were read, and those in all.

    Raises TakeError if there is no take.
    """
    reader = TakeReader(path)
    files = [log.path for log in reader.logs]
    statistics = TakeStatistics(path, files, reader.num_bytes, reader.start_utime, reader.start_utime)
    for batches in reader.batches():
        for batch in batches:
            statistics.num_messages += len(batch.messages)
            statistics.end_utime = max(statistics.end_utime, *batch.utimes)
            name = batch.source
            if name in statistics.sources or len(statistics.sources) < _MAX_SOURCES:
                statistics.sources.setdefault(name, SourceStatistics(name)).add(batch.key, batch.messages)
        if progress is not None:
            progress(reader.read_bytes, statistics.num_bytes)
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
    statistics.num_damaged += len(reader.empty_files)
    statistics.empty_files = dict(reader.empty_files)
    del statistics.damage[MAX_LISTED_DAMAGE:]
