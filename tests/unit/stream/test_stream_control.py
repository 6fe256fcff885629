"""Handshake, rate and pause with scripted servers, including unusual ones."""

import asyncio
import logging
from typing import Any

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import LinkError, RequestError, SilenceError
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters
from gateway.stream.files import IgnoredFiles
from gateway.stream.parameters import Connection
from gateway.stream.session import Session
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus
from gateway.stream.stream_control import StreamControl
from tests.servers import error, markers_frame, ok, packet
from tests.unit.stream.scripted_server import (
    BROKEN_FRAME,
    XML,
    Answer,
    ScriptedServer,
    obliging,
    read_parameters,
    refusing,
    silent_to,
)
from tests.virtual_time import read_clocks, settle, until

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
            source, settings, self.status, lambda *_: None, IgnoredFiles(), self.server.connect, read_clocks
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
    assert lab.commands[2:] == ["StreamFrames AllFrames 3D", "StreamFrames AllFrames"] * 2
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


@pytest.mark.parametrize("not_a_rate", ["0", "1e30", "inf"])
async def test_no_divisor_follows_from_a_number_that_cannot_be_a_rate(not_a_rate: str) -> None:
    def answer(command: str) -> bytes | None:
        if command.startswith("SendParameters"):
            return packet(2, RATE_XML[8:].decode().replace("200", not_a_rate))
        return ok("ok") if command == "StreamFrames" else refusing("StreamFrames")(command)

    lab = Lab(answer, rate={"frequency_hz": 50})
    await lab.start()
    assert lab.commands[-3:] == ["StreamFrames Frequency:50 3D", "StreamFrames Frequency:50", "StreamFrames"]


async def test_a_server_that_hung_is_asked_again_for_the_named_components() -> None:
    """Without names, streams: auto would take it for a server that serves one rate only."""
    named, unnamed = "StreamFrames AllFrames 3D", "StreamFrames AllFrames"
    lab = Lab()
    lab.server.answer = lambda command: None if lab.commands[2:] == [named] else obliging(command)
    await lab.start()
    assert lab.commands[2:] == [named, unnamed, named]
    assert str(lab.control.accepted) == named


async def test_a_server_that_does_not_know_names_keeps_the_form_without_them() -> None:
    named, unnamed = "StreamFrames AllFrames 3D", "StreamFrames AllFrames"
    lab = Lab(silent_to(named))
    await lab.start()
    assert lab.commands[2:] == [named, unnamed, named, unnamed]
    assert str(lab.control.accepted) == unnamed


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


async def test_a_request_without_an_answer_is_not_accepted_unless_data_comes() -> None:
    lab = Lab(silent_to("StreamFrames AllFrames"))
    await lab.start()
    assert lab.commands[2:] == [
        "StreamFrames AllFrames 3D",
        "StreamFrames AllFrames",
        "StreamFrames FrequencyDivisor:1",
        "StreamFrames AllFrames 3D",  # in case the server only hung
        "StreamFrames FrequencyDivisor:1",
    ]
    assert lab.status.rate == "FrequencyDivisor:1"


async def test_late_refusals_of_an_accepted_request_do_not_end_the_handshake() -> None:
    """The server sends frames, although what it has answered looks like a refusal of every form."""

    def answer(command: str) -> bytes | None:
        return error("what?") if command.startswith("StreamFrames") else None

    lab = Lab(answer)
    starting = asyncio.create_task(lab.start())
    await until(lambda: "StreamFrames" in lab.commands if lab.server.connections else False)
    await asyncio.sleep(1)
    lab.server.connection.send_frames(1)
    await starting
    assert lab.status.state is StreamState.STREAMING


# --- silence


async def probes_after(lab: Lab, answer: Answer, silence_s: float = 10) -> list[str]:
    """Return what the gateway sends while the server is silent, after frames or No Data were requested."""
    await lab.start()
    num_before = len(lab.commands)
    lab.server.answer = answer
    monitoring = asyncio.create_task(lab.session.monitor(lab.control.check_silence))
    await asyncio.sleep(silence_s)
    assert not monitoring.done()
    monitoring.cancel()
    return lab.commands[num_before:]


def no_measurement(by: Answer = obliging) -> Answer:
    """Return an answer with No Data after each acknowledgement of StreamFrames."""

    def answer(command: str) -> bytes | None:
        reply = by(command)
        return reply if reply is None or not command.startswith("StreamFrames") else reply + packet(4)

    return answer


@pytest.mark.parametrize(
    ("by", "probe"),
    [
        (obliging, "Version 1.0"),
        (refusing("Version"), "Version 1.0"),
        (silent_to("Version"), "SendParameters"),
        (refusing("SendParameters", by=silent_to("Version")), "SendParameters"),
        (silent_to("Version", "SendParameters"), "StreamFrames AllFrames 3D"),
    ],
    ids=["answered", "refused", "ignored", "ignored and refused", "all ignored"],
)
async def test_silence_is_checked_with_a_command_that_the_server_has_answered(by: Answer, probe: str) -> None:
    answer = no_measurement(by)
    lab = Lab(answer)
    assert await probes_after(lab, answer) == [probe] * 3


async def test_silence_after_a_stop_is_not_checked_by_a_request_for_frames() -> None:
    answer = silent_to("Version", "SendParameters")
    lab = Lab(answer)
    await lab.start()
    await lab.control.stop()
    monitoring = asyncio.create_task(lab.session.monitor(lab.control.check_silence))
    await asyncio.sleep(10)
    assert lab.commands[3:] == ["StreamFrames Stop"] * 4
    monitoring.cancel()


async def test_a_server_that_no_longer_answers_is_not_alive() -> None:
    lab = Lab(no_measurement())
    await lab.start()
    lab.server.answer = silent_to("")
    with pytest.raises(SilenceError, match=r"did not answer Version 1\.0 within 2 s, and sends no frames"):
        await lab.session.monitor(lab.control.check_silence)


async def test_a_stream_of_events_alone_is_not_requested_again() -> None:
    lab = Lab(components=["event"])
    assert await probes_after(lab, obliging) == ["Version 1.0"] * 3


async def test_frames_that_do_not_come_are_requested_again_then_the_connection_ends(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    lab = Lab()
    await lab.start()
    text = "192.0.2.20:3020 accepted StreamFrames AllFrames 3D and sends neither frames nor No Data"
    began_s = asyncio.get_running_loop().time()
    with pytest.raises(SilenceError) as caught:
        await lab.session.monitor(lab.control.check_silence)
    assert str(caught.value) == f"{text}, although the gateway asked again; connecting again"
    assert asyncio.get_running_loop().time() - began_s == pytest.approx(6)
    assert lab.commands[2:] == ["StreamFrames AllFrames 3D"] * 2
    assert f"lab (3d): {text}; asking again" in caplog.messages


async def test_frames_that_are_all_rejected_are_the_reason(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    lab = Lab()
    await lab.start()
    for delay_s in (2, 5):
        asyncio.get_running_loop().call_later(delay_s, lambda: lab.server.connection.send(BROKEN_FRAME))
    with pytest.raises(SilenceError) as caught:
        await lab.session.monitor(lab.control.check_silence)
    text = "all frames from 192.0.2.20:3020 are rejected: component 1 of 1"
    assert str(caught.value).startswith(text)
    assert any(text in message and message.endswith("asking again") for message in caplog.messages)


async def test_frames_that_come_after_the_second_request_are_streaming() -> None:
    lab = Lab()
    await lab.start()
    monitoring = asyncio.create_task(lab.session.monitor(lab.control.check_silence))
    await until(lambda: len(lab.commands) == 4)
    lab.server.connection.send_frames(1)
    assert lab.status.state is StreamState.STREAMING
    await asyncio.sleep(2.9)
    assert not monitoring.done()
    monitoring.cancel()


async def test_a_second_request_that_is_refused_ends_the_connection() -> None:
    lab = Lab()
    await lab.start()
    lab.server.answer = refusing("StreamFrames")
    with pytest.raises(RequestError, match="no longer accepts StreamFrames AllFrames 3D; connecting again"):
        await lab.session.monitor(lab.control.check_silence)


# --- stopping


async def test_a_refused_or_ignored_stop_leaves_the_stream_as_it_is() -> None:
    lab = Lab()
    await lab.start()
    lab.server.connection.send_frames(1)
    lab.server.answer = refusing("StreamFrames Stop")
    assert not await lab.control.stop()
    assert (lab.control.is_stopped, lab.status.state) == (False, StreamState.STREAMING)
    assert lab.status.rate == "AllFrames"
    lab.server.answer = silent_to("StreamFrames Stop")
    stopping = asyncio.create_task(lab.control.stop())
    await asyncio.sleep(1)
    assert not stopping.done()
    assert await stopping
    assert lab.status.rate == ""


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
