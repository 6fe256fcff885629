"""The takes that gateways describe in their replies, and the list of ``take list``."""

from collections.abc import Mapping
from datetime import datetime
from typing import Any

from rich.console import Console
from rich.text import Text

from gateway.display.terminal import print_list
from gateway.logs.safe_text import safe_text
from gateway.takes.files.description import TakeDetails


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
    def size_text(self) -> str:
        """The size, such as "3.4 MB"."""
        return size_text(self.num_bytes)

    @property
    def facts(self) -> str:
        """The duration, the size and the problem."""
        return ", ".join(filter(None, (self.duration_text, self.size_text, self.problem)))

    @property
    def duration_text(self) -> str:
        """The duration, such as "12.3 s", "4 min 12.3 s" or "1 h 2 min 3.4 s"."""
        minutes, seconds = divmod(round(self.seconds, 1), 60)
        hours, minutes = divmod(int(minutes), 60)
        text = f"{seconds:.1f} s"
        if hours or minutes:
            text = f"{minutes} min {text}"
        return f"{hours} h {text}" if hours else text

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


def size_text(num_bytes: float) -> str:
    """Return a size, such as "3.4 MB"."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if num_bytes >= factor:
            return f"{num_bytes / factor:.1f} {unit}"
    return f"{num_bytes:.0f} bytes"


def write_list(replies: Mapping[str, Mapping[str, Any]], console: Console) -> None:
    """Write the list of the takes of all sources, and below it or on stderr what is not in it."""
    headings = ["source", "name", "begin", "duration", "size", "state", "about"]
    records: list[list[str]] = []
    for source, content in replies.items():
        for take in _listed_takes(content):
            state = "running" if take.is_running else ""
            states = ", ".join(filter(None, (state, take.problem)))
            facts = [source, take.name, take.begin_text, take.duration_text, take.size_text, states]
            records.append([*facts, take.details.text])
    if not any(record[-1] for record in records):
        headings, records = headings[:-1], [record[:-1] for record in records]
    print_list(console, headings, records, numbers=("duration", "size"))
    notes = console if console.is_terminal else Console(stderr=True)
    for source, content in replies.items():
        for line in _notes(source, content):
            notes.print(Text(safe_text(line)), soft_wrap=True)


def _listed_takes(content: Mapping[str, Any]) -> list[ListedTake]:
    """Return the takes in a gateway's reply."""
    takes = content.get("takes")
    if not isinstance(takes, list):
        return []
    return [ListedTake(take) for take in takes if isinstance(take, dict)]


def _notes(source: str, content: Mapping[str, Any]) -> list[str]:
    num_listed, num_takes = len(_listed_takes(content)), round(_number(content, "num_takes"))
    kept_s = _number(content, "kept_s")
    notes = [] if num_takes else [f"{source}: no takes"]
    if num_takes > num_listed:
        notes.append(f"{source}: the newest {num_listed} of {num_takes} takes")
    if kept_s >= 1:
        notes.append(f"{source}: the last {kept_s:.0f} s are kept, to be saved with: take save")
    return notes


def _number(fields: Mapping[str, Any], name: str) -> float:
    value = fields.get(name)
    return value if isinstance(value, int | float) and abs(value) < 1e300 else 0
