"""Why ``echo`` hears nothing: what it is asked for does not exist, or nothing is sent."""

import sys
import threading
import time
from collections.abc import Sequence
from typing import Final

from gateway.cli.echo_units import OUTPUTS, query_parameters
from gateway.cli.find_sources import find_sources
from gateway.cli.found_sources import FoundSource, FoundSources
from gateway.config.words import join_or
from gateway.descriptions.labels import describe
from gateway.errors import OutputError, ParametersError, QueryError
from gateway.messages.topics import lcm_channel
from gateway.outputs.kind import SubscriptionRequest
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.safe_text import quoted, safe_lines, safe_text
from gateway.stream.status_text import source_text

LOOK_S: Final = 0.4
"""How long nothing is heard before this looks for what exists."""

SAY_S: Final = 2.0
"""How long nothing is heard before this is said."""

_MAX_NAMED: Final = 20


class Silence:
    """Finds out in a thread of its own why nothing is heard on an output, and says it once."""

    def __init__(self, output: str, request: SubscriptionRequest) -> None:
        self._output = output
        self._request = request
        self._start_s = time.monotonic()
        self._thread: threading.Thread | None = None
        self._error: QueryError | None = None
        self._reason = ""
        self._is_said = False

    def check(self) -> None:
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
            found, absence = find_sources(self._output, self._request)
            if absence and found.heard:
                self._error = QueryError(absence, code="no-gateway")
            else:
                self._reason = absence or self._why_silent(found)
        except QueryError as error:
            self._error = error
        except OutputError as error:
            self._reason = str(error)
        except Exception as error:  # noqa: BLE001 - what comes later is printed, whatever this is
            self._reason = f"nothing heard, and the search for gateways failed: {error}"

    def _why_silent(self, found: FoundSources) -> str:
        """Return what the sources do; raise QueryError if they do not have the component."""
        component = self._request.component or ""
        key, _, label = component.partition("/")
        if all(source.streams for source in found.sources):
            _check_component(key, found.sources)
        tool_poses = ""
        if label:
            self._check_tool(label)
            tool_poses = f"; poses of single tools need {self._output}.tool_poses: true in the configuration"
        what = f" of {safe_text(component)}" if component else ""
        shown = ", ".join(f"{source.name}: {_state(source)}" for source in found.sources[:_MAX_NAMED])
        return f"nothing heard{what} although a gateway runs ({shown}){tool_poses}"

    def _check_tool(self, label: str) -> None:
        labels = self._tool_labels()
        if not labels or label == "*" or any(self._is_same(label, each) for each in labels):
            return
        shown = ", ".join(map(safe_text, labels[:_MAX_NAMED])) + (", …" if len(labels) > _MAX_NAMED else "")
        raise QueryError(f"no gateway has a tool {quoted(label)}; tools found: {shown}", code="no-gateway")

    def _is_same(self, label: str, other: str) -> bool:
        return label == other or (
            self._output == "lcm" and lcm_channel("", "", label) == lcm_channel("", "", other)
        )

    def _tool_labels(self) -> list[str]:
        """Return the labels of the tools of the sources, each once; [] if they are not known."""
        labels: dict[str, None] = {}
        for reply in query_parameters(self._output, self._request, self._request.source, ("6d",)).received:
            try:
                parameters = parse_parameters(reply.xml).parameters
            except ParametersError:
                return []
            num_tools = 0 if parameters.tools is None else len(parameters.tools.tools)
            labels |= dict.fromkeys(describe(ComponentType.TOOLS, parameters, num_tools).labels)
        return list(labels)


def _check_component(key: str, sources: Sequence[FoundSource]) -> None:
    """Raise QueryError if ``key`` is a component of measured data, and no source has it."""
    existing = list(dict.fromkeys(key for source in sources for key in source.components))
    if key in COMPONENTS_BY_KEY and key not in existing:
        names = [source.name for source in sources[:_MAX_NAMED]]
        raise QueryError(
            f"no {key} from {', '.join(names)}; accepted for --component: "
            f"{join_or((*existing, 'status', 'clock', 'parameters'))}",
            code="no-gateway",
        )


def _state(source: FoundSource) -> str:
    return source.problem or source_text([(stream.components, stream.text) for stream in source.streams])
