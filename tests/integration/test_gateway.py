"""A whole gateway that publishes into memory, against servers with deviations from the field notes."""

import asyncio
import logging
import re
import struct
from itertools import pairwise

import numpy as np
import pytest
import rtc3d

from gateway.config.settings import StreamSettings
from gateway.rtc3d.commands import FrequencyDivisor
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.losses import amounts
from tests.memory_gateway import run_gateway
from tests.servers import Client, ScriptedServer, error, markers_frame, ok, packet

FRAME = markers_frame(7, (1.0, 2.0, 3.0))
XML = packet(2, "<RT_Parameters Ver='1.00'><The_3D><Frequency>100</Frequency></The_3D></RT_Parameters>")


def accept(command: str) -> bytes:
    """Reply as a server that accepts every command and sends one frame after StreamFrames."""
    if command.startswith("SendParameters"):
        return XML
    if command.startswith("StreamFrames"):
        return ok(f"OK-{command}") + FRAME
    return ok(f"OK-{command}")


async def test_every_component_of_the_simulator_is_published() -> None:
    scene = SyntheticScene(markers=5, tools=1, analog=3, plates=1, rate_hz=200, analog_rate_hz=200)
    async with Simulator(scene) as simulator, run_gateway(simulator.port) as gateway:
        for component, field, count in (
            ("3d", "num_markers", 5),
            ("6d", "num_tools", 1),
            ("analog", "num_channels", 3),
            ("force", "num_plates", 1),
            ("event", "num_events", 1),
        ):
            messages = await gateway.wait_for(component)
            assert getattr(messages[0], field) == count
        markers = await gateway.wait_for("3d", 20)
        assert [message.sequence for message in markers] == list(range(len(markers)))
        assert {message.session for message in markers} == {1}
        assert gateway.status.state is StreamState.STREAMING
        assert gateway.status.byte_order == "big"
        assert gateway.status.rate == "AllFrames"


async def test_bytes_after_every_body_change_nothing_that_is_published() -> None:
    """Field note 17. The frames alternate between two layouts."""

    def extended(whole: bytes, extra: bytes) -> bytes:
        return packet(int.from_bytes(whole[4:8], "big"), whole[8:] + extra)

    frames = [markers_frame(number, *((float(number), 2.0, 3.0),) * (1 + number % 2)) for number in range(20)]

    def answer(command: str) -> bytes:
        if command.startswith("SendParameters"):
            return extended(XML, b"\n\0")
        reply = extended(ok(f"OK-{command}"), b"\n")
        if command.startswith("StreamFrames"):
            reply += b"".join(extended(each, extra) for each in frames for extra in (b"\n", b"", b"\0\0"))
        return reply

    async with (
        ScriptedServer(lambda client: client.commands(answer)) as server,
        run_gateway(server.port) as gateway,
    ):
        await gateway.wait_for("3d", 60)
        contents = [data[40:] for topic, data in gateway.output.messages if topic.path == ("3d",)]
        assert contents == [each[20:] for each in frames for _ in range(3)]
        assert "bytes after the last component of a frame are ignored" in gateway.status.limitations
        assert gateway.source.queries.parameters.known.newest is not None


async def test_each_stream_has_its_own_connection() -> None:
    scene = SyntheticScene(markers=2, tools=0, analog=2, plates=0, rate_hz=100, analog_rate_hz=1000)
    streams = (
        StreamSettings(components=(ComponentType.MARKERS,)),
        StreamSettings(components=(ComponentType.ANALOG,)),
    )
    async with Simulator(scene) as simulator, run_gateway(simulator.port, streams=streams) as gateway:
        analog = await gateway.wait_for("analog", 100)
        numbers = [message.frame_number for message in analog]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        await gateway.wait_for("3d", 5)
        assert len(simulator.connections) == 2


async def test_the_configured_rate_is_requested() -> None:
    scene = SyntheticScene(markers=1, rate_hz=200)
    stream = StreamSettings(components=(ComponentType.MARKERS,), rate=FrequencyDivisor(4))
    async with (
        Simulator(scene) as simulator,
        run_gateway(simulator.port, streams=(stream,)) as gateway,
    ):
        numbers = [message.frame_number for message in await gateway.wait_for("3d", 10)]
        assert {after - before for before, after in pairwise(numbers)} == {4}
        assert gateway.status.rate == "FrequencyDivisor:4"


async def test_little_endian_sessions_publish_the_same_messages() -> None:
    scene = SyntheticScene(markers=3, tools=1, analog=0, plates=0, rate_hz=200)
    async with (
        Simulator(scene) as simulator,
        run_gateway(simulator.port, byte_order="little") as gateway,
    ):
        for message in (await gateway.wait_for("3d", 10))[:10]:
            # A scene is a function of time; frames are numbered from 1.
            [expected] = scene.items(ComponentType.MARKERS, np.array([message.frame_number - 1]))
            assert [marker.x for marker in message.markers] == expected["x"].tolist()
        assert gateway.status.byte_order == "little"


async def test_the_gateway_sends_bye_when_it_stops() -> None:
    commands: list[str] = []

    async def script(client: Client) -> None:
        def answer(command: str) -> bytes | None:
            commands.append(command)
            return None if command == "Bye" else accept(command)

        await client.commands(answer)

    async with ScriptedServer(script) as server:
        async with run_gateway(server.port) as gateway:
            await gateway.wait_for("3d")
        await gateway.wait_until(lambda: commands[-1:] == ["Bye"])
    assert commands[:3] == ["Version 1.0", "SendParameters", "StreamFrames AllFrames"]
    assert commands[-1] == "Bye"


async def test_a_server_that_accepts_only_stream_frames_is_used() -> None:
    commands: list[str] = []

    async def script(client: Client) -> None:
        def answer(command: str) -> bytes:
            commands.append(command)
            return FRAME if command == "StreamFrames" else error("err-unknown command")

        await client.commands(answer)

    stream = StreamSettings(components=(ComponentType.MARKERS,))
    async with (
        ScriptedServer(script) as server,
        run_gateway(server.port, streams=(stream,)) as gateway,
    ):
        await gateway.wait_for("3d")
        assert commands[:5] == [
            "Version 1.0",
            "SendParameters",
            "StreamFrames AllFrames 3D",
            "StreamFrames AllFrames",
            "StreamFrames FrequencyDivisor:1",
        ]
        assert len(gateway.status.limitations) == 5
        assert "the server refused Version 1.0: err-unknown command" in gateway.status.limitations


async def test_a_limitation_is_logged_as_warning_only_for_the_first_connection(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG, "gateway.stream")

    async def script(client: Client) -> None:
        def answer(command: str) -> bytes:
            if command == "Version 1.0":
                return error("err-unknown command")
            if command.startswith("StreamFrames") and server.connections < 3:
                client.cut()
            return accept(command)

        await client.commands(answer)

    async with ScriptedServer(script) as server, run_gateway(server.port) as gateway:
        await gateway.wait_for("3d")
        assert "the server refused Version 1.0: err-unknown command" in gateway.status.limitations
    refusals = [record for record in caplog.records if "refused Version" in record.message]
    assert [record.levelname for record in refusals[:3]] == ["WARNING", "DEBUG", "DEBUG"]


async def test_a_server_that_answers_no_command_but_streams_is_used() -> None:
    async def script(client: Client) -> None:
        await client.commands(lambda command: FRAME if command.startswith("StreamFrames") else None)

    async with ScriptedServer(script) as server, run_gateway(server.port) as gateway:
        await gateway.wait_for("3d")
        assert "the server did not answer Version 1.0" in gateway.status.limitations


async def test_duplicate_acknowledgements_are_ignored() -> None:
    async def script(client: Client) -> None:
        await client.commands(lambda command: accept(command) + accept(command))

    async with (
        ScriptedServer(script) as server,
        run_gateway(server.port, byte_order="little") as gateway,
    ):
        await gateway.wait_for("3d", 2)
        assert gateway.status.session == 1


async def test_a_byte_order_that_the_server_acknowledges_and_ignores_is_detected(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def script(client: Client) -> None:
        await client.commands(accept)

    async with (
        ScriptedServer(script) as server,
        run_gateway(server.port, byte_order="little") as gateway,
    ):
        [first, *_] = await gateway.wait_for("3d")
        assert (first.markers[0].x, first.markers[0].y, first.markers[0].z) == (1.0, 2.0, 3.0)
        assert gateway.status.byte_order == "big"
    assert sum("big-endian" in record.message for record in caplog.records) == 1


async def test_components_that_were_not_requested_are_not_published() -> None:
    stream = StreamSettings(components=(ComponentType.TOOLS,))
    served = asyncio.Event()

    async def script(client: Client) -> None:
        def answer(command: str) -> bytes:
            served.set()
            return accept(command)

        await client.commands(answer)

    async with (
        ScriptedServer(script) as server,
        run_gateway(server.port, streams=(stream,)) as gateway,
    ):
        await served.wait()
        await gateway.wait_until(lambda: gateway.status.frames_in > 0)
        assert gateway.messages("3d") == []


async def test_bad_frames_are_counted_and_the_next_good_one_is_published(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG, "gateway.stream.status")

    async def script(client: Client) -> None:
        def answer(command: str) -> bytes:
            invalid = packet(3, FRAME[8:-4]) + packet(3, b"\xff" * 12) + packet(3, b"")
            return accept(command) + (invalid + markers_frame(8) if "Stream" in command else b"")

        await client.commands(answer)

    async with ScriptedServer(script) as server, run_gateway(server.port) as gateway:
        messages = await gateway.wait_for("3d", 2)
        assert [message.frame_number for message in messages] == [7, 8]
        assert amounts(gateway.status.losses.report()) == {"frame rejected": (3, 3)}
        records = [
            record
            for record in caplog.records
            if "frame rejected" in record.message and record.name == "gateway.stream.status"
        ]
        assert [record.levelname for record in records] == ["WARNING"]
        assert "frame rejected" in gateway.status.last_error


async def test_unknown_components_are_counted_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    unknown = struct.pack(">IIII", 1, 12, 9, 0)

    async def script(client: Client) -> None:
        def answer(command: str) -> bytes:
            return accept(command) + (2 * packet(3, unknown) + FRAME if "Stream" in command else b"")

        await client.commands(answer)

    async with ScriptedServer(script) as server, run_gateway(server.port) as gateway:
        await gateway.wait_for("3d", 2)
        assert amounts(gateway.status.losses.report()) == {"unknown component": (2, 2)}
    assert sum("unknown type [9]" in record.message for record in caplog.records) == 1


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "not an RTC3D server"),
        (b"SSH-2.0-OpenSSH_9.2\r\n", "not an RTC3D server"),
        (b"\0\0\0\0\0\0\0\0", "less than the header"),
        (packet(3)[:4] + b"\0\0", "the connection to"),  # ends within a header
        (b"\0\xff\0\0\0\0\0\3" + b"x" * 50, "the connection to"),  # ends within a body
        (b"", "the connection to"),
    ],
)
async def test_after_invalid_data_the_gateway_reconnects_and_streams(data: bytes, reason: str) -> None:
    async def script(client: Client) -> None:
        if server.connections == 1:
            client.send(data)
        else:
            await client.commands(accept)

    async with ScriptedServer(script) as server, run_gateway(server.port) as gateway:
        [message, *_] = await gateway.wait_for("3d")
        assert reason in gateway.status.last_error
        assert str(server.port) in gateway.status.last_error
        assert (message.session, message.sequence) == (gateway.status.session, 0)
        assert gateway.status.reconnects >= 1


async def test_the_gateway_retries_until_the_server_is_started() -> None:
    async with ScriptedServer(lambda client: client.commands(accept)) as stopped:
        port = stopped.port
    async with run_gateway(port) as gateway:
        await gateway.wait_until(lambda: gateway.status.reconnects >= 2)
        assert f"refused by 127.0.0.1:{port}" in gateway.status.last_error
        async with ScriptedServer(lambda client: client.commands(accept), port):
            await gateway.wait_for("3d")


async def test_the_error_for_an_unknown_host_contains_its_name() -> None:
    async with run_gateway(3020, host="no-such-host.invalid") as gateway:
        await gateway.wait_until(lambda: bool(gateway.status.last_error))
        assert "'no-such-host.invalid' is not known" in gateway.status.last_error


async def test_silence_during_a_measurement_ends_the_connection() -> None:
    async def script(client: Client) -> None:
        await client.commands(lambda command: accept(command) if server.connections < 3 else None)

    async with (
        ScriptedServer(script) as server,
        run_gateway(server.port, stall_timeout_s=0.4) as gateway,
    ):
        messages = await gateway.wait_for("3d", 2)
        assert [message.session for message in messages] == [1, 2]
        assert [message.sequence for message in messages] == [0, 1]
        assert "although a measurement runs" in gateway.status.last_error


async def test_silence_without_a_measurement_is_accepted_if_the_server_answers() -> None:
    probed = asyncio.Event()

    async def script(client: Client) -> None:
        commands: list[str] = []

        def answer(command: str) -> bytes:
            commands.append(command)
            if commands.count("Version 1.0") == 3:
                probed.set()
            return packet(4) if command.startswith("StreamFrames") else accept(command)

        await client.commands(answer)

    async with (
        ScriptedServer(script) as server,
        run_gateway(server.port, stall_timeout_s=0.3) as gateway,
    ):
        await probed.wait()
        assert gateway.status.state is StreamState.NO_MEASUREMENT
        assert server.connections == 1


async def test_silence_without_a_measurement_and_without_answers_ends_the_connection() -> None:
    async def script(client: Client) -> None:
        streaming = False

        def answer(command: str) -> bytes | None:
            nonlocal streaming
            if streaming:
                return None
            streaming = command.startswith("StreamFrames")
            return packet(4) if streaming else accept(command)

        await client.commands(answer)

    async with (
        ScriptedServer(script) as server,
        run_gateway(server.port, stall_timeout_s=0.3) as gateway,
    ):
        await gateway.wait_until(lambda: server.connections >= 2)
        assert "sends no frames" in gateway.status.last_error


async def test_a_measurement_that_starts_later_is_streamed() -> None:
    scene = SyntheticScene(markers=1, rate_hz=200)
    async with Simulator(scene) as simulator:
        simulator.stop_measurement()
        async with run_gateway(simulator.port) as gateway:
            await gateway.wait_until(lambda: gateway.status.state is StreamState.NO_MEASUREMENT)
            simulator.start_measurement()
            await gateway.wait_for("3d", 5)
            assert gateway.status.session == 1


async def test_the_status_describes_streams_and_outputs() -> None:
    async def script(client: Client) -> None:
        await client.commands(accept)

    async with (
        ScriptedServer(script) as server,
        run_gateway(server.port, stall_timeout_s=60) as gateway,
    ):
        await gateway.wait_for("3d")
        [status, *_] = await gateway.wait_for("status")
        assert isinstance(status, rtc3d.status_t)
        assert (status.source, status.server) == ("lab", f"127.0.0.1:{server.port}")
        [stream] = status.streams
        assert stream.components == " ".join(component.key for component in WIRE_ORDER)
        assert (stream.frames_in, stream.session, stream.reconnects) == (1, 1, 0)
        [output] = status.outputs
        assert (output.name, output.connected) == ("memory", True)
        assert [(count.name, count.count) for count in output.messages] == [("3d", 1)]


async def test_a_failure_is_logged_once_and_so_is_its_end(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    async with ScriptedServer(lambda client: client.commands(accept)) as stopped:
        port = stopped.port
    async with run_gateway(port) as gateway:
        await gateway.wait_until(lambda: gateway.status.reconnects >= 3)
        async with Simulator(SyntheticScene(), port=port):
            # The recovery is logged once it has lasted for a while.
            await gateway.wait_until(lambda: any("streaming again" in text for text in caplog.messages))
    refused = [record for record in caplog.records if "refused by" in record.message]
    assert [record.levelname for record in refused[:3]] == ["WARNING", "DEBUG", "DEBUG"]
    [recovered] = [record for record in caplog.records if "streaming again" in record.message]
    assert recovered.levelname == "INFO"
    assert re.search(r"after \d+\.\d s and \d+ failures?$", recovered.message)
