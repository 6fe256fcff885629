"""What the doctor learns from a running gateway, and how it treats a server that the gateway uses."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from gateway.config.settings import MetricsSettings, SourceSettings
from gateway.doctor.all_checks import run_checks
from gateway.findings import Finding, Result
from gateway.gateway import Gateway
from gateway.monitoring.server import MonitoringServer
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.stream.state import StreamState
from tests import servers
from tests.command_process import run
from tests.configurations import make_settings
from tests.diagnosed_servers import MARKERS_XML, parameters, replying, streaming
from tests.findings import Findings, lab, run_doctor
from tests.networks import free_port
from tests.servers import ScriptedServer, markers_frame, packet
from tests.waiting import wait_until_async

GATEWAY = "running gateway"
XML = parameters(MARKERS_XML.format(100))
GOOD = markers_frame(1, (1.0, 2.0, 3.0))


def stream_markers(refused: str = "-") -> servers.Script:
    return streaming(XML, lambda number: markers_frame(number, (1.0, 2.0, 3.0)), refused=refused)


@asynccontextmanager
async def running_gateway(source: SourceSettings) -> AsyncIterator[tuple[Gateway, MetricsSettings]]:
    """Run a gateway for ``source``; yield it, and where its health page is."""
    metrics = MetricsSettings(port=free_port())
    settings = make_settings(
        sources=(source,),
        zenoh=ZenohSettings(enabled=False),
        lcm=LcmSettings(url="memq://"),
        metrics=metrics,
    )
    gateway = Gateway(settings)
    monitoring = MonitoringServer(metrics, gateway)
    stop = asyncio.Event()
    task = asyncio.create_task(gateway.run(stop))
    await monitoring.start()
    try:
        await gateway.opened.wait()
        yield gateway, metrics
    finally:
        await monitoring.close()
        stop.set()
        await task


async def streaming_gateway(gateway: Gateway) -> None:
    """Wait until the gateway streams."""
    await wait_until_async(lambda: gateway.sources[0].statuses[0].state is StreamState.STREAMING)


async def test_the_state_of_each_stream_and_output_is_read_from_the_running_gateway() -> None:
    async with (
        ScriptedServer(stream_markers(refused="Version")) as server,
        running_gateway(lab(server.port)) as (gateway, metrics),
    ):
        await streaming_gateway(gateway)
        findings = await run_doctor(lab(server.port), metrics=metrics)
    assert findings.of("health", GATEWAY) == Finding(
        GATEWAY, "health", Result.PASSING, f"a gateway answers on 127.0.0.1:{metrics.port}"
    )
    name = "lab (3d 6d analog force event)"
    stream, limitation = findings.all_of("stream", GATEWAY)
    assert stream.result is Result.PASSING
    assert stream.found.startswith(f"{name}: streaming, ")
    assert f" Hz from 127.0.0.1:{server.port}; " in stream.found
    assert limitation.result is Result.NOTE
    assert limitation.found == f"{name}: the server refused Version 1.0: err-unknown command"
    assert findings.of("output", GATEWAY).found == "lcm: connected"
    assert findings.of("loss", GATEWAY) == Finding(
        GATEWAY, "loss", Result.PASSING, "nothing has been lost since the gateway started"
    )


async def test_what_the_running_gateway_lost_is_reported_by_cause() -> None:
    """The doctor has a connection of its own, on which it sees the same. Only the gateway knows the total."""
    script = replying(XML, GOOD, packet(3, GOOD[8:-4]), packet(3, GOOD[8:-4]))
    async with ScriptedServer(script) as server, running_gateway(lab(server.port)) as (gateway, metrics):
        await wait_until_async(lambda: gateway.sources[0].statuses[0].losses.frames("frame rejected") == 2)
        findings = await run_doctor(lab(server.port), metrics=metrics, connects=False)
    loss = findings.of("loss", GATEWAY)
    assert loss.result is Result.WARNING
    assert loss.found == (
        "lab (3d 6d analog force event): lost in the last minute: 2 messages of 2 frames (frame rejected); "
        "since the start: 2 messages of 2 frames (frame rejected)"
    )
    assert loss.remedy.startswith("The newest was: frame rejected: component 1 of 1")
    assert findings.failing(GATEWAY) == []


async def test_a_problem_of_the_running_gateway_fails() -> None:
    port = free_port()
    async with running_gateway(lab(port)) as (gateway, metrics):
        await wait_until_async(lambda: gateway.sources[0].statuses[0].last_error != "")
        findings = await run_doctor(lab(port), metrics=metrics, connects=False)
        with_connection = await run_doctor(lab(port), metrics=metrics)
    assert findings.of("stream", GATEWAY).result is Result.FAILING
    assert f"no frame so far: connection refused by 127.0.0.1:{port}" in findings.of("stream", GATEWAY).found
    assert findings.of("stream", GATEWAY).remedy == (
        "Check the server and the network. Without --no-connect, doctor looks for the reason."
    )
    assert with_connection.of("stream", GATEWAY).remedy == "The checks of lab below look for the reason."
    assert with_connection.all_of("connection") == []  # the gateway has none either


async def test_a_measurement_that_does_not_run_fails_without_a_connection() -> None:
    script = replying(XML, packet(4))
    async with ScriptedServer(script) as server, running_gateway(lab(server.port)) as (gateway, metrics):
        await wait_until_async(lambda: gateway.sources[0].statuses[0].state is StreamState.NO_MEASUREMENT)
        findings = await run_doctor(lab(server.port), metrics=metrics, connects=False)
    assert findings.of("stream", GATEWAY).result is Result.FAILING
    assert "reports that no measurement is running" in findings.of("stream", GATEWAY).found


async def test_without_connecting_no_connection_is_opened() -> None:
    async with (
        ScriptedServer(stream_markers()) as server,
        running_gateway(lab(server.port)) as (gateway, metrics),
    ):
        await streaming_gateway(gateway)
        findings = await run_doctor(lab(server.port), metrics=metrics, connects=False)
    assert server.connections == 1
    assert findings.of("name").result is Result.PASSING
    later = ("TCP", "protocol", "parameters", "frames", "byte order", "rate", "buffer", "visibility")
    assert findings.not_tested(*later) == {"--no-connect"}
    assert findings.all_of("connection") == []
    assert findings.failing(GATEWAY) == []


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
async def test_a_second_connection_is_announced_before_it_is_opened(host: str) -> None:
    """Also if the doctor's configuration has another name for the server's host than the gateway's."""
    async with (
        ScriptedServer(stream_markers()) as server,
        running_gateway(lab(server.port)) as (gateway, metrics),
    ):
        await streaming_gateway(gateway)
        settings = make_settings(
            sources=(lab(server.port, host=host),),
            zenoh=ZenohSettings(enabled=False),
            lcm=LcmSettings(url="memq://"),
            metrics=metrics,
        )
        connections = {}
        async for finding in run_checks(settings, "lab.yaml", 0.1):
            if finding.subject == "lab":
                connections[finding.check] = server.connections
    assert list(connections)[:3] == ["name", "connection", "TCP"]
    assert (connections["connection"], connections["protocol"]) == (1, 2)


async def test_a_gateway_that_does_not_run_is_a_note() -> None:
    async with ScriptedServer(stream_markers()) as server:
        port = free_port()
        findings = await run_doctor(lab(server.port), metrics=MetricsSettings(port=port))
    assert findings.of("health", GATEWAY).result is Result.NOTE
    assert findings.of("health", GATEWAY).found == (
        f"no gateway runs here: nothing listens on 127.0.0.1:{port}"
    )
    assert "connections of their own to the servers" in findings.of("health", GATEWAY).remedy
    assert findings.not_tested("stream", "output", "loss", subject=GATEWAY) == {
        "no running gateway could be asked"
    }
    assert findings.of("frames").result is Result.PASSING


async def test_without_connecting_and_without_a_gateway_nothing_can_be_found_out() -> None:
    findings = await run_doctor(lab(free_port()), metrics=MetricsSettings(port=free_port()), connects=False)
    assert findings.failing(GATEWAY) == ["health"]
    findings = await run_doctor(lab(free_port()), connects=False)
    assert findings.of("health", GATEWAY).found == (
        "metrics.enabled is false, so a running gateway cannot be asked"
    )
    assert findings.failing(GATEWAY) == ["health"]


@pytest.mark.parametrize(
    "page", [b"HTTP/1.0 200 OK\r\n\r\nhello", b"HTTP/1.0 404 Not Found\r\n\r\n[]", b"SSH-2.0-OpenSSH_9.6\r\n"]
)
async def test_another_program_on_the_port_fails(page: bytes) -> None:
    async def answer(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(page)
        writer.close()

    async with await asyncio.start_server(answer, "127.0.0.1", 0) as other:
        port = other.sockets[0].getsockname()[1]
        findings = await run_doctor(lab(free_port()), metrics=MetricsSettings(port=port))
    assert findings.of("health", GATEWAY).result is Result.FAILING
    assert f"127.0.0.1:{port}" in findings.of("health", GATEWAY).found
    assert findings.of("health", GATEWAY).remedy.endswith("If it is another program, set metrics.port.")


async def test_a_source_that_the_running_gateway_does_not_have_is_a_warning() -> None:
    async with ScriptedServer(stream_markers()) as server, running_gateway(lab(server.port)) as (_, metrics):
        other = SourceSettings(name="hall", host="127.0.0.1", port=server.port)
        findings = await run_doctor(other, metrics=metrics, connects=False)
    warning, *_ = findings.all_of("stream", GATEWAY)
    assert (warning.result, warning.found) == (
        Result.WARNING,
        "hall: the running gateway has no source of this name",
    )


async def command(metrics: MetricsSettings, *arguments: str) -> tuple[int, Findings, str]:
    """Return exit status, findings and stderr of rtc3d-gateway doctor --json."""
    done = await run(
        *("doctor", "--json", "--seconds", "0.3", *arguments),
        environ={
            "RTC3D_GATEWAY__ZENOH__ENABLED": "false",
            "RTC3D_GATEWAY__LCM__URL": "memq://",
            "RTC3D_GATEWAY__METRICS__ADDRESS": "0.0.0.0",  # noqa: S104
            "RTC3D_GATEWAY__METRICS__PORT": str(metrics.port),
        },
    )
    findings = [Finding(**each) for each in json.loads(done.stdout)["findings"]]
    return done.status, Findings(findings), done.stderr


async def test_the_command_opens_no_connection_if_asked_not_to() -> None:
    """The gateway listens on all addresses, as in containers."""
    async with (
        ScriptedServer(stream_markers()) as server,
        running_gateway(lab(server.port)) as (gateway, metrics),
    ):
        await streaming_gateway(gateway)
        status, findings, err = await command(metrics, "--server", f"127.0.0.1:{server.port}", "--no-connect")
    assert server.connections == 1
    assert (status, err) == (0, "")
    assert findings.of("health", GATEWAY).result == "green"
    assert findings.of("stream", GATEWAY).found.startswith("lab (3d 6d analog force event): streaming")


async def test_the_command_announces_a_second_connection_on_stderr_with_json() -> None:
    async with (
        ScriptedServer(stream_markers()) as server,
        running_gateway(lab(server.port)) as (gateway, metrics),
    ):
        await streaming_gateway(gateway)
        _, _, err = await command(metrics, "--server", f"127.0.0.1:{server.port}")
    assert err == (
        f"lab: the running gateway is connected to 127.0.0.1:{server.port}; doctor now opens further "
        "connections to it\n"
    )
