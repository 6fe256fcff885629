"""The status of an output: its counters for one source, and whether it can send."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from gateway.losses import Loss


@dataclass
class OutputStatus:
    """The counters of one output for one source: messages and their bytes by component, losses by cause."""

    name: str
    messages: Counter[str] = field(default_factory=Counter)
    losses: Sequence[Loss] = ()
    message_bytes: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True)
class OutputHealth:
    """Whether an output can send, and if not, what is wrong and what to do."""

    connected: bool
    problem: str = ""
