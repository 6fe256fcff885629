"""The status of an output: its counters for one source, and whether it can send."""

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class OutputStatus:
    """The counters of one output for one source: messages and their bytes by component, drops by cause."""

    name: str
    messages: Counter[str] = field(default_factory=Counter)
    drops: Counter[str] = field(default_factory=Counter)
    message_bytes: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True)
class OutputHealth:
    """Whether an output can send, and if not, what is wrong and what to do."""

    connected: bool
    problem: str = ""
