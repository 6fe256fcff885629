"""Handshake, rate and pause with scripted servers, including unusual ones."""

import asyncio
import logging
from typing import Any

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import LinkError
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters
from gateway.stream.parameters import Connection
from gateway.stream.session import Session
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus
from gateway.stream.stream_control import StreamControl
from tests.servers import markers_frame, ok, packet
from tests.unit.stream.scripted_server import (
    XML,
    Answer,
    ScriptedServer,
    obliging,
    read_parameters,
    refusing,
    silent_to,
)
from tests.unit.stream.virtual_time import read_clocks, settle

RATE_XML = packet(2, "<RT_Parameters Ver='1.00'><The_3D><Frequency>200</Frequency></The_3D></RT_Parameters>")


class Lab:
    """The control of one session. ``parameters`` are those that it has read."""

    def __init__(self, answer: Answer = obliging, *, byte_order: str = "big", **stream: Any) -> None:
        self.server = ScriptedServer(answer)
        self.status = StreamStatus("3d", name="lab (3d)")
        self.parameters: list[ParsedParameters] = []
        source = SourceSettings.model_validate(
            {"name": "lab", "host": "192.0.2.20", "byte_order": byte_order}
        )
        settings = StreamSettings.model_validate({"components": ["3d"]} | stream)
        self.session = Session(
            source,
            settings,
            self.status,
            lambda *_: None,
            lambda _: None,
            self.server.connect,
            read_clocks,
        )
        self.control = StreamControl(source, settings, self.status, self.session, self._read_parameters)

    async def _read_parameters(self, connection: Connection) -> ParsedParameters:
        parsed = await read_parameters(connection)
        self.parameters.append(parsed)
        return parsed

    @property
    def commands(self) -> list[str]:
        return self.server.connection.commands

    async def start(self) -> None:
        await self.session.connect()
        await self.control.start()


async def test_the_handshake_asks_for_version_parameters_and_frames() -> None:
    lab = Lab()
    await lab.start()
    assert lab.commands == ["Version 1.0", "SendParameters", "StreamFrames AllFrames 3D"]
    assert lab.parameters == [parse_parameters(XML[8:])]
    assert lab.status.rate == "AllFrames"
    assert lab.status.state is StreamState.IDLE
    assert lab.status.limitations == []
    assert (lab.status.session, lab.status.tries) == (1, 0)


async def test_little_endian_is_requested_before_the_parameters() -> None:
    lab = Lab(byte_order="little")
    await lab.start()
    assert lab.commands[:3] == ["Version 1.0", "SetByteOrder LittleEndian", "SendParameters"]
    lab.server.connection.send(markers_frame(1, (0.0, 0.0, 0.0), order="<"))
    assert lab.status.byte_order == "little"
    assert lab.status.limitations == []


async def test_a_frame_before_the_acknowledgement_is_streaming_after_the_handshake() -> None:
    def answer(command: str) -> bytes | None:
        early = markers_frame(1, (0.0, 0.0, 0.0)) if command.startswith("StreamFrames") else b""
        return early + obliging(command)

    lab = Lab(answer)
    await lab.start()
    assert lab.status.state is StreamState.STREAMING


async def test_the_handshake_continues_after_refused_and_ignored_commands(
    caplog: pytest.LogCaptureFixture,
) -> None:
    lab = Lab(refusing("Version", by=silent_to("SendParameters", "StreamFrames AllFrames 3D")))
    await lab.start()
    assert lab.status.limitations == [
        "the server refused Version 1.0: Error-Version 1.0",
        "the server did not answer SendParameters",
        "the server did not acknowledge StreamFrames AllFrames 3D",
    ]
    assert [record.levelno for record in caplog.records if "server" in record.message] == [
        logging.WARNING
    ] * 3
    assert lab.parameters == []
    assert lab.commands[2:] == ["StreamFrames AllFrames 3D", "StreamFrames AllFrames"]
    assert lab.status.rate == "AllFrames"


async def test_a_refused_request_is_repeated_in_simpler_forms() -> None:
    def answer(command: str) -> bytes | None:
        if command.startswith("SendParameters"):
            return RATE_XML
        return ok("ok") if command == "StreamFrames" else refusing("StreamFrames")(command)

    lab = Lab(answer, rate={"frequency_hz": 50})
    await lab.start()
    assert lab.commands[2:] == [
        "StreamFrames Frequency:50 3D",
        "StreamFrames Frequency:50",
        "StreamFrames FrequencyDivisor:4",
        "StreamFrames",
    ]
    assert lab.status.rate == ""
    assert len(lab.status.limitations) == 3


async def test_a_server_that_refuses_every_form_ends_the_handshake() -> None:
    lab = Lab(refusing("StreamFrames"))
    with pytest.raises(LinkError, match="refuses StreamFrames in every form"):
        await lab.start()
    assert lab.status.state is StreamState.HANDSHAKING
    assert lab.status.tries == 1


async def test_parameters_that_cannot_be_read_are_a_limitation() -> None:
    lab = Lab(lambda command: packet(2, "OK") if command == "SendParameters" else obliging(command))
    await lab.start()
    assert lab.parameters == []
    [limitation] = lab.status.limitations
    assert limitation.startswith("no parameters: ")


async def test_a_changed_rate_is_a_fraction_of_the_agreed_one() -> None:
    lab = Lab(rate={"frequency_hz": 200})
    await lab.start()
    await lab.control.request(2)
    assert lab.commands[-1] == "StreamFrames Frequency:50 3D"
    assert lab.status.rate == "Frequency:50"
    await lab.control.request(0)
    assert lab.commands[-1] == "StreamFrames Frequency:200 3D"


async def test_a_refused_change_of_rate_leaves_the_rate() -> None:
    lab = Lab(rate={"frequency_hz": 200})
    await lab.start()
    lab.server.answer = refusing("StreamFrames")
    await lab.control.request(1)
    assert lab.status.rate == "Frequency:200"
    assert lab.status.limitations == [
        "the server refused StreamFrames Frequency:100 3D: Error-StreamFrames Frequency:100 3D"
    ]


async def test_a_paused_stream_has_no_rate_until_it_is_resumed() -> None:
    lab = Lab()
    await lab.start()
    await lab.control.stop()
    assert lab.commands[-1] == "StreamFrames Stop"
    assert lab.status.rate == ""
    await lab.control.request(0)
    assert lab.commands[-1] == "StreamFrames AllFrames 3D"
    assert lab.status.rate == "AllFrames"


async def test_the_end_of_the_connection_ends_the_handshake() -> None:
    lab = Lab(silent_to(""))
    starting = asyncio.create_task(lab.start())
    await settle()
    lab.server.connection.end()
    with pytest.raises(LinkError, match="was closed by the server"):
        await starting
