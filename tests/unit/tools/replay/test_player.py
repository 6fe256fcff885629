"""What a replay publishes, in which order; the outputs are in memory, and nothing depends on time."""

import asyncio
from collections.abc import Iterable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
import rtc3d

from gateway.errors import OutputError, TakeError
from gateway.outputs.contract import Output, ServerParameters
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters, Parameters6D, Tool
from gateway.takes.files.reader import TakeReader
from gateway.tools.replay.play_list import Selection
from gateway.tools.replay.player import Player
from gateway.tools.replay.publication import MAX_TOPICS, Publication, PublicationRefusal
from gateway.tools.replay.replay import playing
from tests.support.errors import raises
from tests.support.takes import (
    START_UTIME,
    Message,
    description,
    encode_event,
    frame,
    log_bytes,
    markers,
    parameters,
    write_take,
)
from tests.support.toy_output import ToyOutput
from tests.support.waiting import wait_until_async

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
    """Replays takes from a folder to outputs, by default to one that records."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "take.lcmlog"
        self.output = RecordingOutput()
        self.outputs: tuple[Output, ...] = (self.output,)
        self.publication: Publication
        self.player: Player

    def prepare(self, messages: Iterable[Message] | None = None, **selection: Any) -> Player:
        """Write a take of these messages, or use the present one; make its player."""
        if messages is not None:
            write_take(self.path, messages)
        self.output.keys.clear()
        self.publication = Publication(self.outputs, {}, asyncio.get_running_loop())
        reader, chosen = TakeReader(self.path), Selection(**selection)
        self.player = Player(reader, chosen, self.publication, rate=None, on_jump=lambda _: None)
        return self.player

    async def play(
        self, messages: Iterable[Message] | None = None, **selection: Any
    ) -> list[tuple[str, bytes]]:
        """Play to the end; return keys and messages as the output got them."""
        player = self.prepare(messages, **selection)
        async with playing(player):
            await wait_until_async(lambda: not player.is_alive)
        return self.output.keys


@pytest.fixture
def replayed(tmp_path: Path) -> Replayed:
    return Replayed(tmp_path)


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


async def test_messages_keep_their_bytes_and_their_order(replayed: Replayed) -> None:
    messages = some_messages()
    assert await replayed.play(messages) == keyed(messages)
    assert replayed.publication.num_messages == {"parameters": 1, "3d": 20, "analog": 20}
    assert replayed.player.pace is None


async def test_from_the_middle_the_valid_parameters_come_first(replayed: Replayed) -> None:
    other = parameters(XML + b"<!-- 2 -->", 2, utime=START_UTIME + 95_000)
    messages = [description(), parameters(XML), *(markers(2, number) for number in range(10)), other]
    messages += [markers(2, number, version=2) for number in range(10, 30)]
    found = await replayed.play(messages, start_us=150_000, stop_us=200_000)
    assert found == keyed([other, *messages[-15:-9]])
    found = await replayed.play(start_us=50_000, stop_us=90_000)
    assert found == keyed(messages[1:2] + messages[7:12])


async def test_sources_and_components_are_selected_and_parameters_stay(replayed: Replayed) -> None:
    messages = some_messages()
    stage = [description("stage"), parameters(XML, source="stage")]
    stage += [markers(1, number, source="stage") for number in range(20)]
    found = await replayed.play([*stage, *messages], components=frozenset({"analog"}))
    assert {key for key, _ in found} == {"lab/parameters", "stage/parameters", "lab/analog"}
    assert await replayed.play(sources=frozenset({"lab"})) == keyed(messages)
    assert replayed.publication.sources.keys() == {"lab"}
    for selection in ({"sources": frozenset({"x"})}, {"start_us": 10**9}):
        with raises(TakeError, "--source (stage, lab)"):
            await replayed.play(**selection)


async def test_messages_wait_until_new_parameters_cannot_be_overtaken(replayed: Replayed) -> None:
    output, loop = replayed.output, asyncio.get_running_loop()
    output.on_parameters = loop.create_future()
    # Later on, the same parameters again: as they are known, nothing waits for them.
    messages = [*some_messages(), parameters(XML, utime=START_UTIME + 1_000_000), markers(2, 100)]
    player = replayed.prepare(messages)
    async with playing(player):
        await wait_until_async(lambda: output.keys)
        assert [key for key, _ in output.keys] == ["lab/parameters"]
        output.on_parameters.set_result(None)
        output.on_parameters = loop.create_future()
        await wait_until_async(lambda: not player.is_alive)
    assert output.keys == keyed(messages)


async def test_what_an_output_refuses_is_counted_and_the_other_gets_it(replayed: Replayed) -> None:
    broken, messages = RecordingOutput("broken"), some_messages()
    broken.error = OutputError("full; empty it", cause="queue full")
    replayed.outputs = (broken, replayed.output)
    assert await replayed.play(messages) == keyed(messages)
    refusals = {PublicationRefusal(key, "broken", "queue full"): 20 for key in ("3d", "analog")}
    assert replayed.publication.refusals == refusals
    replayed.output.error = ZeroDivisionError()  # a defect
    with pytest.raises(ZeroDivisionError):
        await replayed.play()


async def test_bad_input_is_left_out_and_counted(replayed: Replayed) -> None:
    messages = some_messages()[1:]
    cut_parameters = ("MOCAP_LAB_PARAMETERS", parameters(XML)[1][:60])
    cut_frame = ("MOCAP_LAB_3D", messages[-2][1][:30])
    log = log_bytes([cut_parameters, *messages, cut_frame])
    foreign = encode_event(0, START_UTIME, b"CAMERA", b"other type")
    replayed.path.write_bytes(b"garbage" + foreign + log + log[:50])
    assert await replayed.play() == keyed(messages)
    assert replayed.publication.num_unreadable == {"lab": 2}
    assert replayed.publication.without_parameters == set()
    messages = [markers(2, number) for number in range(3)]
    assert await replayed.play(messages) == keyed(messages)
    assert replayed.publication.without_parameters == {"lab"}


async def test_poses_are_published_under_the_labels_of_the_tools(replayed: Replayed) -> None:
    pose = rtc3d.tool_pose_t()
    pose.utime = START_UTIME
    content = Parameters(tools=Parameters6D(100.0, (Tool("1", "Left/hand 1"), Tool("2", "probe"))))
    poses = [(f"MOCAP_LAB_6D_{name}", pose.encode()) for name in ("LEFT_HAND_1", "OTHER")]
    await replayed.play([parameters(content), *poses])
    assert [topic.path for topic in replayed.output.declared] == [("6d", "Left/hand 1"), ("6d", "OTHER")]
    assert replayed.publication.num_messages == {"parameters": 1, "6d/tool": 2}


async def test_a_source_that_is_not_chosen_is_not_announced_from_the_middle_either(
    replayed: Replayed,
) -> None:
    """The parameters before the beginning come first, but not those of other sources."""
    messages = [parameters(XML, source=source) for source in ("hall", "lab")]
    for number in range(20):
        messages += [markers(2, number, source=source) for source in ("hall", "lab")]
    for start_us in (0, 50_000):
        found = await replayed.play(messages, sources=frozenset({"lab"}), start_us=start_us)
        assert {key.partition("/")[0] for key, _ in found} == {"lab"}
        assert found[0][0] == "lab/parameters"


async def test_the_first_message_of_a_key_waits_until_the_output_can_send_it(replayed: Replayed) -> None:
    """Otherwise the first pose of each tool is refused: Zenoh declares their keys in a thread."""
    output = replayed.output
    waiting: list[Future[None]] = []
    num_messages: list[int] = []

    def until_declared() -> Future[None]:
        num_messages.append(len(output.keys))
        waiting.append(Future())
        asyncio.run_coroutine_threadsafe(declare(waiting[-1]), loop)
        return waiting[-1]

    async def declare(future: Future[None]) -> None:
        num_messages.append(len(output.keys))
        future.set_result(None)

    loop = asyncio.get_running_loop()
    output.until_declared = until_declared  # type: ignore[method-assign]  # an output that declares late
    await replayed.play([markers(1, 0), markers(1, 1), frame(ComponentType.ANALOG, [1], 0)])
    assert num_messages == [0, 0, 2, 2]
    assert len(output.keys) == 3


async def test_outputs_get_what_the_recorded_parameters_say(replayed: Replayed) -> None:
    """Zenoh needs the labels for JSON."""
    given = Parameters(tools=Parameters6D(tools=(Tool("1", "Probe"),)))
    messages = [description(), parameters(given), parameters(given), parameters(b"<no XML", 2)]
    await replayed.play([*messages, *(markers(1, number) for number in range(3))])
    assert [parsed.tools for parsed in replayed.output.parsed] == [given.tools, given.tools, None]


async def test_sources_get_possible_names_and_the_number_of_keys_is_limited(replayed: Replayed) -> None:
    messages = [
        description("a/b*"),
        ("MOCAP_A_B_3D", markers(1)[1]),
        ("x_" + "y" * 30 + "_3D", markers(1)[1]),
    ]
    await replayed.play(messages)
    assert replayed.publication.sources.keys() == {"a-b-", "y" * 24}
    pose = rtc3d.tool_pose_t().encode()
    found = await replayed.play((f"MOCAP_LAB_6D_TOOL{number}", pose) for number in range(MAX_TOPICS + 10))
    assert len(found) == MAX_TOPICS
    assert replayed.publication.num_surplus == 10
