"""What a replay publishes, in which order; the outputs are in memory, and nothing depends on time."""

import asyncio
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
import rtc3d

from gateway.errors import OutputError, TakeError
from gateway.outputs.contract import Output, ServerParameters
from gateway.replay.play_list import Selection
from gateway.replay.player import Player
from gateway.replay.publication import MAX_TOPICS, Publication, Refusal
from gateway.replay.replay import playing
from gateway.replay.timeline import Jump
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters, Parameters6D, Tool
from gateway.takes.event_log import encode_event
from gateway.takes.reader import TakeReader
from tests.takes import START_UTIME, Message, description, frame, log_bytes, markers, parameters, write_take
from tests.toy_output import ToyOutput
from tests.waiting import wait_until_async

XML = b"<Parameters><The_3D><Markers>2</Markers></The_3D></Parameters>"


class RecordingOutput(ToyOutput):
    """Keeps parameters among its messages, in the order in which they came."""

    def __init__(self, name: str = "toy") -> None:
        super().__init__(name)
        self.keys: list[tuple[str, bytes]] = []
        self.parsed: list[Parameters] = []
        self.on_parameters: asyncio.Future[None] | None = None

    def publisher(self, topic: Any) -> Any:
        publisher = super().publisher(topic)
        key = "/".join((topic.source, *topic.path))

        class _Publisher:
            def publish(self, message: bytes) -> None:
                publisher.publish(message)
                keys.append((key, message))

        keys = self.keys
        return _Publisher()

    def publish_parameters(self, source: str, content: ServerParameters) -> asyncio.Future[None] | None:
        self.keys.append((f"{source}/parameters", content.message))
        self.parsed.append(content.parsed)
        return self.on_parameters


class Replayed:
    def __init__(self, *outputs: Output) -> None:
        self.outputs = outputs or (RecordingOutput(),)
        self.jumps: list[Jump] = []
        self.publication: Publication
        self.player: Player

    def prepare(self, path: Path, selection: Selection = Selection(), **options: Any) -> Player:  # noqa: B008
        self.publication = Publication(self.outputs, {}, asyncio.get_running_loop())
        options = {"rate": None, "on_jump": self.jumps.append, **options}
        self.player = Player(TakeReader(path), selection, self.publication, **options)
        return self.player

    async def play(self, path: Path, selection: Selection = Selection(), **options: Any) -> None:  # noqa: B008
        player = self.prepare(path, selection, **options)
        async with playing(player):
            await wait_until_async(lambda: not player.is_alive)

    @property
    def keys(self) -> list[tuple[str, bytes]]:
        [output] = self.outputs
        assert isinstance(output, RecordingOutput)
        return output.keys


def keyed(messages: Iterable[Message]) -> list[tuple[str, bytes]]:
    return [
        (channel.removeprefix("MOCAP_").lower().replace("_", "/", 1), message)
        for channel, message in messages
        if not channel.endswith("_TAKE")
    ]


def some_messages() -> list[Message]:
    messages = [description(), parameters(XML)]
    for number in range(20):
        messages += [markers(2, number), frame(ComponentType.ANALOG, [number], number)]
    return messages


async def test_messages_keep_their_bytes_and_their_order(tmp_path: Path) -> None:
    replayed = Replayed()
    messages = some_messages()
    await replayed.play(write_take(tmp_path / "take.lcmlog", messages))
    assert replayed.keys == keyed(messages)
    assert replayed.publication.num_messages == {"parameters": 1, "3d": 20, "analog": 20}
    assert replayed.player.lateness.num_messages == 0


async def test_from_the_middle_the_valid_parameters_come_first(tmp_path: Path) -> None:
    other = parameters(XML + b"<!-- 2 -->", 2, utime=START_UTIME + 95_000)
    messages = [description(), parameters(XML), *(markers(2, number) for number in range(10)), other]
    messages += [markers(2, number, version=2) for number in range(10, 30)]
    path = write_take(tmp_path / "take.lcmlog", messages)
    replayed = Replayed()
    await replayed.play(path, Selection(start_us=150_000, stop_us=200_000))
    assert replayed.keys == keyed([other, *messages[-15:-9]])
    replayed = Replayed()
    await replayed.play(path, Selection(start_us=50_000, stop_us=90_000))
    assert replayed.keys == keyed(messages[1:2] + messages[7:12])


async def test_sources_and_components_are_selected_and_parameters_stay(tmp_path: Path) -> None:
    messages = some_messages()
    stage = [description("stage"), parameters(XML, source="stage")]
    stage += [markers(1, number, source="stage") for number in range(20)]
    path = write_take(tmp_path / "take.lcmlog", [*stage, *messages])
    replayed = Replayed()
    await replayed.play(path, Selection(components=frozenset({"analog"})))
    assert {key for key, _ in replayed.keys} == {"lab/parameters", "stage/parameters", "lab/analog"}
    replayed = Replayed()
    await replayed.play(path, Selection(sources=frozenset({"lab"})))
    assert replayed.keys == keyed(messages)
    assert replayed.publication.sources.keys() == {"lab"}


async def test_nothing_to_replay_is_an_error(tmp_path: Path) -> None:
    path = write_take(tmp_path / "take.lcmlog", some_messages())
    for selection in (Selection(sources=frozenset({"x"})), Selection(start_us=10**9)):
        with pytest.raises(TakeError, match=r"no messages to replay with these .* --source \(lab\)"):
            await Replayed().play(path, selection)


async def test_messages_wait_until_new_parameters_cannot_be_overtaken(tmp_path: Path) -> None:
    output = RecordingOutput()
    output.on_parameters = asyncio.get_running_loop().create_future()
    replayed = Replayed(output)
    # Later on, the same parameters again: as they are known, nothing waits for them.
    messages = [*some_messages(), parameters(XML, utime=START_UTIME + 1_000_000), markers(2, 100)]
    player = replayed.prepare(write_take(tmp_path / "take.lcmlog", messages))
    async with playing(player):
        await wait_until_async(lambda: output.keys)
        assert [key for key, _ in output.keys] == ["lab/parameters"]
        output.on_parameters.set_result(None)
        output.on_parameters = asyncio.get_running_loop().create_future()
        await wait_until_async(lambda: not player.is_alive)
    assert output.keys == keyed(messages)


async def test_what_an_output_refuses_is_counted_and_the_other_gets_it(tmp_path: Path) -> None:
    healthy, broken = RecordingOutput("healthy"), RecordingOutput("broken")
    broken.error = OutputError("full; empty it", cause="queue full")
    replayed = Replayed(broken, healthy)
    messages = some_messages()
    await replayed.play(write_take(tmp_path / "take.lcmlog", messages))
    assert healthy.keys == keyed(messages)
    assert replayed.publication.refusals == {
        Refusal("3d", "broken", "queue full"): 20,
        Refusal("analog", "broken", "queue full"): 20,
    }


async def test_the_take_may_be_repeated_until_it_is_stopped(tmp_path: Path) -> None:
    replayed = Replayed()
    messages = some_messages()
    player = replayed.prepare(write_take(tmp_path / "take.lcmlog", messages), is_repeated=True)
    async with playing(player):
        await wait_until_async(lambda: player.num_passes >= 3)
    expected = keyed(messages)
    for start in range(0, 3 * len(expected), len(expected)):
        assert replayed.keys[start : start + len(expected)] == expected


async def test_bad_input_is_left_out_and_counted(tmp_path: Path) -> None:
    messages = some_messages()[1:]
    cut_parameters = ("MOCAP_LAB_PARAMETERS", parameters(XML)[1][:60])
    cut_frame = ("MOCAP_LAB_3D", messages[-2][1][:30])
    foreign = encode_event(0, START_UTIME, b"CAMERA", b"other type")
    path = tmp_path / "take.lcmlog"
    log = log_bytes([cut_parameters, *messages, cut_frame])
    path.write_bytes(b"garbage" + foreign + log + log[:50])
    replayed = Replayed()
    await replayed.play(path)
    assert replayed.keys == keyed(messages)
    assert replayed.publication.num_unreadable == {"lab": 2}
    assert replayed.publication.without_parameters == set()


async def test_a_take_without_parameters_is_replayed_and_reported(tmp_path: Path) -> None:
    messages = [markers(2, number) for number in range(3)]
    replayed = Replayed()
    await replayed.play(write_take(tmp_path / "take.lcmlog", messages))
    assert replayed.keys == keyed(messages)
    assert replayed.publication.without_parameters == {"lab"}


async def test_a_defect_of_an_output_ends_the_replay_with_its_error(tmp_path: Path) -> None:
    output = RecordingOutput()
    output.error = ZeroDivisionError()
    with pytest.raises(ZeroDivisionError):
        await Replayed(output).play(write_take(tmp_path / "take.lcmlog", some_messages()))


async def test_poses_are_published_under_the_labels_of_the_tools(tmp_path: Path) -> None:
    pose = rtc3d.tool_pose_t()
    pose.utime = START_UTIME
    content = Parameters(tools=Parameters6D(100.0, (Tool("1", "Left/hand 1"), Tool("2", "probe"))))
    messages: list[Message] = [parameters(content)]
    messages += [(f"MOCAP_LAB_6D_{name}", pose.encode()) for name in ("LEFT_HAND_1", "OTHER")]
    replayed = Replayed()
    await replayed.play(write_take(tmp_path / "take.lcmlog", messages))
    [output] = replayed.outputs
    assert isinstance(output, RecordingOutput)
    assert [topic.path for topic in output.declared] == [("6d", "Left/hand 1"), ("6d", "OTHER")]
    assert replayed.publication.num_messages == {"parameters": 1, "6d/tool": 2}


async def test_outputs_get_what_the_recorded_parameters_say(tmp_path: Path) -> None:
    """Zenoh needs the labels for JSON."""
    output = RecordingOutput()
    given = Parameters(tools=Parameters6D(tools=(Tool("1", "Probe"),)))
    messages = [description(), parameters(given), parameters(given), parameters(b"<no XML", 2)]
    messages += [markers(1, number) for number in range(3)]
    await Replayed(output).play(write_take(tmp_path / "take.lcmlog", messages))
    assert [parsed.tools for parsed in output.parsed] == [given.tools, given.tools, None]


async def test_sources_get_names_that_are_possible_in_keys(tmp_path: Path) -> None:
    messages = [
        *(description("a/b*"), ("MOCAP_A_B_3D", markers(1)[1])),
        ("x_" + "y" * 30 + "_3D", markers(1)[1]),
    ]
    replayed = Replayed()
    await replayed.play(write_take(tmp_path / "take.lcmlog", messages))
    assert replayed.publication.sources.keys() == {"a-b-", "y" * 24}


async def test_the_number_of_keys_is_limited(tmp_path: Path) -> None:
    pose = rtc3d.tool_pose_t().encode()
    messages = [(f"MOCAP_LAB_6D_TOOL{number}", pose) for number in range(MAX_TOPICS + 10)]
    replayed = Replayed()
    await replayed.play(write_take(tmp_path / "take.lcmlog", messages))
    assert len(replayed.keys) == MAX_TOPICS
    assert replayed.publication.num_surplus == 10
