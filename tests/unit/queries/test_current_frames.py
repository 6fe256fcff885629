"""Current frames, files and recording at the queries."""

import asyncio
import json

import pytest

from gateway.errors import QueryError, ServerError
from gateway.messages.splice import splice
from gateway.messages.stamp import Stamp
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.packets import Packet, PacketType
from gateway.stream.state import StreamState
from tests.servers import markers_frame
from tests.unit.queries.rig import Rig

FRAME = markers_frame(7, (1.0, 2.0, 3.0))[8:]


async def test_a_file_is_read_once_for_all_who_ask_at_once() -> None:
    rig = Rig()
    answers = await asyncio.gather(*(rig.ask("c3d") for _ in range(10)))
    assert [answer.payload for answer in answers] == [b"file"] * 10
    assert rig.files == ["read"]


async def test_recording_is_not_touched_unless_it_is_switched_on() -> None:
    rig = Rig()
    with pytest.raises(QueryError, match="remote_control: true"):
        await rig.ask("recording", set="start")
    assert rig.recorded == []
    on = Rig(remote_control=True)
    assert (await on.ask("recording", set="start")).payload == b'{"source":"lab","sent":"start"}'
    await on.ask("recording", set="stop")
    assert on.recorded == [True, False]
    with pytest.raises(QueryError, match="accepted: set=start, set=stop"):
        await on.ask("recording")


def markers_message(session: int) -> bytes:
    [component] = split_frame(FRAME, "big").components
    return splice(component, Stamp(1, 1, session), 5)


async def test_the_newest_message_of_this_session_is_the_current_frame_while_streaming() -> None:
    rig = Rig()
    rig.status.state = StreamState.STREAMING
    rig.newest[ComponentType.MARKERS] = markers_message(session=1)
    answer = await rig.ask("component", "3d")
    assert answer.payload == markers_message(session=1)
    assert answer.attachment == {"session": 1}
    rig.status.session = 2
    with pytest.raises(QueryError, match="no 3d has arrived from source 'lab' in this session"):
        await rig.ask("component", "3d")
    assert rig.server.commands == []


async def test_equal_questions_for_the_current_frame_share_one() -> None:
    rig = Rig()
    rig.server.replies["SendCurrentFrame 3D"] = Packet(PacketType.DATA, FRAME)
    answers = await asyncio.gather(*(rig.ask("component", "3d", as_json=True) for _ in range(5)))
    assert {json.loads(answer.payload)["frame_number"] for answer in answers} == {7}
    assert rig.server.commands == ["SendCurrentFrame 3D"]


@pytest.mark.parametrize(
    ("packet", "code", "text"),
    [
        (Packet(PacketType.NO_DATA, b""), "nothing-yet", "no measurement runs"),
        (Packet(PacketType.DATA, b"\0\0\0\0"), "nothing-yet", "the current frame has no 3d"),
        (Packet(PacketType.DATA, FRAME[:-1]), "unreadable", "the current frame cannot be read: "),
    ],
)
async def test_a_current_frame_that_is_of_no_use_is_told(packet: Packet, code: str, text: str) -> None:
    rig = Rig()
    rig.server.replies["SendCurrentFrame 3D"] = packet
    with pytest.raises(QueryError, match=text) as caught:
        await rig.ask("component", "3d")
    assert caught.value.code == code


async def test_a_server_that_knows_no_current_frame_is_told_by_its_own_words() -> None:
    rig = Rig()
    rig.server.replies = {"SendCurrentFrame 3D": ServerError("a"), "SendCurrentFrame": ServerError("b")}
    with pytest.raises(QueryError, match="the server does not know SendCurrentFrame, or refuses it: b"):
        await rig.ask("component", "3d")
