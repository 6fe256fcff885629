"""When a source reads and publishes its server's parameters; with a scripted server, in virtual time."""

import asyncio
import logging

import pytest

from gateway.config.settings import StreamSettings
from gateway.errors import QueryError
from gateway.queries.questions import Question
from gateway.rtc3d.components import ComponentType
from tests.support.clocks import settle
from tests.support.errors import names, raises
from tests.support.parameters import in_root
from tests.support.records import kinds
from tests.support.servers import packet
from tests.support.toy_output import ToyOutput
from tests.unit.daemon.test_source import TWO_STREAMS, Lab, NewLab, new_lab, running
from tests.unit.publish.test_tool_poses import IN_VIEW, tools_frame
from tests.unit.queries.fake_source import parameters_xml
from tests.unit.session.scripted_server import XML, Answer, obliging, refusing, silent_to

__all__ = ["new_lab"]  # a fixture

OTHER_XML = packet(2, in_root("<The_3D><Unit>cm</Unit></The_3D>"))
NO_DATA = packet(4)
REQUEST = "SendParameters"


def sending(xml: bytes, by: Answer = obliging) -> Answer:
    """Return an answer that sends these parameters (a packet)."""
    return lambda command: xml if command.startswith(REQUEST) else by(command)


def tools(*labels: str) -> bytes:
    items = "".join(f"<Tool id='{n}'><Label>{label}</Label></Tool>" for n, label in enumerate(labels, 1))
    return packet(2, in_root(f"<The_6D><Tools>{items}</Tools></The_6D>"))


def published(lab: Lab) -> list[tuple[bytes, int, int]]:
    """Return the XML, session and version of all parameters that were published."""
    return [parameters[:3] for _, parameters in lab.output.parameters]


async def test_a_server_that_hung_in_the_handshake_is_asked_again(new_lab: NewLab) -> None:
    lab = new_lab()
    lab.server.answer = silent_to(REQUEST)
    async with running(lab):
        lab.server.connection.send(NO_DATA)
        [status] = lab.source.statuses
        [limitation] = [text for text in status.limitations if names(text, "SendParameters")]
        lab.server.answer = obliging
        await asyncio.sleep(12)
        assert status.parameters_version == 1
        assert published(lab) == [(XML[8:], 1, 1)]
        assert limitation not in status.limitations


@pytest.mark.parametrize("on_demand", [False, True])
async def test_parameters_are_read_again_at_the_interval(
    new_lab: NewLab, on_demand: bool, caplog: pytest.LogCaptureFixture
) -> None:
    stream = StreamSettings(components=(ComponentType.TOOLS,), on_demand=on_demand)
    output = ToyOutput("toy", *([] if on_demand else ["6d"]), has_tool_poses=True)
    lab = new_lab(streams=(stream,), output=output, stall_timeout_s=3600.0)
    lab.server.answer = sending(tools("Probe"))
    async with running(lab):
        await asyncio.sleep(9.5)
        assert lab.count(REQUEST) == 1
        assert lab.count("StreamFrames Stop") == on_demand
        lab.server.answer = sending(tools("Head"))
        await asyncio.sleep(1)
        assert lab.count(REQUEST) == 2
        assert published(lab)[1:] == [(tools("Head")[8:], 1, 2)]
        assert (await lab.source.queries.answer(Question("parameters"))).payload == tools("Head")[8:]
        lab.server.connection.send(packet(3, tools_frame(IN_VIEW).body))
        if not on_demand:
            assert lab.output.tool_names() == ["Head"]
        await asyncio.sleep(100)
        assert lab.count(REQUEST) == 12
    [warning] = [record.message for record in caplog.records if record.levelno == logging.WARNING]
    assert kinds(caplog) == [("WARNING", "renamed")]
    assert names(warning, "lab", "6d", "'Probe'", "'Head'")


async def test_a_changed_number_of_items_requests_the_parameters_once(new_lab: NewLab) -> None:
    lab = new_lab()
    async with running(lab):
        lab.server.connection.send(NO_DATA)
        before = lab.count(REQUEST)
        for _ in range(3):
            lab.source.fan_out.on_items_changed()
        await settle()
        assert lab.count(REQUEST) == before + 1
        lab.source.fan_out.on_items_changed()
        await asyncio.sleep(9)
        assert lab.count(REQUEST) == before + 1
        await asyncio.sleep(2)
        assert lab.count(REQUEST) == before + 2


async def test_a_new_measurement_requests_the_parameters(new_lab: NewLab) -> None:
    lab = new_lab()
    async with running(lab):
        for sends_data, num_requests in ((True, 1), (False, 1), (True, 2)):
            if sends_data:
                lab.server.connection.send_frames(num_requests)
            else:
                lab.server.connection.send(NO_DATA)
            await settle()
            assert lab.count(REQUEST) == num_requests


@pytest.mark.parametrize(("interval_s", "expected"), [(10.0, 11), (0.0, 11), (20.0, 6)])
async def test_a_server_that_plays_in_a_loop_is_not_asked_at_every_pass(
    new_lab: NewLab, interval_s: float, expected: int
) -> None:
    lab = new_lab(parameters_interval_s=interval_s)
    async with running(lab):
        for _ in range(100):
            lab.server.connection.send_frames(5000)
            lab.server.connection.send_frames(1)
            await asyncio.sleep(1)
        assert lab.count(REQUEST) == pytest.approx(expected, abs=1)


async def test_parameters_are_void_if_another_server_gives_none(new_lab: NewLab) -> None:
    lab = new_lab(output=ToyOutput("toy", has_tool_poses=True))
    lab.server.answer = sending(tools("Probe"))
    async with running(lab):
        lab.server.connection.send(packet(3, tools_frame(IN_VIEW).body))
        lab.server.answer = refusing(REQUEST)
        lab.server.connection.end()
        await settle()
        assert len(lab.output.parameters) == 1
        await lab.connected()
        assert published(lab)[1:] == [(b"", 2, 2)]
        lab.server.connection.send(packet(3, tools_frame(IN_VIEW).body))
        assert lab.output.tool_names()[-1] == "tool 1"
        assert lab.messages("6d")[-1].parameters_version == 2


async def test_parameters_are_published_before_the_frames_that_have_their_version(new_lab: NewLab) -> None:
    lab = new_lab()
    async with running(lab):
        lab.server.answer = sending(OTHER_XML)
        lab.output.sending = asyncio.get_running_loop().create_future()
        lab.source.fan_out.on_items_changed()
        await settle()
        assert lab.output.parameters[-1][1].version == 2
        lab.server.connection.send_frames(1)
        assert lab.messages("3d")[-1].parameters_version == 1
        lab.output.sending.set_result(None)
        await settle()
        lab.server.connection.send_frames(2)
        assert lab.messages("3d")[-1].parameters_version == 2


async def test_a_reload_continues_the_version_and_the_parameters_of_another_server_are_void(
    new_lab: NewLab,
) -> None:
    lab = new_lab()
    async with running(lab):
        lab.server.answer = sending(OTHER_XML)
        lab.source.fan_out.on_items_changed()
        await settle()
    after = new_lab(lab.source.history, query_timeout_s=3.0)
    assert after.source.statuses[0].parameters_version == 2
    async with running(after):
        assert published(after) == [(OTHER_XML[8:], 2, 2)]
    after.server.refuses = True
    other = new_lab(after.source.history, port=3021)
    async with running(other, sessions=0):
        await settle()
        assert published(other) == [(b"", 2, 3)]
        with raises(QueryError, code="no-connection"):
            await other.source.queries.answer(Question("parameters", stale_ok=True))


async def test_every_message_carries_the_version_of_the_parameters(new_lab: NewLab) -> None:
    lab = new_lab(streams=TWO_STREAMS)

    async def check_version(version: int) -> None:
        """Check the version of a new frame, of the status and of the clock."""
        lab.server.connections[0].send_frames(1)
        lab.source.publish_status()
        await settle()
        newest = [lab.messages(name)[-1].parameters_version for name in ("3d", "status", "clock")]
        assert newest == [version] * 3

    assert [status.parameters_version for status in lab.source.statuses] == [0, 0]
    async with running(lab, sessions=2):
        await check_version(1)
        more_frames = parameters_xml("cm", frames_sent=2)
        for xml, version in (
            (parameters_xml("cm"), 2),
            (more_frames, 2),
            (parameters_xml("m"), 3),
            (parameters_xml("cm"), 4),
        ):
            lab.server.answer = sending(packet(2, xml.decode()))
            await lab.source.queries.answer(Question("parameters", fresh=True))
            await settle()
            await check_version(version)
            assert lab.output.parameters[-1][1].version == version
