"""Runs the doctor in tests, with scripted servers, Zenoh and LCM on this machine only."""

import asyncio
import math
import re
import struct
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

from gateway.config.settings import MetricsSettings, SourceSettings, StreamSettings
from gateway.outputs.findings import Finding, Result
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.tools.doctor.all_checks import run_checks
from tests.support import servers
from tests.support.configurations import make_settings
from tests.support.errors import names
from tests.support.servers import Client, ScriptedServer, ok, packet

SECONDS = 0.3


class Findings:
    """The doctor's findings, by subject and check."""

    def __init__(self, findings: list[Finding]) -> None:
        self.all = findings

    def of(self, check: str, subject: str = "lab") -> Finding:
        [finding] = self.all_of(check, subject)
        return finding

    def all_of(self, check: str, subject: str = "lab") -> list[Finding]:
        return [each for each in self.all if (each.subject, each.check) == (subject, check)]

    def failing(self, subject: str = "lab") -> list[str]:
        return [each.check for each in self.all if each.subject == subject and each.result is Result.FAILING]

    def not_tested(self, *checks: str, subject: str = "lab") -> set[str]:
        """Return why these checks were not made."""
        findings = [self.of(check, subject) for check in checks]
        assert {finding.result for finding in findings} == {Result.NOT_TESTED}
        return {finding.found for finding in findings}


async def run_doctor(
    *sources: SourceSettings,
    metrics: MetricsSettings | None = None,
    seconds: float = SECONDS,
    connects: bool = True,
) -> Findings:
    """Return the findings for ``sources``.

    Zenoh is disabled, LCM stays in memory, and by default no running gateway is asked.
    """
    settings = make_settings(
        sources=sources,
        zenoh=ZenohSettings(enabled=False),
        lcm=LcmSettings(url="memq://"),
        metrics=metrics or MetricsSettings(enabled=False),
    )
    checks = run_checks(settings, "lab.yaml", seconds, connects=connects)
    return Findings([finding async for finding in checks])


def lab(port: int, *streams: StreamSettings, **keys: Any) -> SourceSettings:
    """Return the settings of the source "lab" on this machine; ``keys`` are further settings."""
    source: dict[str, Any] = {"host": "127.0.0.1", "reply_timeout_s": 60.0, "connect_timeout_s": 60.0}
    source["streams"] = streams or (StreamSettings(),)
    return SourceSettings(name="lab", port=port, **(source | keys))


# Servers.

PERIOD_S: Final = 0.01
"""The period of the frames."""

MARKERS_XML = (
    "<The_3D><Frequency>{}</Frequency><Markers><Marker id='1'><Label>hip</Label></Marker>"
    "<Marker id='2'><Label>knee</Label></Marker></Markers></The_3D>"
)
TOOLS_XML = (
    "<The_6D><Frequency>100</Frequency><Tools><Tool id='1'><Label>probe</Label></Tool></Tools></The_6D>"
)


def parameters(*sections: str) -> bytes:
    return packet(2, f"<RT_Parameters Ver='1.00'>{''.join(sections)}</RT_Parameters>")


async def diagnose(script: servers.Script, *streams: StreamSettings, **keys: Any) -> Findings:
    """Return the findings for a scripted server."""
    async with ScriptedServer(script) as server:
        return await run_doctor(lab(server.port, *streams, **keys))


def replying(xml: bytes, *frames: bytes, refused: str = "-") -> servers.Script:
    """Return a server that refuses what matches ``refused``, accepts the rest, and sends frames once."""

    async def script(client: Client) -> None:
        def answer(command: str) -> bytes:
            if re.match(refused, command):
                return servers.error("err-unknown command")
            if command.startswith("SendParameters"):
                return xml
            return ok(f"OK-{command}") + (b"".join(frames) if command.startswith("StreamFrames") else b"")

        await client.commands(answer)

    return script


def streaming(
    xml: bytes,
    frame: Callable[[int], bytes],
    step: int = 10,
    *,
    stops_after: int | None = None,
    refused: str = "-",
) -> servers.Script:
    """Return a server that sends a frame every 10 ms, and whose clock advances ``step`` ms per frame.

    It refuses what matches ``refused``. After ``stops_after`` frames, it stays silent.
    """

    async def script(client: Client) -> None:
        while not (command := await client.command()).startswith("StreamFrames"):
            if re.match(refused, command):
                client.send(servers.error("err-unknown command"))
            else:
                client.send(xml if command.startswith("SendParameters") else ok(f"OK-{command}"))
        client.send(ok(f"OK-{command}"))
        began_s = time.monotonic()
        num_sent = 0
        while not client._writer.is_closing():
            while num_sent < min((time.monotonic() - began_s) / PERIOD_S, stops_after or math.inf):
                client.send(frame(num_sent * step))
                num_sent += 1
            await asyncio.sleep(PERIOD_S)

    return script


def tools_frame(number: int, *xs: float) -> bytes:
    items = b"".join(struct.pack(">8f", 1, 0, 0, 0, x, 0, 0, 0.1) for x in xs)
    component = struct.pack(">IIiqI", 24 + len(items), 4, number, 1000 * number, len(xs)) + items
    return packet(3, struct.pack(">I", 1) + component)


def is_finding(
    finding: Finding, subject: str, name: str, result: Result, *values: object, remedy: Sequence[object] = ()
) -> bool:
    """Whether a finding has these fields, names these values, and has a remedy only if it needs one."""
    is_right = (finding.subject, finding.check, finding.result) == (subject, name, result)
    is_right &= bool(finding.remedy) == bool(remedy)
    return is_right and names(finding.found, *values) and names(finding.remedy, *remedy)
