"""What differs between two sets of parameters, in words for the log."""

from dataclasses import replace
from typing import Final

from gateway.rtc3d.parameters import SECTIONS, Parameters, Parameters3D, Parameters6D, without_statistics
from gateway.safe_text import quoted

_MAX_NAMED: Final = 3
"""How many items with a new name are listed for each section; the others are counted."""


def differ_in_statistics_only(before: bytes, after: bytes) -> bool:
    """Return whether two XML replies are the same except for the statistics of §6.1. Cheap for long XML."""
    return _without(before, _statistics(before)) == _without(after, _statistics(after))


def statistics_xml(xml: bytes) -> bytes:
    """Return the statistics of §6.1 in an XML reply as a reply of their own; b"" if it has none."""
    found = xml[_statistics(xml)]
    return b"<RT_Parameters><General><Server>%b</Server></General></RT_Parameters>" % found if found else b""


def _statistics(xml: bytes) -> slice:
    """Return where the element of the statistics is; an empty slice if there is none."""
    start = xml.find(b"<Stats>")
    end = xml.find(b"</Stats>", start)
    return slice(0, 0) if start < 0 or end < 0 else slice(start, end + len(b"</Stats>"))


def _without(xml: bytes, part: slice) -> bytes:
    return xml[: part.start] + xml[part.stop :]


def describe_renames(before: Parameters, after: Parameters) -> str:
    """Return which markers and tools have another name than before; "" if none has.

    Data frames have no names: the position of an item decides which name it has (§6.2, §6.3). So items at
    the same position are compared. The text is bounded, and control characters are escaped.
    """
    texts = []
    for section in ("3d", "6d"):
        labels = zip(_labels(before, section), _labels(after, section), strict=False)
        renamed = [f"{quoted(old)} to {quoted(new)}" for old, new in labels if old != new]
        if renamed:
            rest = f" and {len(renamed) - _MAX_NAMED} more" if len(renamed) > _MAX_NAMED else ""
            texts.append(f"{section} {', '.join(renamed[:_MAX_NAMED])}{rest}")
    return "; ".join(texts)


def changed_sections(before: Parameters, after: Parameters) -> list[str]:
    """Return the sections that differ in more than the statistics and the names of markers and tools."""
    before, after = _without_labels(before), _without_labels(after)
    return [name for name, section in SECTIONS.items() if section.of(before) != section.of(after)]


def _labels(parameters: Parameters, section: str) -> list[str]:
    match SECTIONS[section].of(parameters):
        case Parameters3D(markers=items) | Parameters6D(tools=items):
            return [item.label for item in items]
    return []


def _without_labels(parameters: Parameters) -> Parameters:
    """Return the parameters without statistics, and without the labels of markers and tools."""
    parameters = without_statistics(parameters)
    if parameters.markers is not None:
        markers = tuple(replace(marker, label="") for marker in parameters.markers.markers)
        parameters = replace(parameters, markers=replace(parameters.markers, markers=markers))
    if parameters.tools is not None:
        tools = tuple(replace(tool, label="") for tool in parameters.tools.tools)
        parameters = replace(parameters, tools=replace(parameters.tools, tools=tools))
    return parameters
