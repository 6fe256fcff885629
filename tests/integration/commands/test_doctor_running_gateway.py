"""What the doctor learns from a running gateway, and how it treats a server that the gateway uses."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

from gateway.config.settings import MetricsSettings
from gateway.daemon.gateway import Gateway
from gateway.outputs.findings import Finding, Result
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.runtime.losses import counts_text
from gateway.session.state import StreamState
from gateway.tools.doctor.all_checks import run_checks
from tests.support import servers
from tests.support.commands import run
from tests.support.configurations import make_settings
from tests.support.errors import names
from tests.support.findings import MARKERS_XML, Findings, lab, parameters, replying, run_doctor, streaming
from tests.support.gateways import monitored_gateway
from tests.support.networks import free_port
from tests.support.servers import ScriptedServer, markers_frame, packet
from tests.support.waiting import wait_until_async

GATEWAY = "running gateway"
STREAM = "lab (3d 6d analog force event)"
XML = parameters(MARKERS_XML.format(100))
GOOD = markers_frame(1, (1.0, 2.0, 3.0))
BAD = packet(3, GOOD[8:-4])


def stream_markers(refused: str = "-") -> servers.Script:
    return streaming(XML, lambda number: markers_frame(number, (1.0, 2.0, 3.0)), refused=refused)


def settings(metrics: MetricsSettings, port: int, host: str = "127.0.0.1") -> Any:
    lcm, zenoh = LcmSettings(url="memq://"), ZenohSettings(enabled=False)
    return make_settings(sources=(lab(port, host=host),), zenoh=zenoh, lcm=lcm, metrics=metrics)


def is_streaming(status: Any) -> bool:
    return status.state is StreamState.STREAMING


@asynccontextmanager
async def running_gateway(
    port: int, condition: Callable[[Any], object] = is_streaming
) -> AsyncIterator[MetricsSettings]:
    """Run a gateway for a server; yield where its health page is, when the state of its stream is so."""
    metrics = MetricsSettings(port=free_port())
    async with monitored_gateway(Gateway(settings(metrics, port))) as gateway:
        await gateway.opened.wait()
        await wait_until_async(lambda: condition(gateway.sources[0].statuses[0]))
        yield metrics


async def test_the_state_of_each_stream_and_output_is_read_from_the_running_gateway() -> None:
    async with (
        ScriptedServer(stream_markers(refused="Version")) as server,
        running_gateway(server.port) as metrics,
    ):
        findings = await run_doctor(lab(server.port), metrics=metrics)
    health = f"a gateway answers on 127.0.0.1:{metrics.port}"
    nothing = "nothing has been lost since the gateway started"
    assert findings.of("health", GATEWAY) == Finding(GATEWAY, "health", Result.PASSING, health)
    assert findings.of("loss", GATEWAY) == Finding(GATEWAY, "loss", Result.PASSING, nothing)
    stream, limitation = findings.all_of("stream", GATEWAY)
    assert stream.result is Result.PASSING
    assert stream.found.startswith(f"{STREAM}: streaming, ")
    assert f" Hz from 127.0.0.1:{server.port}; " in stream.found
    refusal = f"{STREAM}: the server refused Version 1.0: err-unknown command"
    assert (limitation.result, limitation.found) == (Result.NOTE, refusal)
    assert findings.of("output", GATEWAY).found == "lcm: connected"


async def test_what_the_running_gateway_lost_is_reported_by_cause() -> None:
    """The doctor has a connection of its own, on which it sees the same. Only the gateway knows the total."""
    async with (
        ScriptedServer(replying(XML, GOOD, BAD, BAD)) as server,
        running_gateway(server.port, lambda status: status.losses.frames("frame rejected") == 2) as metrics,
    ):
        findings = await run_doctor(lab(server.port), metrics=metrics, connects=False)
    loss = findings.of("loss", GATEWAY)
    assert loss.result is Result.WARNING
    assert loss.found.startswith(f"{STREAM}: ")
    assert loss.found.count(counts_text([("frame rejected", 2, 2)])) == 2  # of a minute, and in all
    assert names(loss.remedy, "component 1 of 1")
    assert findings.failing(GATEWAY) == []


async def test_a_problem_of_the_running_gateway_fails() -> None:
    port = free_port()
    async with running_gateway(port, lambda status: status.last_error) as metrics:
        findings = await run_doctor(lab(port), metrics=metrics, connects=False)
        with_connection = await run_doctor(lab(port), metrics=metrics)
    stream = findings.of("stream", GATEWAY)
    assert stream.result is Result.FAILING
    assert names(stream.found, f"127.0.0.1:{port}")
    assert names(stream.remedy, "--no-connect")
    assert names(with_connection.of("stream", GATEWAY).remedy, "lab")
    assert with_connection.all_of("connection") == []  # the gateway has none either


async def test_a_measurement_that_does_not_run_fails_without_a_connection() -> None:
    async with (
        ScriptedServer(replying(XML, packet(4))) as server,
        running_gateway(server.port, lambda status: status.state is StreamState.NO_MEASUREMENT) as metrics,
    ):
        findings = await run_doctor(lab(server.port), metrics=metrics, connects=False)
    assert findings.of("stream", GATEWAY).result is Result.FAILING
    assert names(findings.of("stream", GATEWAY).found, "no measurement")


async def command(metrics: MetricsSettings, *arguments: str) -> tuple[int, Findings, str]:
    """Return exit status, findings and stderr of rtc3d-gateway doctor --json."""
    done = await run(
        *("doctor", "--json", "--seconds", "0.3", *arguments),
        environ={
            "RTC3D_GATEWAY__ZENOH__ENABLED": "false",
            "RTC3D_GATEWAY__LCM__URL": "memq://",
            "RTC3D_GATEWAY__METRICS__HOST": "0.0.0.0",  # noqa: S104
            "RTC3D_GATEWAY__METRICS__PORT": str(metrics.port),
        },
    )
    findings = [Finding(**each) for each in json.loads(done.stdout)["findings"]]
    return done.status, Findings(findings), done.stderr


async def test_no_second_connection_is_opened_if_asked_not_to_and_one_is_announced_otherwise() -> None:
    """The gateway listens on all addresses, as in containers."""
    async with ScriptedServer(stream_markers()) as server, running_gateway(server.port) as metrics:
        address = f"127.0.0.1:{server.port}"
        findings = await run_doctor(lab(server.port), metrics=metrics, connects=False)
        status, of_command, err = await command(metrics, "--server", address, "--no-connect")
        assert server.connections == 1
        _, _, announced = await command(metrics, "--server", address)
        assert server.connections > 1
    assert findings.of("name").result is Result.PASSING
    later = ("TCP", "protocol", "parameters", "frames", "byte order", "rate", "buffer", "visibility")
    assert findings.not_tested(*later) == {"--no-connect"}
    assert findings.all_of("connection") == []
    assert findings.failing(GATEWAY) == []
    assert (status, err) == (0, "")
    assert of_command.of("health", GATEWAY).result == "green"
    assert of_command.of("stream", GATEWAY).found.startswith(f"{STREAM}: streaming")
    assert announced.count("\n") == 1
    assert names(announced, "lab", address)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
async def test_a_second_connection_is_announced_before_it_is_opened(host: str) -> None:
    """Also if the doctor's configuration has another name for the server's host than the gateway's."""
    async with ScriptedServer(stream_markers()) as server, running_gateway(server.port) as metrics:
        connections = {}
        async for finding in run_checks(settings(metrics, server.port, host), "lab.yaml", 0.1):
            if finding.subject == "lab":
                connections[finding.check] = server.connections
    assert list(connections)[:3] == ["name", "connection", "TCP"]
    assert (connections["connection"], connections["protocol"]) == (1, 2)


async def test_a_gateway_that_does_not_run_is_a_note_and_a_failure_without_connecting() -> None:
    async with ScriptedServer(stream_markers()) as server:
        nobody, source = MetricsSettings(port=free_port()), lab(server.port)
        findings = await run_doctor(source, metrics=nobody)
        unconnected = await run_doctor(source, metrics=nobody, connects=False)
        disabled = await run_doctor(source, connects=False)
    health = findings.of("health", GATEWAY)
    assert health.result is Result.NOTE
    assert names(health.found, "no gateway", f"127.0.0.1:{nobody.port}")
    assert names(health.remedy, "connections")
    unasked = findings.not_tested("stream", "output", "loss", subject=GATEWAY)
    assert len(unasked) == 1
    assert findings.of("frames").result is Result.PASSING
    assert unconnected.failing(GATEWAY) == disabled.failing(GATEWAY) == ["health"]
    assert names(disabled.of("health", GATEWAY).found, "metrics.enabled")


@pytest.mark.parametrize(
    "page", [b"HTTP/1.0 200 OK\r\n\r\nhello", b"HTTP/1.0 404 Not Found\r\n\r\n[]", b"SSH-2.0-OpenSSH_9.6\r\n"]
)
async def test_another_program_on_the_port_fails(page: bytes) -> None:
    async def answer(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(page)
        writer.close()

    async with await asyncio.start_server(answer, "127.0.0.1", 0) as other:
        port = other.sockets[0].getsockname()[1]
        health = (await run_doctor(lab(free_port()), metrics=MetricsSettings(port=port))).of(
            "health", GATEWAY
        )
    assert health.result is Result.FAILING
    assert f"127.0.0.1:{port}" in health.found
    assert names(health.remedy, "metrics.port")


async def test_a_source_that_the_running_gateway_does_not_have_is_a_warning() -> None:
    async with ScriptedServer(stream_markers()) as server, running_gateway(server.port) as metrics:
        other = lab(server.port).model_copy(update={"name": "hall"})
        warning, *_ = (await run_doctor(other, metrics=metrics, connects=False)).all_of("stream", GATEWAY)
    assert warning.result is Result.WARNING
    assert names(warning.found, "hall")
