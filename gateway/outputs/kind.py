"""The description of an output in the registry: its name, its settings, functions for it, and subscribing.

The optional functions are for the commands ``echo``, ``doctor`` and ``demo``. An output without the function
is left out of that command.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

from gateway.config.settings import OutputSettings, SourceSettings
from gateway.errors import ConfigError
from gateway.outputs.contract import Output
from gateway.outputs.findings import Finding, MessageLoad
from gateway.outputs.open_ports import OpenPort, listening_ports


def missing_package(output: str, extra: str, error: ImportError) -> ConfigError:
    """Return the error for an output that is enabled, but whose package is not installed."""
    package = error.name or extra
    return ConfigError(
        f"{output}.enabled is true, but the package {package!r} is not installed; install it with "
        f"pip install 'rtc3d-gateway[{extra}]', or set {output}.enabled to false"
    )


def imported_late(path: str, extra: str = "") -> Callable[..., Any]:
    """Return the function or class ``MODULE:NAME``, which is imported when it is called.

    So the registry does not import the outputs that the configuration does not enable. If packages of the
    ``extra`` of the same name as the output are not installed, the call raises ConfigError.
    """
    module, _, name = path.partition(":")

    def call(*arguments: Any) -> Any:
        try:
            found = getattr(import_module(module), name)
        except ImportError as error:
            if not extra:
                raise
            raise missing_package(extra, extra, error) from error
        return found(*arguments)

    return call


Receive = Callable[[str, bytes], None]
"""Takes the key or channel, and the message. Called in a thread of the subscription."""


DISCOVERY_S: Final = 2.5
"""How long it may take to find a gateway: Zenoh needs time to connect; LCM carries one status a second."""

_MAX_NAMED: Final = 20


def missing_source(wanted: Collection[str], served: Collection[str]) -> str:
    """Return which of the ``wanted`` sources is not served, and which sources are; "" if all are."""
    missing = [source for source in wanted if source not in served]
    if not missing:
        return ""
    names = sorted(served)
    more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
    return f"no gateway serves source {missing[0]!r}; sources found: {', '.join(names[:_MAX_NAMED])}{more}"


OPENS: Final = "opens"
"""The check of an output without checks of its own: does it open?"""


class Subscription(Protocol):
    """A subscriber of a gateway's messages."""

    def close(self) -> None:
        """Unsubscribe and end the thread that receives."""


class SubscriptionRequest(NamedTuple):
    """What to subscribe to, and where. None means all sources or components, or the default.

    ``config`` is a file with the configuration of the output's library, such as Zenoh's.
    """

    source: str | None = None
    component: str | None = None
    prefix: str | None = None
    address: str | None = None
    config: Path | None = None


class DemoSide(NamedTuple):
    """One output in the demo: its settings, the output, and a function that subscribes to it locally."""

    settings: OutputSettings
    output: Output
    subscribe: Callable[[str, Receive], Subscription]
    """Takes the source's name. Called after the output has opened. Raises OutputError."""

    endpoint: str | None = None
    """Where other programs on this computer can subscribe; None if nowhere."""


@dataclass(frozen=True)
class OutputKind:
    """One entry of the registry. ``settings`` is the model of its section, ``create`` takes an instance."""

    name: str
    settings: type[OutputSettings]
    create: Callable[[Any], Output]

    subscribe: Callable[[SubscriptionRequest, Receive], Subscription] | None = None
    """Subscribes to a gateway's messages. Raises OutputError."""

    checks: Sequence[str] = (OPENS,)
    """The names of the doctor's checks, in order."""

    run_checks: Callable[[Any, Sequence[str], Sequence[MessageLoad], float], list[Finding]] | None = None
    """Runs ``checks``. Takes the settings, the sources' names, loads and the seconds to wait. May block.

    If it is None, the doctor checks that the output opens.
    """

    commands: Sequence[str] = ()
    """The names of the output's commands, for the error that peers get while it is off."""

    leaves_host: Callable[[Any], bool] = lambda _settings: True
    """Takes the settings; returns whether messages may leave this computer. The doctor needs it."""

    open_ports: Callable[[Any, Sequence[SourceSettings]], Sequence[OpenPort]] = listening_ports
    """Takes the settings and all sources; returns every port that the output opens, for the doctor."""

    demo: Callable[[bool], DemoSide] | None = None
    """Builds the output for the demo. Takes whether to use the network. Raises OutputError."""
