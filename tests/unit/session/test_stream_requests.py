"""Handshake, rate and pause with scripted servers, including unusual ones."""

import asyncio
import logging
from typing import Any

import pytest

from gateway.errors import LinkError, RequestError, SilenceError
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.session.state import StreamState
from tests.support.clocks import until
from tests.support.errors import names, raises
from tests.support.servers import error, markers_frame, ok, packet
from tests.unit.session.scripted_server import BROKEN_FRAME, XML, Answer, obliging, refusing, silent_to
from tests.unit.session.session_lab import NO_DATA, Lab, now_s

RATE_XML = "<RT_Parameters Ver='1.00'><The_3D><Frequency>200</Frequency></The_3D></RT_Parameters>"


NAMED, UNNAMED = "StreamFrames AllFrames 3D", "StreamFrames AllFrames"


async def started(answer: Answer = obliging, **settings: Any) -> Lab:
    lab = Lab(answer, **settings)
    await lab.start()
    return lab


async def test_the_handshake_asks_for_version_parameters_and_frames() -> None:
    lab = await started()
    assert lab.commands == ["Version 1.0", "SendParameters", NAMED]
    assert lab.parameters == [parse_parameters(XML[8:])]
    assert lab.status.rate == "AllFrames"
    assert lab.status.state is StreamState.IDLE
    assert lab.status.limitations == []
    assert (lab.status.session, lab.status.tries) == (1, 0)


async def test_little_endian_is_requested_before_the_parameters() -> None:
    lab = await started(byte_order="little")
    assert lab.commands[:3] == ["Version 1.0", "SetByteOrder LittleEndian", "SendParameters"]
    lab.connection.send(markers_frame(1, (0.0, 0.0, 0.0), order="<"))
    assert lab.status.byte_order == "little"
    assert lab.status.limitations == []


async def test_the_handshake_continues_after_refused_and_ignored_commands(
    caplog: pytest.LogCaptureFixture,
) -> None:
    lab = await started(refusing("Version", by=silent_to("SendParameters", NAMED)))
    refused, unanswered, unacknowledged = lab.status.limitations
    assert names(refused, "Version 1.0", "Error-Version 1.0")
    assert names(unanswered, "SendParameters")
    assert names(unacknowledged, "StreamFrames AllFrames 3D")
    assert [record.levelno for record in caplog.records if "server" in record.message] == [
        logging.WARNING
    ] * 3
    assert lab.parameters == []
    assert lab.commands[2:] == [NAMED, UNNAMED] * 2
    assert lab.status.rate == "AllFrames"


@pytest.mark.parametrize(
    ("server_rate_hz", "divisor"),
    [("200", ["StreamFrames FrequencyDivisor:4"]), ("0", []), ("1e30", []), ("inf", [])],
)
async def test_a_refused_request_is_repeated_in_simpler_forms(
    server_rate_hz: str, divisor: list[str]
) -> None:
    def answer(command: str) -> bytes | None:
        if command.startswith("SendParameters"):
            return packet(2, RATE_XML.replace("200", server_rate_hz))
        return ok("ok") if command == "StreamFrames" else refusing("StreamFrames")(command)

    lab = await started(answer, rate={"frequency_hz": 50})
    forms = ["StreamFrames Frequency:50 3D", "StreamFrames Frequency:50", *divisor, "StreamFrames"]
    assert lab.commands[2:] == forms
    assert (lab.status.rate, len(lab.status.limitations)) == ("", len(forms) - 1)


@pytest.mark.parametrize("knows_names", [True, False])
async def test_a_server_that_did_not_answer_is_asked_again_for_the_named_components(
    *, knows_names: bool
) -> None:
    """Without names, streams: auto would take a server that hung for one that serves one rate only."""
    lab = Lab(silent_to(NAMED))
    if knows_names:
        lab.server.answer = lambda command: None if lab.commands[2:] == [NAMED] else obliging(command)
    await lab.start()
    assert lab.commands[2:] == [NAMED, UNNAMED, NAMED] + ([] if knows_names else [UNNAMED])
    assert str(lab.control.accepted) == (NAMED if knows_names else UNNAMED)


async def test_parameters_that_cannot_be_read_are_a_limitation() -> None:
    lab = await started(lambda command: packet(2, "OK") if command == "SendParameters" else obliging(command))
    assert lab.parameters == []
    [limitation] = lab.status.limitations
    assert limitation.startswith("no parameters: ")


async def test_repairs_of_the_parameters_are_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    cells = "<The_3D><Frequency>fast</Frequency></The_3D>" * 2 + "<The_6D><Frequency>x</Frequency></The_6D>"
    xml = f"<RT_Parameters>{cells}<The_3D><Unit>m</The_3D></RT_Parameters>"
    repairs = parse_parameters(xml.encode()).recovered
    lab = await started(lambda command: packet(2, xml) if command == "SendParameters" else obliging(command))
    lab.status.parameters_repaired(repairs)
    assert len(repairs) > 3
    texts = "; ".join(repairs[:3])
    expected = f"lab (3d): parameters repaired: {texts}; and {len(repairs) - 3} more"
    assert [text for text in caplog.messages if "repaired" in text] == [expected]


async def test_a_server_that_refuses_every_form_ends_the_handshake_with_what_to_check() -> None:
    lab = Lab(refusing("StreamFrames"))
    with pytest.raises(LinkError) as caught:
        await lab.start()
    text = "refuses StreamFrames in every form that the protocol has; check its real-time output settings"
    assert str(caught.value) == f"192.0.2.20:3020 {text}"
    assert (lab.status.state, lab.status.tries) == (StreamState.HANDSHAKING, 1)


async def test_a_changed_rate_is_a_fraction_of_the_agreed_one_unless_it_is_refused() -> None:
    lab = await started(rate={"frequency_hz": 200})
    await lab.control.request(2)
    assert (lab.commands[-1], lab.status.rate) == ("StreamFrames Frequency:50 3D", "Frequency:50")
    await lab.control.request(0)
    assert lab.commands[-1] == "StreamFrames Frequency:200 3D"
    lab.server.answer = refusing("StreamFrames")
    await lab.control.request(1)
    refused = "StreamFrames Frequency:100 3D"
    assert lab.status.rate == "Frequency:200"
    [limitation] = lab.status.limitations
    assert names(limitation, refused, f"Error-{refused}")
    lab.connection.send_frames(1)
    lab.server.answer = silent_to("StreamFrames")
    asyncio.get_running_loop().call_later(1, lambda: lab.connection.send_frames(2))  # at the former rate
    assert not await lab.control.request(1)
    assert lab.status.rate == "Frequency:200"


async def test_a_request_without_an_answer_is_not_accepted_unless_data_comes() -> None:
    lab = await started(silent_to(UNNAMED))
    assert lab.commands[2:] == [
        NAMED,
        UNNAMED,
        "StreamFrames FrequencyDivisor:1",
        NAMED,  # in case the server only hung
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
    lab.connection.send_frames(1)
    await starting
    assert lab.status.state is StreamState.STREAMING


# --- silence


async def probes_after(lab: Lab, answer: Answer, silence_s: float = 10) -> list[str]:
    """Return what the gateway sends while the server is silent, after frames or No Data were requested."""
    await lab.start()
    num_before = len(lab.commands)
    lab.server.answer = answer
    async with lab.monitored(by_control=True) as monitoring:
        await asyncio.sleep(silence_s)
        assert not monitoring.done()
    return lab.commands[num_before:]


def no_measurement(by: Answer = obliging) -> Answer:
    """Return an answer with No Data after each acknowledgement of StreamFrames."""

    def answer(command: str) -> bytes | None:
        reply = by(command)
        return reply if reply is None or not command.startswith("StreamFrames") else reply + NO_DATA

    return answer


@pytest.mark.parametrize(
    ("by", "probe"),
    [
        (obliging, "Version 1.0"),
        (refusing("Version"), "Version 1.0"),
        (silent_to("Version"), "SendParameters"),
        (refusing("SendParameters", by=silent_to("Version")), "SendParameters"),
        (silent_to("Version", "SendParameters"), NAMED),
    ],
    ids=["answered", "refused", "ignored", "ignored and refused", "all ignored"],
)
async def test_silence_is_checked_with_a_command_that_the_server_has_answered(by: Answer, probe: str) -> None:
    answer = no_measurement(by)
    lab = Lab(answer)
    assert await probes_after(lab, answer) == [probe] * 3


async def test_silence_is_not_checked_by_a_command_that_would_stop_or_resume_the_stream() -> None:
    lab = await started(no_measurement(silent_to("Version", "SendParameters")))
    await lab.control.stop()
    async with lab.monitored(by_control=True):
        await asyncio.sleep(10)
    assert lab.commands[3:] == ["StreamFrames Stop"] * 4
    await lab.control.request(0)
    async with lab.monitored(by_control=True):
        await asyncio.sleep(10)
    assert lab.commands[7:] == [NAMED] * 4


async def test_a_server_that_no_longer_answers_is_not_alive() -> None:
    lab = await started(no_measurement())
    lab.server.answer = silent_to("")
    with raises(SilenceError, "Version 1.0", "2 s", "no frames"):
        await lab.session.monitor(lab.control.check_silence)


async def test_a_stream_of_events_alone_is_not_requested_again() -> None:
    lab = Lab(components=["event"])
    assert await probes_after(lab, obliging) == ["Version 1.0"] * 3


async def test_frames_that_do_not_come_are_requested_again_then_the_connection_ends(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    lab = await started()
    began_s = now_s()
    with raises(SilenceError, "192.0.2.20:3020", "StreamFrames AllFrames 3D", "neither", "again"):
        await lab.session.monitor(lab.control.check_silence)
    assert now_s() - began_s == pytest.approx(6)
    assert lab.commands[2:] == [NAMED] * 2
    assert any(names(each, "lab (3d)", "neither", "asking again") for each in caplog.messages)


async def test_frames_that_are_all_rejected_are_the_reason(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    lab = await started()
    for delay_s in (2, 5):
        asyncio.get_running_loop().call_later(delay_s, lambda: lab.connection.send(BROKEN_FRAME))
    values = ("192.0.2.20:3020", "rejected", "component 1 of 1")
    with raises(SilenceError, *values):
        await lab.session.monitor(lab.control.check_silence)
    assert any(names(message, *values, "asking again") for message in caplog.messages)


async def test_frames_that_come_after_the_second_request_are_streaming() -> None:
    lab = await started()
    async with lab.monitored(by_control=True) as monitoring:
        await until(lambda: len(lab.commands) == 4)
        lab.connection.send_frames(1)
        assert lab.status.state is StreamState.STREAMING
        await asyncio.sleep(2.9)
        assert not monitoring.done()
        await lab.control.stop()
        await lab.control.request(0)  # which is repeated once more if no frames come
        await asyncio.sleep(3.5)
        assert (monitoring.done(), lab.commands[-3:]) == (False, ["StreamFrames Stop", NAMED, NAMED])


async def test_a_second_request_that_is_refused_ends_the_connection() -> None:
    lab = await started()
    lab.server.answer = refusing("StreamFrames")
    with raises(RequestError, "StreamFrames AllFrames 3D", "no longer"):
        await lab.session.monitor(lab.control.check_silence)


# --- stopping


async def test_a_refused_or_ignored_stop_leaves_the_stream_as_it_is() -> None:
    lab = await started()
    lab.connection.send_frames(1)
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
