"""The doctor's checks of the output for viewers: its packages, and its port."""

import json
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final

from gateway.outputs.adapters.foxglove.settings import FOXGLOVE, FoxgloveSettings
from gateway.outputs.findings import Check, Finding, MessageLoad, failing_first
from gateway.outputs.listen_address import from_this_computer, host_in_url, listen_problem

_PACKAGES: Final = ("foxglove-sdk", "protobuf", "websockets")
_TIMEOUT_S: Final = 2.0
_MAX_MESSAGES: Final = 20

_PACKAGE, _PORT = (Check("foxglove", name) for name in FOXGLOVE.checks)


def check_foxglove(
    settings: FoxgloveSettings, sources: Sequence[str], _loads: Sequence[MessageLoad], _seconds: float
) -> list[Finding]:
    """Check that viewers can be served: at once, or already by a gateway that is running."""
    versions = {}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            remedy = "Install it with: pip install 'rtc3d-gateway[foxglove]'"
            failing = _PACKAGE.failing(f"the package {name} is not installed", remedy)
            return failing_first(failing, FOXGLOVE.checks[1:])
    found = ", ".join(f"{name} {number}" for name, number in versions.items())
    return [_PACKAGE.passing(found), _check_port(settings, sources)]


def _check_port(settings: FoxgloveSettings, sources: Sequence[str]) -> Finding:
    address = f"ws://{host_in_url(settings.host)}:{settings.port}"
    problem = listen_problem(settings.host, settings.port)
    if not problem:
        return _PORT.passing(f"viewers will be able to connect to {address}")
    topics = _advertised_topics(settings)
    if topics is None:
        return _PORT.failing(
            f"cannot listen on {address}: {problem}, and what is there is no gateway",
            f"`ss -ltnp` shows which program uses port {settings.port}. Stop it, or correct foxglove.host "
            "and foxglove.port.",
        )
    missing = [source for source in sources if not any(topic.startswith(f"/{source}/") for topic in topics)]
    if missing:
        return _PORT.warning(
            f"a gateway serves viewers at {address}, but not {', '.join(missing)}",
            "Reload the gateway, or start it with this configuration.",
        )
    return _PORT.passing(f"a gateway serves viewers at {address}, with {len(topics)} topics")


def _advertised_topics(settings: FoxgloveSettings) -> list[str] | None:
    """Return the topics of the gateway that listens there; None if it is none."""
    from websockets.exceptions import WebSocketException  # noqa: PLC0415 - needs the extra foxglove
    from websockets.sync.client import connect  # noqa: PLC0415
    from websockets.typing import Subprotocol  # noqa: PLC0415

    from gateway.outputs.adapters.foxglove.connections import SUBPROTOCOLS  # noqa: PLC0415 - it needs them, too

    host = host_in_url(from_this_computer(settings.host))
    names = [Subprotocol(name) for name in SUBPROTOCOLS]
    try:
        with connect(
            f"ws://{host}:{settings.port}",
            subprotocols=names,
            open_timeout=_TIMEOUT_S,
            close_timeout=_TIMEOUT_S,
            max_size=None,
            proxy=None,
        ) as viewer:
            for _ in range(_MAX_MESSAGES):
                message: Any = json.loads(viewer.recv(timeout=_TIMEOUT_S))
                if message.get("op") == "advertise":
                    return [channel["topic"] for channel in message["channels"]]
    except (OSError, WebSocketException, ValueError, AttributeError, KeyError, TypeError):
        return None
    return None
