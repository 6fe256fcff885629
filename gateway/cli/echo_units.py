"""The units of what ``echo`` prints, from the parameters of the sources."""

import contextlib
import math
import time
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from gateway.cli.params_lcm import query_lcm
from gateway.cli.params_query import Replies
from gateway.cli.params_zenoh import query_zenoh
from gateway.descriptions.labels import describe
from gateway.errors import OutputError, ParametersError
from gateway.messages.encode import MESSAGE_TYPES
from gateway.outputs.kind import SubscriptionRequest
from gateway.outputs.lcm.settings import DEFAULT_LCM_PREFIX, effective_lcm_url
from gateway.outputs.zenoh.settings import DEFAULT_ZENOH_PREFIX
from gateway.outputs.zenoh.subscriber import open_zenoh
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.parameters_xml import parse_parameters

QUERY_S: Final = 2.0
"""How long ``echo`` waits for parameters."""

RETRY_S: Final = 10.0
"""How long a source without an answer is not asked again, because messages wait for QUERY_S meanwhile."""

_MAX_FAILED: Final = 32
"""After so many sources without an answer, no more are asked: anybody can publish under any name."""

OUTPUTS: Final = ("zenoh", "lcm")
"""The outputs on which gateways answer queries for parameters."""

_COMPONENTS: Final = {message_type: component for component, message_type in MESSAGE_TYPES.items()}


def query_parameters(
    output: str, request: SubscriptionRequest, source: str | None, sections: tuple[str, ...]
) -> Replies:
    """Query parameters on the output where ``echo`` subscribes: zenoh or lcm. Raises OutputError."""
    if output == "lcm":
        return query_lcm(
            request.prefix or DEFAULT_LCM_PREFIX,
            source,
            sections,
            fresh=False,
            url=effective_lcm_url(request.address),
            timeout_s=QUERY_S,
        )
    return query_zenoh(
        request.prefix or DEFAULT_ZENOH_PREFIX,
        source,
        sections,
        fresh=False,
        open_session=lambda: open_zenoh(request.address, request.config),
        timeout_s=QUERY_S,
    )


class _Known(NamedTuple):
    """The parameters of a source with their version, and the units of the items of components."""

    version: int
    parameters: Parameters
    units: dict[ComponentType, tuple[str, ...]]


class Units:
    """The units of messages on ``output``. A source is asked once for each version of its parameters."""

    def __init__(self, output: str, request: SubscriptionRequest) -> None:
        self._output = output
        self._request = request
        self._known: dict[str, _Known] = {}
        self._failed_s: dict[str, float] = {}  # when sources last had no answer, on the monotonic clock

    def of(self, name: str, message: Any) -> Sequence[str]:
        """Return the unit of each item in a message with this key or channel; () if they are unknown."""
        component = _COMPONENTS.get(type(message))
        if component is None or self._output not in OUTPUTS or not message.parameters_version:
            return ()
        source = self._source(name, component)
        known = self._known.get(source)
        if known is None or known.version != message.parameters_version:
            known = self._ask(source, message.parameters_version)
        if known is None:
            return ()
        num_items = getattr(message, f"num_{component.item_noun}")
        units = known.units.get(component)
        if units is None or len(units) != num_items:
            units = known.units[component] = describe(component, known.parameters, num_items).units
        return units

    def _source(self, name: str, component: ComponentType) -> str:
        """Return the source of a key or channel; LCM's channels do not say which of its letters are small."""
        if self._output == "zenoh":
            prefix = self._request.prefix or DEFAULT_ZENOH_PREFIX
            return name.removeprefix(f"{prefix}/").partition("/")[0]
        prefix = self._request.prefix or DEFAULT_LCM_PREFIX
        return name.removeprefix(f"{prefix}_").removesuffix(f"_{component.key.upper()}").lower()

    def _ask(self, source: str, version: int) -> _Known | None:
        """Return the parameters with this version; None if the source does not have them."""
        now_s = time.monotonic()
        if now_s - self._failed_s.get(source, -math.inf) < RETRY_S or len(self._failed_s) >= _MAX_FAILED:
            return None
        with contextlib.suppress(OutputError, ParametersError):
            for reply in query_parameters(self._output, self._request, source, ()).received:
                if reply.source == source and reply.version == version:
                    known = _Known(version, parse_parameters(reply.xml).parameters, {})
                    self._known[source] = known
                    return known
        self._failed_s[source] = now_s
        return None
