"""An output as the registry describes it: its name, its settings, how to build it, and its tools.

The tools are for the command line: subscribing (``echo``), diagnosis (``doctor``) and the demo. An output
without one of them is left out there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Protocol

from gateway.config.settings import OutputSettings
from gateway.findings import Finding, MessageLoad
from gateway.outputs.contract import Output

Receive = Callable[[str, bytes], None]
"""Called with the key or channel and the message, from a thread of the subscription's own."""


OPENS: Final = "opens"
"""The check that any output has."""


class Subscription(Protocol):
    """A subscriber of what a gateway publishes."""

    def close(self) -> None:
        """Unsubscribe and end the thread that receives."""


class SubscriptionRequest(NamedTuple):
    """What to subscribe to, and where; None stands for the default, or for all."""

    source: str | None = None
    component: str | None = None
    prefix: str | None = None
    address: str | None = None


class DemoSide(NamedTuple):
    """One output in the demo: its settings, the output, and a subscriber of it on this machine."""

    settings: OutputSettings
    output: Output
    subscribe: Callable[[str, Receive], Subscription]
    """Takes the source's name; called once the output is open; raises OutputError."""


@dataclass(frozen=True)
class OutputKind:
    """One entry of the registry; ``settings`` is the model of its section, which ``create`` takes."""

    name: str
    settings: type[OutputSettings]
    create: Callable[[Any], Output]

    subscribe: Callable[[SubscriptionRequest, Receive], Subscription] | None = None
    """Subscribes to what a gateway publishes; raises OutputError."""

    checks: Sequence[str] = (OPENS,)
    """The names of the doctor's checks, in their order."""

    run_checks: Callable[[Any, Sequence[str], Sequence[MessageLoad], float], list[Finding]] | None = None
    """Runs ``checks``, given settings, names of sources, loads and seconds to wait; it may block.

    Without it, the doctor checks that the output opens.
    """

    demo: Callable[[bool], DemoSide] | None = None
    """Takes whether to use the real network; raises OutputError."""
