"""The JSON of ``take info``, described in docs/reference/takes.md."""

from typing import Any

from gateway.takes.component_statistics import ComponentStatistics, MessageStatistics
from gateway.takes.sequence_gaps import Gap
from gateway.takes.source_statistics import SourceStatistics
from gateway.takes.statistics import TakeStatistics


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
    return {
        "take": source.take_name,
        "recorder": source.recorder,
        "host": source.host,
        **source.details._asdict(),
        "servers": source.servers,
        "gateway_versions": source.gateway_versions,
        "sessions": source.sessions,
        "server_restarts": source.server_restarts,
        "measurements": source.measurements,
        "gateway_restarts": source.gateway_restarts,
        "components": {
            key: _component_json(statistics, source, part) for key, part in source.components.items()
        },
        "other": {key: _messages_json(statistics, part) for key, part in source.others.items()},
        "events": [
            {"id": number, "label": source.event_labels.get(number, ""), "count": count}
            for number, count in sorted(events.event_counts.items() if events else ())
        ],
        "parameters": [
            {"at_s": statistics.seconds_at(change.utime), "version": change.version, "change": change.text}
            for change in source.parameters_changes
        ],
        "parameters_changes": source.num_parameters_changes,
        "clock_steps": [
            {"at_s": statistics.seconds_at(step.utime), "step_s": step.step_us / 1e6}
            for step in source.clock_steps.steps
        ],
        "lost": source.num_lost,
        "is_cut_off": source.is_cut_off,
        "lost_by_gateway": [
            {"where": place, "cause": cause, "messages": number}
            for (place, cause), number in source.drops.items()
        ],
    }


def _component_json(
    statistics: TakeStatistics, source: SourceStatistics, part: ComponentStatistics
) -> dict[str, Any]:
    return _messages_json(statistics, part) | {
        "items": [part.min_items, part.max_items],
        "rate_hz": part.rate_hz,
        "announced_hz": source.announced_hz(part.component.key),
        "visible": part.visibility,
    }


def _messages_json(statistics: TakeStatistics, part: MessageStatistics) -> dict[str, Any]:
    gaps = part.gaps
    return {
        "messages": part.num_messages,
        "bytes": part.num_bytes,
        "malformed": part.malformed,
        "first_s": statistics.seconds_at(part.first_utime) if part.first_utime else None,
        "last_s": statistics.seconds_at(part.last_utime) if part.last_utime else None,
        "missing": gaps.missing,
        "gaps": gaps.num_gaps,
        "largest_gap": None if gaps.largest is None else _gap_json(statistics, gaps.largest),
        "gap_list": [_gap_json(statistics, gap) for gap in gaps.gaps],
        "late": gaps.late,
        "repeated": gaps.repeated,
        "implausible": gaps.implausible,
    }


def _gap_json(statistics: TakeStatistics, gap: Gap) -> dict[str, Any]:
    return {"at_s": statistics.seconds_at(gap.utime), "missing": gap.missing}
