"""What ``echo`` knows about sources: the units of their data, and why nothing is heard."""

import contextlib
import math
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from gateway.client.client import GatewayAddress, GatewayClient
from gateway.config.words import join_or
from gateway.errors import OutputError, ParametersError, QueryError
from gateway.messages.descriptions.labels import describe
from gateway.messages.encode import MESSAGE_TYPES
from gateway.messages.source_report import SourceReport
from gateway.messages.topics import DEFAULT_LCM_PREFIX, lcm_channel
from gateway.outputs.kind import SubscriptionRequest
from gateway.outputs.zenoh.settings import DEFAULT_ZENOH_PREFIX
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.runtime.safe_text import quoted, safe_lines, safe_text

QUERY_S: Final = 2.0
"""How long ``echo`` waits for parameters."""

RETRY_S: Final = 10.0
"""How long a source without an answer is not asked again, because messages wait for QUERY_S meanwhile."""

_MAX_FAILED: Final = 32
"""After so many sources without an answer, no more are asked: anybody can publish under any name."""

OUTPUTS: Final = ("zenoh", "lcm")
"""The outputs on which gateways answer queries for parameters."""

_COMPONENTS: Final = {message_type: component for component, message_type in MESSAGE_TYPES.items()}


class _Known(NamedTuple):
    """The parameters of a source with their version, and the units of the items of components."""

    version: int
    parameters: Parameters
    units: dict[ComponentType, tuple[str, ...]]


LOOK_S: Final = 0.4
"""How long nothing is heard before this looks for what exists."""

SAY_S: Final = 2.0
"""How long nothing is heard before this is said."""

_MAX_NAMED: Final = 20


class EchoSources:
    """Asks the gateways on an output about the sources that ``echo`` subscribes to.

    A source is asked once for each version of its parameters. Why nothing is heard is found out in a thread,
    and said once.
    """

    def __init__(self, output: str, request: SubscriptionRequest) -> None:
        self._output = output
        self._request = request
        self._known: dict[str, _Known] = {}
        self._failed_s: dict[str, float] = {}  # when sources last had no answer, on the monotonic clock
        self._start_s = time.monotonic()
        self._thread: threading.Thread | None = None
        self._error: QueryError | None = None
        self._reason = ""
        self._is_said = False

    def client(self) -> GatewayClient:
        """Return a client of these gateways."""
        where, config = self._request.address, self._request.config
        is_lcm = self._output == "lcm"
        return GatewayClient(GatewayAddress(is_lcm, where, config, where, self._request.prefix), QUERY_S)

    def units_of(self, name: str, message: Any) -> Sequence[str]:
        """Return the unit of each item in a message with this key or channel; () if they are unknown."""
        component = _COMPONENTS.get(type(message))
        if component is None or self._output not in OUTPUTS or not message.parameters_version:
            return ()
        if self._output == "zenoh":
            prefix = self._request.prefix or DEFAULT_ZENOH_PREFIX
            source = name.removeprefix(f"{prefix}/").partition("/")[0]
        else:  # channels do not say which of its letters are small
            prefix = self._request.prefix or DEFAULT_LCM_PREFIX
            source = name.removeprefix(f"{prefix}_").removesuffix(f"_{component.key.upper()}").lower()
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

    def _ask(self, source: str, version: int) -> _Known | None:
        """Return the parameters with this version; None if the source does not have them."""
        now_s = time.monotonic()
        if now_s - self._failed_s.get(source, -math.inf) < RETRY_S or len(self._failed_s) >= _MAX_FAILED:
            return None
        with contextlib.suppress(OutputError, ParametersError), self.client() as client:
            for reply in client.parameters(source).received:
                if reply.source == source and reply.version == version:
                    known = _Known(version, parse_parameters(reply.content).parameters, {})
                    self._known[source] = known
                    return known
        self._failed_s[source] = now_s
        return None

    def check_silence(self) -> None:
        """Call this again and again while nothing has been heard.

        Raises QueryError if there are gateways, and none of them has the source or the component.
        """
        silent_s = time.monotonic() - self._start_s
        if self._output not in OUTPUTS or self._is_said or silent_s < LOOK_S:
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._look, name="find-sources", daemon=True)
            self._thread.start()
        if self._thread.is_alive():
            return
        if self._error is not None:
            raise self._error
        if silent_s >= SAY_S:
            self._is_said = True
            print(safe_lines(self._reason), file=sys.stderr, flush=True)

    def _look(self) -> None:
        """Find out what exists, in the thread."""
        try:
            with self.client() as client:
                found = client.sources(self._request.source)
                if found.absence and found.heard:
                    self._error = QueryError(found.absence, code="no-gateway")
                else:
                    self._reason = found.absence or self._why_silent(found.sources, client)
        except QueryError as error:
            self._error = error
        except OutputError as error:
            self._reason = str(error)
        except Exception as error:  # noqa: BLE001 - what comes later is printed, whatever this is
            self._reason = f"nothing heard, and the search for gateways failed: {error}"

    def _why_silent(self, sources: Sequence[SourceReport], client: GatewayClient) -> str:
        """Return what the sources do; raise QueryError if they do not have the component or the tool."""
        component = self._request.component or ""
        key, _, label = component.partition("/")
        existing = dict.fromkeys(key for source in sources for key in source.components)
        if key in COMPONENTS_BY_KEY and key not in existing and all(source.streams for source in sources):
            raise QueryError(
                f"no {key} from {', '.join(source.name for source in sources[:_MAX_NAMED])}; accepted for "
                f"--component: {join_or((*existing, 'status', 'clock', 'parameters'))}",
                code="no-gateway",
            )
        tool_poses = ""
        if label:
            self._check_tool(label, client)
            tool_poses = f"; poses of single tools need {self._output}.tool_poses: true in the configuration"
        what = f" of {safe_text(component)}" if component else ""
        shown = ", ".join(
            f"{source.name}: {source.problem or source.text}" for source in sources[:_MAX_NAMED]
        )
        return f"nothing heard{what} although a gateway runs ({shown}){tool_poses}"

    def _check_tool(self, label: str, client: GatewayClient) -> None:
        """Raise QueryError if the labels of the sources' tools are known, and none is ``label``."""
        labels: dict[str, None] = {}
        for reply in client.parameters(self._request.source, ("6d",)).received:
            try:
                parameters = parse_parameters(reply.content).parameters
            except ParametersError:
                return
            num_tools = 0 if parameters.tools is None else len(parameters.tools.tools)
            labels |= dict.fromkeys(describe(ComponentType.TOOLS, parameters, num_tools).labels)
        channels = {lcm_channel("", "", each) for each in labels} if self._output == "lcm" else ()
        if labels and label not in {"*", *labels} and lcm_channel("", "", label) not in channels:
            shown = ", ".join(map(safe_text, list(labels)[:_MAX_NAMED]))
            shown += ", …" if len(labels) > _MAX_NAMED else ""
            raise QueryError(
                f"no gateway has a tool {quoted(label)}; tools found: {shown}", code="no-gateway"
            )
