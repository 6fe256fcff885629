"""Receiving from LCM, whatever is sent there."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest
import rtc3d

from gateway.client.client import GatewayAddress, GatewayClient
from gateway.client.recorder import FileWriter, TakeRecording, Target
from gateway.client.sources import FINGERPRINTS
from gateway.messages.encode import PREFIX
from gateway.messages.topics import MAX_SOURCES
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.settings import lcm_queries_url
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.takes.files.event_log import EventLogReader
from tests.support.networks import lcm_url
from tests.support.waiting import wait_until

pytestmark = pytest.mark.netns


class Lab:
    """A publisher on LCM, and a recording of the source Lab-1, or of all sources."""

    def __init__(self, folder: Path, *sources: str) -> None:
        target = Target(folder / "walk")
        self.url = url = lcm_url()
        self.path = folder / "walk.lcmlog"
        self.lcm = open_lcm(url)
        self.recording = TakeRecording(lambda names: FileWriter(target.open(names)))
        client = GatewayClient(GatewayAddress(is_lcm=True, url=url))
        self.subscriber = client.subscribe(sources, None, self.recording)

    def markers(self, sequence: int) -> bytes:
        return FINGERPRINTS["3d"] + PREFIX.pack(1_000_000, 1_000_000, sequence, 1, 1) + bytes(16)

    def status(self, source: str) -> bytes:
        message = rtc3d.status_t()
        message.utime, message.source = 1_000_000, source
        encoded: bytes = message.encode()
        return encoded

    def channels(self) -> list[str]:
        """End the recording and return the channels in the file."""
        self.recording.stop()
        assert self.recording.close(10)
        assert self.recording.defect is None
        return [event.channel for event in EventLogReader(self.path).events()]


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    lab = Lab(tmp_path)
    yield lab
    lab.subscriber.close()


def names(lab: Lab) -> set[str]:
    return {source.name for source in lab.recording.sources_now}


def test_the_status_says_the_name_of_a_source(lab: Lab) -> None:
    lab.lcm.publish("MOCAP_LAB_1_3D", lab.markers(1))
    wait_until(lambda: names(lab) == {"lab_1"})
    lab.lcm.publish("MOCAP_LAB_1_STATUS", lab.status("Robot"))  # the name of another source
    lab.lcm.publish("MOCAP_LAB_1_STATUS", lab.status("Lab-1"))
    wait_until(lambda: names(lab) == {"Lab-1"})


def test_what_is_no_message_of_a_gateway_is_left_out(lab: Lab) -> None:
    lab.lcm.publish("MOCAP_LAB_3D", lab.markers(1))
    names = ("_LAB_3D", "_LAB_STATUS", "__", "_LAB_6D_", "_X", "_LAB_TAKE")
    for channel in (f"MOCAP{name}" for name in names):
        for message in (b"", b"x" * 39, bytes(1000), FINGERPRINTS["status"] + bytes(40), FINGERPRINTS["6d/"]):
            lab.lcm.publish(channel, message)
    lab.lcm.publish("MOCAP_LAB_ANALOG", lab.markers(2))  # markers on a channel of analog data
    lab.lcm.publish("MOCAP_LAB_PARAMETERS_REQUEST", rtc3d.parameters_request_t().encode())
    lab.lcm.publish("MOCAP_LAB_3D", lab.markers(2))
    wait_until(lambda: lab.recording.num_foreign > 10)
    wait_until(lambda: sum(each.key == "3d" and each.num_messages for each in lab.recording.all_series) == 2)
    channels = lab.channels()
    assert channels.count("MOCAP_LAB_3D") == 2
    assert not {"MOCAP_LAB_ANALOG", "MOCAP_LAB_PARAMETERS_REQUEST"} & set(channels)


def test_what_programs_ask_and_how_gateways_show_themselves_is_nothing_foreign(lab: Lab) -> None:
    """It may be on the URL of the messages. A count of foreign messages would look like a fault."""
    lab.lcm.publish("MOCAP_LAB_PARAMETERS_REQUEST", rtc3d.parameters_request_t().encode())
    for end in ("COMMAND_REQUEST", "GATEWAY"):
        lab.lcm.publish(f"MOCAP_LAB_{end}", rtc3d.command_request_t().encode())
    lab.lcm.publish("MOCAP_LAB_3D", lab.markers(1))
    wait_until(lambda: lab.recording.num_messages)
    assert lab.recording.num_foreign == 0


def test_sources_are_bounded(lab: Lab) -> None:
    for number in range(300):
        lab.lcm.publish(f"MOCAP_S{number}_3D", lab.markers(1))
    wait_until(lambda: lab.recording.num_beyond == 300 - MAX_SOURCES)
    assert len(lab.recording.sources) == MAX_SOURCES


def test_only_the_chosen_sources_are_received(tmp_path: Path) -> None:
    lab = Lab(tmp_path, "Lab-1")
    for channel in ("MOCAP_LAB_1_3D", "MOCAP_LAB_10_3D", "MOCAP_ROBOT_3D", "XMOCAP_LAB_1_3D"):
        lab.lcm.publish(channel, lab.markers(1))
    lab.lcm.publish("MOCAP_LAB_1_STATUS", lab.status("Lab-1"))
    wait_until(lambda: lab.recording.num_messages == 2)
    assert names(lab) == {"Lab-1"}
    assert lab.channels() == [f"MOCAP_LAB_1_{end}" for end in ("TAKE", "3D", "STATUS", "END")]
    lab.subscriber.close()


def test_replies_of_others_and_late_ones_about_takes_are_left_out(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise, a take would seem to be running that has ended, or that of another program's question."""
    taken: list[bytes] = []
    monkeypatch.setattr(lab.recording, "answered_takes", lambda _source, content: taken.append(content))
    requests: list[rtc3d.command_request_t] = []
    queries = open_lcm(lcm_queries_url(lab.url))

    def reply(number: int, content: str, requester: str = "") -> None:
        message = rtc3d.command_reply_t()
        message.request_id, message.content = requests[number].request_id, content
        message.requester = requester or requests[number].requester
        queries.publish("MOCAP_LAB_COMMAND_REPLY", message.encode())

    with contextlib.closing(
        LcmSubscriber(
            queries,
            "MOCAP_LAB_COMMAND_REQUEST",
            lambda _channel, data: requests.append(rtc3d.command_request_t.decode(data)),
        )
    ):
        lab.lcm.publish("MOCAP_LAB_3D", lab.markers(1))
        wait_until(lambda: names(lab) == {"lab"})
        for _ in range(2):
            lab.subscriber.query_takes(lab.recording.sources_now[0])
        wait_until(lambda: len(requests) == 2)
        reply(0, "late")
        reply(1, "of another program", "other")
        reply(1, "newest")
        wait_until(lambda: taken)
    assert taken == [b"newest"]


def test_a_source_that_was_busy_has_not_answered(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is asked for its parameters again; otherwise, its recording would have none."""
    queries = open_lcm(lcm_queries_url(lab.url))

    def reply_to(_channel: str, data: bytes) -> None:
        request, reply = rtc3d.parameters_request_t.decode(data), rtc3d.parameters_reply_t()
        reply.request_id, reply.requester = request.request_id, request.requester
        reply.error, reply.error_code = "later", "busy"
        queries.publish("MOCAP_LAB_PARAMETERS_REPLY", reply.encode())
        reply.error, reply.error_code, reply.xml = "", "", "<a/>"
        queries.publish("MOCAP_LAB_PARAMETERS_REPLY", reply.encode())

    answers: list[bool] = []
    monkeypatch.setattr(
        lab.recording, "answered", lambda _source, parameters: answers.append(parameters is not None)
    )
    with contextlib.closing(
        LcmSubscriber(open_lcm(lcm_queries_url(lab.url)), "MOCAP_LAB_PARAMETERS_REQUEST", reply_to)
    ):
        lab.lcm.publish("MOCAP_LAB_3D", lab.markers(1))
        wait_until(lambda: names(lab) == {"lab"})
        lab.subscriber._query(lab.recording.sources_now[0])
        wait_until(lambda: True in answers)
    assert False not in answers
