"""A whole gateway that publishes into memory, against servers with deviations from the field notes."""

import logging
import struct
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from gateway.config.settings import StreamSettings
from gateway.rtc3d.commands import FrequencyDivisor
from gateway.rtc3d.components import ComponentType
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.losses import amounts
from tests.memory_gateway import run_gateway
from tests.servers import Client, ScriptedServer, error, markers_frame, ok, packet

FRAME = markers_frame(7, (1.0, 2.0, 3.0))
XML = packet(2, "<RT_Parameters Ver='1.00'><The_3D><Frequency>100</Frequency></The_3D></RT_Parameters>")
MARKERS = StreamSettings(components=(ComponentType.MARKERS,))
Answer = Callable[[str], bytes | None]


def accept(command: str, frames: bytes = FRAME) -> bytes:
    """Reply as a server that accepts every command and sends ``frames`` after StreamFrames."""
    if command.startswith("SendParameters"):
        return XML
    return ok(f"OK-{command}") + (frames if command.startswith("StreamFrames") else b"")


def serving(answer: Answer) -> ScriptedServer:
    return ScriptedServer(lambda client: client.commands(answer))


@pytest.mark.parametrize("byte_order", ["big", "little"])
async def test_every_component_of_the_simulator_is_published(byte_order: str) -> None:
    scene = SyntheticScene(markers=5, tools=1, analog=3, plates=1, rate_hz=200, analog_rate_hz=200)
    counts = {
        "3d": "markers 5",
        "6d": "tools 1",
        "analog": "channels 3",
        "force": "plates 1",
        "event": "events 1",
    }
    async with (
        Simulator(scene) as simulator,
        run_gateway(simulator.port, byte_order=byte_order) as gateway,
    ):
        for component, (kind, count) in ((key, text.split()) for key, text in counts.items()):
            [message, *_] = await gateway.wait_for(component)
            assert getattr(message, f"num_{kind}") == int(count)
        markers = await gateway.wait_for("3d", 20)
        assert [message.sequence for message in markers] == list(range(len(markers)))
        for message in markers:
            # A scene is a function of time; frames are numbered from 1.
            [items] = scene.items(ComponentType.MARKERS, np.array([message.frame_number - 1]))
            assert [marker.x for marker in message.markers] == items["x"].tolist()
            assert message.session == 1
        status = gateway.status
        expected = (StreamState.STREAMING, byte_order, "AllFrames")
        assert (status.state, status.byte_order, status.rate) == expected


async def test_each_stream_has_its_own_connection_and_its_configured_rate() -> None:
    scene = SyntheticScene(markers=2, tools=0, analog=2, plates=0, rate_hz=200, analog_rate_hz=1000)
    streams = (
        StreamSettings(components=(ComponentType.MARKERS,), rate=FrequencyDivisor(4)),
        StreamSettings(components=(ComponentType.ANALOG,)),
    )
    async with Simulator(scene) as simulator, run_gateway(simulator.port, streams=streams) as gateway:
        for component, step, count in (("analog", 1, 100), ("3d", 4, 10)):
            numbers = [message.frame_number for message in await gateway.wait_for(component, count)]
            assert {after - before for before, after in pairwise(numbers)} == {step}
        assert len(simulator.connections) == 2
        assert gateway.status.rate == "FrequencyDivisor:4"


async def test_bytes_after_every_body_change_nothing_that_is_published() -> None:
    """Field note 17. The frames alternate between two layouts."""

    def extended(whole: bytes, extra: bytes) -> bytes:
        return packet(int.from_bytes(whole[4:8], "big"), whole[8:] + extra)

    frames = [markers_frame(number, *((float(number), 2.0, 3.0),) * (1 + number % 2)) for number in range(20)]

    def answer(command: str) -> bytes:
        if command.startswith("SendParameters"):
            return extended(XML, b"\n\0")
        sent = b"".join(extended(each, extra) for each in frames for extra in (b"\n", b"", b"\0\0"))
        return extended(ok(f"OK-{command}"), b"\n") + (sent if command.startswith("StreamFrames") else b"")

    async with serving(answer) as server, run_gateway(server.port) as gateway:
        await gateway.wait_for("3d", 60)
        contents = [data[40:] for topic, data in gateway.output.messages if topic.path == ("3d",)]
        assert contents == [each[20:] for each in frames for _ in range(3)]
        assert "bytes after the last component of a frame are ignored" in gateway.status.limitations
        assert gateway.source.queries.parameters.known.newest is not None


def only_stream_frames(command: str) -> bytes:
    return FRAME if command == "StreamFrames" else error("err-unknown command")


def frames_only(command: str) -> bytes | None:
    return FRAME if command.startswith("StreamFrames") else None


def ignore_and_refuse(command: str) -> bytes | None:
    """Ignore Version and SendParameters; refuse all but StreamFrames without saying what is refused."""
    if command == "StreamFrames":
        return ok("fine") + FRAME
    return None if command.startswith(("Version", "SendParameters")) else error("what?")


NO_ANSWER = "the server did not answer Version 1.0"
REFUSED = "the server refused Version 1.0: err-unknown command"


@pytest.mark.parametrize(
    ("answer", "limitation"),
    [
        pytest.param(only_stream_frames, REFUSED, id="accepts only StreamFrames"),
        pytest.param(frames_only, NO_ANSWER, id="answers nothing"),
        pytest.param(ignore_and_refuse, NO_ANSWER, id="ignores and refuses without a name"),
        pytest.param(lambda text: accept(text) * 2, "", id="answers twice"),
        pytest.param(accept, "big-endian", id="ignores the byte order"),
    ],
)
async def test_a_server_with_deviations_streams(
    answer: Answer, limitation: str, caplog: pytest.LogCaptureFixture
) -> None:
    commands: list[str] = []

    def recorded(command: str) -> bytes | None:
        commands.append(command)
        return answer(command)

    reply_timeout_s = 0.3 if limitation == NO_ANSWER else 60.0
    source: dict[str, Any] = {
        "streams": (MARKERS,),
        "byte_order": "little",
        "reply_timeout_s": reply_timeout_s,
    }
    async with serving(recorded) as server, run_gateway(server.port, **source) as gateway:
        [first, *_] = await gateway.wait_for("3d")
        assert [(each.x, each.y, each.z) for each in first.markers] == [(1.0, 2.0, 3.0)]
        assert (gateway.status.byte_order, gateway.status.session, server.connections) == ("big", 1, 1)
        assert any(limitation in text for text in [*gateway.status.limitations, *caplog.messages])
        assert sum("big-endian" in text for text in caplog.messages) <= 1
        await gateway.wait_until(lambda: gateway.status.state is StreamState.STREAMING)
    if limitation == REFUSED:
        assert [command for command in commands if "ByteOrder" not in command][:5] == [
            *("Version 1.0", "SendParameters", "StreamFrames AllFrames 3D"),
            *("StreamFrames AllFrames", "StreamFrames FrequencyDivisor:1"),
        ]
        await gateway.wait_until(lambda: commands[-1] == "Bye")


async def test_bad_frames_and_unknown_components_are_counted_and_the_next_good_frame_is_published(
    caplog: pytest.LogCaptureFixture,
) -> None:
    invalid = packet(3, FRAME[8:-4]) + packet(3, b"\xff" * 12) + packet(3, b"")
    unknown = packet(3, struct.pack(">IIII", 1, 12, 9, 0))
    answer = partial(accept, frames=FRAME + invalid + 2 * unknown + markers_frame(8))
    async with serving(answer) as server, run_gateway(server.port) as gateway:
        messages = await gateway.wait_for("3d", 2)
        assert [message.frame_number for message in messages] == [7, 8]
        losses = amounts(gateway.status.losses.report())
        assert losses == {"frame rejected": (3, 3), "unknown component": (2, 2)}
        assert "frame rejected" in gateway.status.last_error
    for text in ("frame rejected", "unknown type [9]"):
        warnings = [record for record in caplog.records if text in record.message]
        assert [record.levelname for record in warnings] == ["WARNING"], text


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


async def test_the_gateway_retries_until_the_server_is_started_and_warns_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG)
    async with serving(accept) as stopped:
        port = stopped.port
    async with run_gateway(port) as gateway:
        await gateway.wait_until(lambda: gateway.status.reconnects >= 3)
        assert f"refused by 127.0.0.1:{port}" in gateway.status.last_error
        async with ScriptedServer(lambda client: client.commands(accept), port):
            await gateway.wait_for("3d")
    refused = [record for record in caplog.records if "refused by" in record.message]
    assert [record.levelname for record in refused[:3]] == ["WARNING", "DEBUG", "DEBUG"]


async def test_silence_during_a_measurement_ends_the_connection() -> None:
    async def script(client: Client) -> None:
        await client.commands(lambda command: accept(command) if server.connections < 3 else None)

    async with ScriptedServer(script) as server, run_gateway(server.port, stall_timeout_s=0.4) as gateway:
        messages = await gateway.wait_for("3d", 2)
        assert [(message.session, message.sequence) for message in messages] == [(1, 0), (2, 1)]
        assert "although a measurement runs" in gateway.status.last_error


async def test_silence_without_a_measurement_is_accepted_while_the_server_answers() -> None:
    commands: list[str] = []
    answers = True

    def answer(command: str) -> bytes | None:
        commands.append(command)
        return accept(command, frames=packet(4)) if answers else None

    timeouts = {"stall_timeout_s": 0.3, "reply_timeout_s": 1.0}
    async with serving(answer) as server, run_gateway(server.port, **timeouts) as gateway:
        await gateway.wait_until(lambda: commands.count("Version 1.0") >= 3)
        assert (gateway.status.state, server.connections) == (StreamState.NO_MEASUREMENT, 1)
        answers = False
        await gateway.wait_until(lambda: server.connections >= 2)
        assert "sends no frames" in gateway.status.last_error
