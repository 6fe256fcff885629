"""The status of an output: its counters for one source, and whether it can send."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from gateway.losses import Loss

WHOLE_FRAME: Final = "frame"
"""What stands for the component in the counters of an output that takes whole frames."""


@dataclass
class OutputStatus:
    """The counters of one output for one source: messages and their bytes by component, losses by cause.

    ``takes_frames`` is whether the output takes whole frames instead of components.
    """

    name: str
    messages: Counter[str] = field(default_factory=Counter)
    losses: Sequence[Loss] = ()
    message_bytes: Counter[str] = field(default_factory=Counter)
    takes_frames: bool = False


@dataclass(frozen=True)
class OutputHealth:
    """Whether an output can send, and if not, what is wrong and what to do."""

    connected: bool
    problem: str = ""
