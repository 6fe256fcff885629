"""What ``take list`` and ``take info`` print: as JSON, and as tables for people."""

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any, Final, Literal

from rich.columns import Columns
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.runtime.quantities import counted, duration_text, size_text
from gateway.runtime.safe_text import safe_text
from gateway.takes.files.component_statistics import ComponentStatistics, MessageStatistics
from gateway.takes.files.description import TakeDetails
from gateway.takes.files.reader import DESCRIPTIONS, is_gateways_channel
from gateway.takes.files.statistics import SourceStatistics, TakeStatistics
from gateway.tools.display.terminal import list_table, print_list


class ListedTake:
    """A take as a gateway describes it. A gateway of another version may describe it in another way."""

    def __init__(self, fields: Mapping[str, Any]) -> None:
        self.name = str(fields.get("name", ""))
        self.num_bytes = _number(fields, "bytes")
        self.begin_utime = _number(fields, "begin_utime")
        self.seconds = _number(fields, "seconds")
        self.num_lost = round(_number(fields, "lost"))
        self.is_running = fields.get("is_running") is True
        self.is_cut_off = fields.get("is_cut_off") is True
        self.details = TakeDetails(*(str(fields.get(name, "")) for name in TakeDetails._fields))

    @property
    def facts(self) -> str:
        """The duration, the size and the problem."""
        return ", ".join(filter(None, (duration_text(self.seconds), size_text(self.num_bytes), self.problem)))

    @property
    def begin_text(self) -> str:
        """The beginning, in local time."""
        try:
            begin = datetime.fromtimestamp(self.begin_utime / 1e6).astimezone()
        except (OverflowError, OSError, ValueError):
            return "?"
        return begin.strftime("%Y-%m-%d %H:%M:%S") if self.begin_utime else "?"

    @property
    def problem(self) -> str:
        """What is missing; "" if nothing."""
        lost = f"{self.num_lost} messages lost" if self.num_lost else ""
        return ", ".join(filter(None, ("cut off" if self.is_cut_off else "", lost)))


def write_list(replies: Mapping[str, Mapping[str, Any]], console: Console) -> None:
    """Write the list of the takes of all sources, and below it or on stderr what is not in it."""
    headings = ["source", "name", "begin", "duration", "size", "state", "about"]
    records: list[list[str]] = []
    notes: list[str] = []
    for source, content in replies.items():
        contents = content.get("takes")
        contents = contents if isinstance(contents, list) else []
        takes = [ListedTake(fields) for fields in contents if isinstance(fields, dict)]
        for take in takes:
            states = ", ".join(filter(None, ("running" if take.is_running else "", take.problem)))
            size = size_text(take.num_bytes)
            facts = [source, take.name, take.begin_text, duration_text(take.seconds), size, states]
            records.append([*facts, take.details.text])
        num_takes, kept_s = round(_number(content, "num_takes")), _number(content, "kept_s")
        if not num_takes:
            notes.append(f"{source}: no takes")
        if num_takes > len(takes):
            notes.append(f"{source}: the newest {len(takes)} of {num_takes} takes")
        if kept_s >= 1:
            notes.append(f"{source}: the last {kept_s:.0f} s are kept, to be saved with: take save")
    if not any(record[-1] for record in records):
        headings, records = headings[:-1], [record[:-1] for record in records]
    print_list(console, headings, records, numbers=("duration", "size"))
    console = console if console.is_terminal else Console(stderr=True)
    for note in notes:
        console.print(Text(safe_text(note)), soft_wrap=True)


def _number(fields: Mapping[str, Any], name: str) -> float:
    value = fields.get(name)
    return value if isinstance(value, int | float) and abs(value) < 1e300 else 0


def statistics_json(statistics: TakeStatistics) -> dict[str, Any]:
    """Return everything as values that ``json`` can write; docs/reference/takes.md describes it."""
    return {
        "file": str(statistics.path),
        "files": [str(file) for file in statistics.files],
        "bytes": statistics.num_bytes,
        "begin_utime": statistics.start_utime,
        "seconds": statistics.seconds,
        "messages": statistics.num_messages,
        "is_complete": statistics.is_complete,
        "sources": {name: _source_json(statistics, source) for name, source in statistics.sources.items()},
        "damage": {
            "places": statistics.num_damaged,
            "bytes": statistics.damaged_bytes,
            "list": [
                {"file": str(damage.file), "offset": damage.offset, "bytes": damage.num_bytes}
                for damage in statistics.damage
            ],
            "empty_files": [str(file) for file in statistics.empty_files],
        },
        "unknown": statistics.unknown,
    }


def _source_json(statistics: TakeStatistics, source: SourceStatistics) -> dict[str, Any]:
    events = source.components.get("event")
    components = {
        key: _messages_json(statistics, part)
        | {
            "items": [part.min_items, part.max_items],
            "rate_hz": part.rate_hz,
            "announced_hz": source.announced_hz(part.component.key),
            "visible": part.visibility,
        }
        for key, part in source.components.items()
    }
    return {
        "take": source.origin.take_name,
        "recorder": source.origin.recorder,
        "host": source.origin.host,
        **source.origin.details._asdict(),
        "servers": source.origin.servers,
        "gateway_versions": source.origin.gateway_versions,
        "sessions": source.sessions,
        "server_restarts": source.server_restarts,
        "measurements": source.measurements,
        "gateway_restarts": source.gateway_restarts,
        "components": components,
        "other": {key: _messages_json(statistics, part) for key, part in source.others.items()},
        "events": [
            {"id": number, "label": source.parameters.event_labels.get(number, ""), "count": count}
            for number, count in sorted(events.event_counts.items() if events else ())
        ],
        "parameters": [
            {"at_s": statistics.seconds_at(change.utime), "version": change.version, "change": change.text}
            for change in source.parameters.changes
        ],
        "parameters_changes": source.parameters.num_changes,
        "clock_steps": [
            {"at_s": statistics.seconds_at(step.utime), "step_s": step.step_us / 1e6}
            for step in source.clock_steps.steps
        ],
        "lost": source.num_lost,
        "is_cut_off": source.is_cut_off,
        "lost_by_gateway": [
            {"where": place, "cause": cause, "messages": number}
            for (place, cause), number in source.gateway_losses.counts.items()
        ],
    }


def _messages_json(statistics: TakeStatistics, part: MessageStatistics) -> dict[str, Any]:
    gaps = part.gaps
    gap_list = [{"at_s": statistics.seconds_at(gap.utime), "missing": gap.missing} for gap in gaps.gaps]
    largest = gaps.largest
    return {
        "messages": part.num_messages,
        "bytes": part.num_bytes,
        "malformed": part.malformed,
        "first_s": statistics.seconds_at(part.first_utime) if part.first_utime else None,
        "last_s": statistics.seconds_at(part.last_utime) if part.last_utime else None,
        "missing": gaps.num_lost,
        "gaps": gaps.num_gaps,
        "largest_gap": largest and {"at_s": statistics.seconds_at(largest.utime), "missing": largest.missing},
        "gap_list": gap_list,
        "late": gaps.num_late,
        "repeated": gaps.num_repeated,
        "implausible": gaps.num_implausible,
    }


_MAX_SHOWN: Final = 10
"""How many changes, clock steps, channels and places of damage are shown."""

_MAX_LABELS: Final = 200
_MAX_LINE: Final = 1000


def write_report(statistics: TakeStatistics, console: Console) -> None:
    """Write the report to ``console``."""
    for part in _report(statistics):
        if isinstance(part, str):
            console.print(Text(safe_text(part, _MAX_LINE)), soft_wrap=True)
        else:
            console.print(part)


def _report(statistics: TakeStatistics) -> Iterator[RenderableType]:
    num_files = len(statistics.files)
    files_text = f", {num_files} files" if num_files > 1 else ""
    yield f"{statistics.path}: {size_text(statistics.num_bytes)}{files_text}"
    try:
        begin = datetime.fromtimestamp(statistics.start_utime / 1e6).astimezone()
        begin_text = begin.strftime("%Y-%m-%d %H:%M:%S %Z")
    except (OverflowError, OSError, ValueError):
        begin_text = f"{statistics.start_utime} µs after 1970"
    messages = counted(statistics.num_messages, "message")
    yield f"{begin_text}, {duration_text(statistics.seconds)}, {messages}"
    yield from _incomplete(statistics)
    for source in statistics.sources.values():
        yield ""
        yield from _source_lines(statistics, source)
        yield _components_table(statistics, source)
        yield from _item_lists(source)
        yield from _changes(statistics, source)
    problems = list(_problems(statistics))
    if problems:
        yield ""
        yield from problems


def _incomplete(statistics: TakeStatistics) -> Iterator[str]:
    """Yield what the recorder could not write, and what cannot be read: whoever uses the take must know."""
    for source in statistics.sources.values():
        if source.is_cut_off:
            yield f"INCOMPLETE: {source.name}: the recording was cut off: its end is missing"
        if source.num_lost:
            lost = counted(source.num_lost, "message")
            yield f"INCOMPLETE: {source.name}: the recording lacks {lost} that found no room on the disk"
    if statistics.num_damaged:
        places = counted(statistics.num_damaged, "place")
        yield f"INCOMPLETE: {statistics.damaged_bytes} bytes at {places} could not be read"


def _source_lines(statistics: TakeStatistics, source: SourceStatistics) -> Iterator[str]:
    origin = source.origin
    servers = ", ".join(origin.servers) or "unknown server"
    versions = ", ".join(origin.gateway_versions)
    yield f"Source {source.name}: {servers}" + (f", gateway {versions}" if versions else "")
    if origin.take_name:
        host = f" on {origin.host}" if origin.host else ""
        yield f"Take {origin.take_name!r}, recorded by {origin.recorder}{host}"
    if origin.details.text:
        yield f"About {origin.details.text}"
    texts = [counted(source.sessions, "connection")]
    if source.server_restarts:
        times = _times(source.server_restarts)
        texts.append(f"{source.measurements} measurements: the server's time started again {times}")
    if source.gateway_restarts:
        texts.append(f"the gateway started again {_times(source.gateway_restarts)}")
    texts += [
        f"the clock was set by {step.step_us / 1e6:+.1f} s at {_at(statistics, step.utime)}"
        for step in source.clock_steps.steps[:_MAX_SHOWN]
    ]
    yield "; ".join(texts)


_HEADINGS: Final = ("", "messages", "items", "Hz", "seconds", "missing", "gaps, largest")


def _components_table(statistics: TakeStatistics, source: SourceStatistics) -> Table:
    poses = [part for key, part in source.others.items() if "/" in key]
    parts: dict[str, list[MessageStatistics]] = {
        key: [source.components[key]] for key in COMPONENTS_BY_KEY if key in source.components
    }
    if poses:
        parts[counted(len(poses), "pose")] = poses
    parts |= {
        key: [part] for key, part in source.others.items() if "/" not in key and key not in DESCRIPTIONS
    }
    table = list_table()
    for column, heading in enumerate(_HEADINGS):
        justify: Literal["left", "right"] = "right" if 0 < column < len(_HEADINGS) - 1 else "left"
        table.add_column(heading, justify=justify, overflow="fold")
    for key, some in parts.items():
        # Text objects, because rich would read square brackets in a string as markup.
        table.add_row(*(Text(safe_text(str(value))) for value in _cells(statistics, source, key, some)))
    return table


def _cells(
    statistics: TakeStatistics, source: SourceStatistics, name: str, parts: Sequence[MessageStatistics]
) -> tuple[object, ...]:
    """Return the cells of a component, or of all poses together."""
    part = parts[0]
    items = rate = gap_text = ""
    if isinstance(part, ComponentStatistics):
        items = f"{part.min_items} to {part.max_items}"
        if part.min_items == part.max_items:
            items = "" if part.min_items is None else str(part.min_items)
        rates_hz = () if name == "event" else (part.rate_hz, source.announced_hz(name))
        rate = " of ".join(f"{rate_hz:.5g}" for rate_hz in rates_hz if rate_hz is not None)
    gaps = [part.gaps for part in parts]
    largest = max((gap.largest for gap in gaps if gap.largest), key=lambda gap: gap.missing, default=None)
    if largest is not None:
        number = sum(gap.num_gaps for gap in gaps)
        gap_text = f"{number}, {largest.missing} at {_at(statistics, largest.utime)}"
    return (
        name,
        sum(part.num_messages for part in parts),
        items,
        rate,
        f"{(part.last_utime - part.first_utime) / 1e6:.2f}" if part.first_utime else "",
        sum(gap.num_lost for gap in gaps),
        gap_text,
    )


def _item_lists(source: SourceStatistics) -> Iterator[RenderableType]:
    for key, noun in (("3d", "marker"), ("6d", "tool")):
        part = source.components.get(key)
        if part is not None and part.visibility:
            texts = [f"{label}  {100 * share:.1f} %" for label, share in part.visibility.items()]
            yield f"{counted(len(texts), noun)}, visible in % of the frames:"
            yield _columns(texts)
    events = source.components.get("event")
    if events is not None and events.event_counts:
        labels = source.parameters.event_labels
        texts = [
            f"{labels.get(number, '')} ({number:#x})  {count}".lstrip()
            for number, count in sorted(events.event_counts.items())
        ]
        yield f"{counted(sum(events.event_counts.values()), 'event')}:"
        yield _columns(texts)


def _columns(texts: Sequence[str]) -> Columns:
    shown = [Text("  " + safe_text(text)) for text in texts[:_MAX_LABELS]]
    if len(texts) > len(shown):
        shown.append(Text(f"  … and {len(texts) - len(shown)} more"))
    return Columns(shown, equal=True, column_first=True)


def _changes(statistics: TakeStatistics, source: SourceStatistics) -> Iterator[str]:
    changes = source.parameters.changes[:_MAX_SHOWN]
    if not changes:
        yield "No parameters: labels, units and rates are not known"
    for change in changes:
        yield f"Parameters {change.version} at {_at(statistics, change.utime)}: {change.text}"
    if source.parameters.num_changes > len(changes):
        yield f"… and {source.parameters.num_changes - len(changes)} more changes of parameters"


def _problems(statistics: TakeStatistics) -> Iterator[str]:
    """Yield what is missing, and what could not be read."""
    for source in statistics.sources.values():
        for text in _source_problems(source):
            yield f"{source.name}: {text}"
    if statistics.num_damaged:
        yield "Damage:"
        for damage in statistics.damage[:_MAX_SHOWN]:
            yield f"  {damage.file.name}: {damage.num_bytes} bytes from {damage.offset} on"
        for text in statistics.empty_files.values():
            yield f"  {text}"
    if statistics.unknown:
        yield f"{counted(sum(statistics.unknown.values()), 'message')} of other programs or other versions:"
        for channel, number in sorted(statistics.unknown.items(), key=lambda item: -item[1])[:_MAX_SHOWN]:
            version = " (another version of the gateway?)" if is_gateways_channel(channel) else ""
            yield f"  {channel}: {number}{version}"


def _source_problems(source: SourceStatistics) -> Iterator[str]:
    for (place, cause), number in source.gateway_losses.counts.items():
        yield f"the gateway lost {counted(number, 'message')} ({place}: {cause})"
    parts: dict[str, MessageStatistics] = {**source.components, **source.others}
    for key, part in parts.items():
        for number, what in (
            (part.malformed, "could not be read"),
            (part.gaps.num_implausible, "with implausible sequence numbers"),
            (part.gaps.num_late, "arrived late"),
            (part.gaps.num_repeated, "arrived again"),
        ):
            if number:
                yield f"{counted(number, f'{key} message')} {what}"


def _at(statistics: TakeStatistics, utime: int) -> str:
    return f"{round(statistics.seconds_at(utime), 2) + 0.0:.2f} s"  # no minus before 0.00


def _times(number: int) -> str:
    return "once" if number == 1 else f"{number} times"
