"""Reading a take into numpy arrays, for analysis and for conversion to other formats."""

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from gateway.config.words import spelling_hint
from gateway.errors import ProtocolError, SelectionError, TakeError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.decode import decode
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.runtime.safe_text import quoted
from gateway.takes.files.component_rows import decode_rows
from gateway.takes.files.description import NO_DETAILS, TakeDetails, decoded_details, has_end
from gateway.takes.files.joined import join_series
from gateway.takes.files.parameters_history import ParametersEntry, ParametersHistory, changes_in_order
from gateway.takes.files.reader import MessageBatch, TakeReader
from gateway.takes.files.series import MAX_GAP_S, Series, SeriesBuilder


@dataclass(repr=False)
class TakeSource:
    """One source (a server) of a take. A component that was not recorded is None.

    ``server`` is HOST:PORT and ``gateway_version`` the version of the gateway that published the messages,
    both "" if the take does not say. ``details`` has ``subject``, ``session`` and ``note``, each "" if nobody
    said it. ``parameters`` has the server's parameters at the beginning and at each change, in order.
    ``malformed`` is how many messages could not be read, by component. ``recorded`` has the keys of
    all components in the range of time, also of those that were not loaded. ``num_lost`` messages are in no
    file, because the recorder had no room for them. ``is_cut_off`` tells that a file was not ended in order;
    it is False if the end was not read, because of ``to_s``.
    """

    name: str
    server: str = ""
    gateway_version: str = ""
    details: TakeDetails = NO_DETAILS
    markers: Series | None = None
    tools: Series | None = None
    analog: Series | None = None
    forces: Series | None = None
    events: Series | None = None
    parameters: list[ParametersEntry] = field(default_factory=list)
    malformed: Counter[str] = field(default_factory=Counter)
    recorded: set[str] = field(default_factory=set)
    num_lost: int = 0
    is_cut_off: bool = False

    def __repr__(self) -> str:
        """Return a summary."""
        rows = [f"{len(series)} rows of {key}" for key, series in self.series.items()]
        return f"<TakeSource {self.name}: {', '.join(rows) or 'nothing'}>"

    frame: CoordinateFrame | None = None
    """That of the gateway's poses, by its newest status; None if the take has none."""

    @property
    def series(self) -> dict[str, Series]:
        """The recorded components by their keys: "3d", "6d", "analog", "force", "event"."""
        by_key = {key: getattr(self, name) for key, name in _FIELDS.items()}
        return {key: series for key, series in by_key.items() if series is not None}

    def runs(self, key: str) -> list[Series]:
        """Return the parts of a component with constant labels, one measurement each: see ``Series.runs``.

        There are none if the take lacks the component. Raises SelectionError if there is no such component.
        """
        check_components([key])
        found = self.series.get(key)
        return [] if found is None else found.runs()


_FIELDS: Final = {"3d": "markers", "6d": "tools", "analog": "analog", "force": "forces", "event": "events"}
"""The fields of TakeSource by the keys of components."""


_MAX_SHOWN: Final = 5
"""How many sources the summary of a take names."""


@dataclass(repr=False)
class Take:
    """A take in memory: its sources by name.

    ``start_utime`` is the time of the first event, in µs since 1970; all seconds count from it. Of several
    takes in one file (``cat``), it is that of the earliest.
    ``num_damaged`` places of the files, with ``damaged_bytes`` in all, could not be read. ``unknown`` is how
    many messages have a type that is none of a gateway's, by channel. ``path`` is None if it was collected
    live, or joined from several takes. ``num_recordings`` is how many takes somebody has put into one file:
    the rows of all are in the order of time, and each occurs once.
    """

    path: Path | None
    start_utime: int
    sources: dict[str, TakeSource]
    num_damaged: int = 0
    damaged_bytes: int = 0
    unknown: dict[str, int] = field(default_factory=dict)
    num_recordings: int = 1

    def __repr__(self) -> str:
        """Return a summary."""
        name = "" if self.path is None else f" {quoted(self.path.name)}"
        names = [quoted(each) for each in self.sources][:_MAX_SHOWN]
        more = ", …" if len(self.sources) > len(names) else ""
        return f"<Take{name}: {', '.join(names) or 'no sources'}{more}>"

    @property
    def was_cut_short(self) -> bool:
        """Whether the recorder was cut off, or lost messages."""
        return any(source.is_cut_off or source.num_lost for source in self.sources.values())

    def resample(self, rate_hz: float, *, max_gap_s: float = MAX_GAP_S) -> "Take":
        """Return the take with all components of all sources at the same times, as ``Series.resample`` does.

        The times are those from the first frame of any of them to the last one, so all arrays have the same
        number of rows, which are NaN where a component has nothing. Events stay as they are.
        """
        every = [series for source in self.sources.values() for series in source.series.values()]
        seconds = [series.seconds for series in every if series.component is not ComponentType.EVENT]
        if not seconds:
            return self
        limits = {"from_s": min(map(np.min, seconds)), "to_s": max(map(np.max, seconds))}
        sources = {name: replace(source) for name, source in self.sources.items()}
        for source in sources.values():
            for key, series in source.series.items():
                if series.component is not ComponentType.EVENT:
                    resampled = series.resample(rate_hz, max_gap_s=max_gap_s, **limits)
                    setattr(source, _FIELDS[key], resampled)
        return replace(self, sources=sources)


def open_take(
    path: Path | str | Sequence[Path | str],
    *,
    sources: Collection[str] | None = None,
    components: Collection[str] | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    progress: Callable[[int, int], object] | None = None,
    spool_folder: Path | None = None,
) -> Take:
    """Read a take (an event log, or the folder of a saved take) into numpy arrays; several takes as one.

    ::

        from gateway.takes import open_take

        take = open_take("lab-20261122-101500.lcmlog")
        markers = take.sources["lab"].markers
        print(markers.labels, markers.unit, markers.rate_hz)
        head = markers["head"]  # x, y, z, shape (frames, 3), NaN where it is missing
        plt.plot(markers.seconds, head)

    ``sources`` and ``components`` (of 3d, 6d, analog, force, event) limit what is loaded, each by a name or
    several; ``from_s`` and ``to_s`` limit the time of the events, in seconds from the first event of the
    take. What comes after ``to_s`` is not read. ``progress`` gets the bytes that were read, and those in all.
    The arrays take as much memory as their part of the file, unless there is a ``spool_folder``: then large
    ones are in temporary files there, and cannot be changed. Damage is skipped and counted. Raises TakeError
    if there is no take, and SelectionError, a TakeError, if a source is not in it or a component does not
    exist.

    Of several takes, ``open_take([first, second])`` or ``cat``, sources of the same name are joined in the
    order of their times, and others are side by side; seconds count from the earliest take. A message that
    several takes have, because they overlap, occurs once. What describes a source, such as its subject, is
    that of the earliest take that has it. Joining needs twice the memory for a moment.
    """
    sources = [sources] if isinstance(sources, str) else sources
    components = [components] if isinstance(components, str) else components
    check_components(components or ())
    paths = [path] if isinstance(path, Path | str) else path
    readers = sorted((TakeReader(Path(each)) for each in paths), key=lambda reader: reader.start_utime)
    if not readers:
        raise TakeError("there is no take to open; name at least one")
    takes: list[Take] = []
    is_part = from_s is not None or to_s is not None
    start_utime = min(reader.first_utime() if is_part else reader.start_utime for reader in readers)
    first_utime, end_utime = utime_range(start_utime, from_s, to_s)
    total = sum(reader.num_bytes for reader in readers)
    chosen = COMPONENTS_BY_KEY.keys() if components is None else components
    for reader in readers:
        loader = TakeLoader(sources, chosen, spool_folder)
        for batches in reader.batches(end_utime):
            for batch in batches:
                loader.add(batch, first_utime, end_utime)
            if progress is not None:
                progress(sum(each.read_bytes for each in readers), total)
        begin_utime = int(min(start_utime, loader.earliest_utime))
        sources_of_take = loader.finish(begin_utime, is_whole=end_utime == math.inf)
        take = Take(reader.path, begin_utime, sources_of_take)
        take.num_damaged, take.damaged_bytes = reader.num_damaged, reader.damaged_bytes
        take.unknown = dict(reader.unknown)
        take.num_recordings = loader.num_recordings
        takes.append(take)
    if progress is not None:  # what comes after ``to_s`` is not read
        progress(total, total)
    missing = set(sources or ()).difference(*(take.sources for take in takes))
    if missing:
        known = dict.fromkeys(name for reader in readers for name in reader.source_names)
        names = ", ".join(known) or "none of a gateway"
        opened = ", ".join(str(reader.path) for reader in readers)
        hint = spelling_hint(min(missing), known)
        raise SelectionError(f"{opened} has no source {min(missing)!r}{hint}; its sources are: {names}")
    return takes[0] if len(takes) == 1 else _join_takes(takes)


def check_components(components: Iterable[str]) -> None:
    """Raise SelectionError, with the similar name, if one of ``components`` does not exist."""
    for key in components:
        if key not in COMPONENTS_BY_KEY:
            hint = spelling_hint(key, COMPONENTS_BY_KEY)
            raise SelectionError(f"{key!r} is no component{hint}; choose from {', '.join(COMPONENTS_BY_KEY)}")


def utime_range(start_utime: int, from_s: float | None, to_s: float | None) -> tuple[float, float]:
    """Return the times of a part of a take in µs since 1970: from which on, and before which."""
    first = -math.inf if from_s is None else start_utime + round(from_s * 1e6, 0)
    end = math.inf if to_s is None else start_utime + round(to_s * 1e6, 0)
    return first, end


def _join_takes(takes: Sequence[Take]) -> Take:
    """Return takes as one: sources of the same name are joined, others are side by side."""
    unknown: Counter[str] = Counter()
    sources: dict[str, list[TakeSource]] = {}
    for take in takes:
        unknown.update(take.unknown)
        for name, source in take.sources.items():
            sources.setdefault(name, []).append(source)
    return Take(
        None,
        min(take.start_utime for take in takes),
        {name: _join_sources(parts) for name, parts in sources.items()},
        sum(take.num_damaged for take in takes),
        sum(take.damaged_bytes for take in takes),
        dict(unknown),
        sum(take.num_recordings for take in takes),
    )


def _join_sources(parts: Sequence[TakeSource]) -> TakeSource:
    """Return one source; what describes it is that of the first take that has it."""
    joined = replace(
        parts[0],
        server=next((part.server for part in parts if part.server), ""),
        gateway_version=next((part.gateway_version for part in parts if part.gateway_version), ""),
        details=next((part.details for part in parts if any(part.details)), parts[0].details),
        parameters=[entry for part in parts for entry in part.parameters],
        malformed=sum((part.malformed for part in parts), Counter()),
        recorded=set().union(*(part.recorded for part in parts)),
        frame=next((part.frame for part in reversed(parts) if part.frame), None),
        num_lost=sum(part.num_lost for part in parts),
        is_cut_off=any(part.is_cut_off for part in parts),
    )
    for key, name in _FIELDS.items():
        found = [part.series[key] for part in parts if key in part.series]
        setattr(joined, name, join_series(found) if found else None)
    return joined


def _frame_of(message: bytes) -> CoordinateFrame | None:
    """Return the coordinate frame in a status; None if it cannot be read or its numbers are no frame."""
    try:
        status = decode(message)
    except ProtocolError:
        return None
    x, y, z, w = status.rotation_xyzw
    tx, ty, tz = status.translation_m
    numbers = (x, y, z, w, tx, ty, tz)
    length = math.sqrt(x * x + y * y + z * z + w * w) if all(map(math.isfinite, numbers)) else 0.0
    if not status.frame_id or abs(length - 1) > _MAX_LENGTH_ERROR:
        return None
    metres = status.metres_per_unit if 0 < status.metres_per_unit < math.inf else None
    return CoordinateFrame(status.frame_id, metres, (x, y, z, w), (tx, ty, tz))


_MAX_LENGTH_ERROR: Final = 1e-3
"""How much the length of a rotation's quaternion may differ from 1."""


class TakeLoader:
    """Collects the messages of a take; large arrays are on the disk if there is a ``spool_folder``."""

    def __init__(
        self,
        sources: Collection[str] | None,
        components: Collection[str],
        spool_folder: Path | None = None,
    ) -> None:
        self._wanted, self._components, self._spool_folder = sources, components, spool_folder
        self._sources: dict[str, TakeSource] = {}
        self._statuses: dict[str, tuple[int, bytes]] = {}  # the newest and its time, by source
        self._histories: dict[tuple[str, int], ParametersHistory] = {}  # by source and recording
        self._builders: dict[tuple[str, str, int], SeriesBuilder] = {}  # by source, component and recording
        self.earliest_utime = math.inf
        """The time of the earliest message of takes that follow another one in its file."""
        self.num_recordings = 1
        """How many takes follow each other in one file."""
        self._num_open: Counter[str] = Counter()  # files that should have an end, and have none so far

    def add(self, batch: MessageBatch, first_utime: float = -math.inf, end_utime: float = math.inf) -> None:
        """Take messages in a range of time; parameters are taken from the whole take."""
        if batch.recording:
            self.num_recordings = max(self.num_recordings, batch.recording + 1)
            self.earliest_utime = min(self.earliest_utime, *batch.utimes)
        if self._wanted is not None and batch.source not in self._wanted:
            return
        source = self._sources.setdefault(batch.source, TakeSource(batch.source))
        if batch.key in COMPONENTS_BY_KEY:
            messages = batch.messages_between(first_utime, end_utime)
            if not messages:
                return
            source.recorded.add(batch.key)
            if batch.key not in self._components:
                return
            rows = decode_rows(COMPONENTS_BY_KEY[batch.key], messages)
            if rows.malformed:
                source.malformed[batch.key] += rows.malformed
            self._builder(batch).add(rows)
        elif batch.key in ("take", "details", "end", "status", "parameters"):
            self._describe_all(source, batch)

    def _describe_all(self, source: TakeSource, batch: MessageBatch) -> None:
        if batch.key == "status":
            known = self._statuses.get(source.name)
            # Within a recording, the last one counts, also after a step of the clock.
            if known is None or not batch.recording or known[0] <= batch.utimes[-1]:
                self._statuses[source.name] = batch.utimes[-1], batch.messages[-1]
        for message in batch.messages:
            if batch.key != "status" or not source.server:
                self._describe(source, batch.key, message, batch.recording)

    def _builder(self, batch: MessageBatch) -> SeriesBuilder:
        identity = (batch.source, batch.key, batch.recording)
        if identity not in self._builders:
            self._builders[identity] = SeriesBuilder(COMPONENTS_BY_KEY[batch.key], self._spool_folder)
        return self._builders[identity]

    def describe(self, name: str, status: bytes | None, entries: Sequence[ParametersEntry]) -> None:
        """Take what is known about a source of which something was added: its status, its parameters."""
        source = self._sources.get(name)
        if source is not None:
            source.parameters = [*entries]
            if status is not None:
                self._describe(source, "status", status)

    def finish(self, start_utime: int, *, is_whole: bool = True) -> dict[str, TakeSource]:
        """Return the sources with their arrays. ``is_whole`` tells whether the end of the take was read."""
        for source in self._sources.values():
            source.is_cut_off = is_whole and self._num_open[source.name] > 0
            if self.num_recordings > 1:
                source.parameters = changes_in_order(source.parameters)
        parts: dict[tuple[str, str], list[Series]] = {}
        for (name, key, _), builder in self._builders.items():
            series = builder.build(self._sources[name].parameters, start_utime)
            if series is not None:
                parts.setdefault((name, key), []).append(series)
        for (name, key), found in parts.items():
            setattr(self._sources[name], _FIELDS[key], join_series(found))
        for name, (_, message) in self._statuses.items():
            self._sources[name].frame = _frame_of(message)
        return self._sources

    def _describe(self, source: TakeSource, key: str, message: bytes, recording: int = 0) -> None:
        try:
            decoded = decode(message)
        except ProtocolError:
            source.malformed[key] += 1
            return
        if key == "parameters":
            history = self._histories.setdefault((source.name, recording), ParametersHistory())
            entry = history.add(decoded)
            if entry is not None:
                source.parameters.append(entry)
                if not history.is_readable:
                    source.malformed[key] += 1
        elif key == "details":
            source.details = decoded_details(decoded)
        elif key == "end":
            source.num_lost += decoded.messages_lost
            self._num_open[source.name] -= 1
        else:
            if key == "take":
                self._num_open[source.name] += has_end(decoded)
            if not source.server:
                source.server, source.gateway_version = decoded.server, decoded.gateway_version
