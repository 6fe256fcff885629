"""The doctor's checks of LSL: is a stream found, and are those of a running gateway?"""

import json
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any, Final

from gateway.errors import ConfigError, OutputError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.outputs.adapters.lsl.output import LslOutput
from gateway.outputs.adapters.lsl.settings import LSL, LslSettings
from gateway.outputs.adapters.lsl.supervisor import lsl_environment
from gateway.outputs.contract import ServerParameters
from gateway.outputs.findings import Check, Finding, MessageLoad, failing_first
from gateway.rtc3d.parameters import Parameters, ParametersEvents
from gateway.runtime.safe_text import safe_text

_TEST_SOURCE: Final = "doctor"
_POLL_S: Final = 0.05
_MIN_SEARCH_S: Final = 2.0
_START_S: Final = 10.0

_OPENS, _FOUND, _GATEWAY = (Check("lsl", name) for name in LSL.checks)


def check_lsl(
    settings: LslSettings, sources: Sequence[str], _loads: Sequence[MessageLoad], seconds: float
) -> list[Finding]:
    """Open a stream and find it and those of ``sources``. Blocks for about ``seconds``."""
    try:
        output = LslOutput(settings)
    except ConfigError as error:
        return _not_open(str(error))
    try:
        publisher = output.frame_publisher(_TEST_SOURCE)
        output.start()
        deadline_s = time.monotonic() + seconds
        while not output.health().connected and time.monotonic() < deadline_s:
            time.sleep(_POLL_S)
        problem = output.health().problem
        if problem:
            return _not_open(problem)
        parameters = Parameters(events=ParametersEvents())
        output.publish_parameters(
            _TEST_SOURCE, ServerParameters(b"", 1, 1, parsed=parameters, frame=CoordinateFrame(_TEST_SOURCE))
        )
        opens = _OPENS.passing(f"liblsl {output.version} opens streams")
        try:
            streams = _find_streams(settings, max(seconds / 2, _MIN_SEARCH_S))
        except OutputError as error:
            failing = _FOUND.failing(str(error), "Check lsl.config, or the file lsl_api.cfg.")
            return [opens, *failing_first(failing, ["gateway"])]
        publisher.close()
    finally:
        output.close()
    names = {(stream["computer"], stream["name"]) for stream in streams}
    others = {computer for computer, _ in names} - {socket.gethostname()}
    also = f", and streams of {len(others)} other computers" if others else ""
    found = _FOUND.passing(f"another program on this computer finds a stream{also}")
    if (socket.gethostname(), f"{_TEST_SOURCE}_event") not in names:
        found = _FOUND.failing(
            "another program on this computer does not find a stream",
            "Allow UDP port 16571 and the ports from 16572 in the firewall, and see docs/how-to/lsl.md.",
        )
    return [opens, found, _gateway(names, sources)]


def _find_streams(settings: LslSettings, seconds: float) -> list[dict[str, Any]]:
    """Return the streams that can be found within ``seconds``, by another process. Raises OutputError.

    See process.py for what each has.
    """
    command = [sys.executable, "-m", "gateway.outputs.adapters.lsl.process", str(seconds)]
    try:
        result = subprocess.run(  # noqa: S603 - our own module
            command,
            env=lsl_environment(settings),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=seconds + _START_S,
            check=True,
        )
    except subprocess.TimeoutExpired:
        raise OutputError("liblsl does not finish its search for streams", cause="not open") from None
    except subprocess.CalledProcessError as error:
        last_line = error.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise OutputError(
            f"liblsl cannot search for streams: {safe_text(last_line, 200)}", cause="not open"
        ) from None
    found: list[dict[str, Any]] = json.loads(result.stdout)
    return found


def _not_open(problem: str) -> list[Finding]:
    return failing_first(_OPENS.problem(problem, "Correct lsl in the configuration."), LSL.checks[1:])


def _gateway(names: set[tuple[str, str]], sources: Sequence[str]) -> Finding:
    found = {name.rpartition("_")[0] for _, name in names}  # names are SOURCE_COMPONENT
    served = [source for source in sources if source in found]
    missing = [source for source in sources if source not in served]
    if not served:
        return _GATEWAY.note("no gateway offers streams of these sources now", "Start the gateway.")
    if missing:
        return _GATEWAY.warning(
            f"streams of {', '.join(served)} are offered, but none of {', '.join(missing)}",
            "Streams appear when the server has sent its parameters or a frame.",
        )
    return _GATEWAY.passing(f"streams of {', '.join(served)} are offered")
