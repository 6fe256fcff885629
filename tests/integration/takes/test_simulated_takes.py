"""A take as an RT server: simulate --take, from the file to another gateway and to other clients."""

import os
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gateway.config.settings import MetricsSettings, SourceSettings
from gateway.daemon.gateway import Gateway
from gateway.messages.encode import CONTENT_OFFSET
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.rtc3d.parameters import (
    AnalogChannel,
    General,
    Marker,
    Parameters,
    Parameters3D,
    ParametersAnalog,
)
from gateway.rtc3d.parameters_xml import encode_parameters, parse_parameters
from gateway.session.server.measurement import ComputedScene
from gateway.session.server.scene import Scene
from gateway.session.state import StreamState
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.faults import ChangeScene, Rename
from gateway.simulator.packet_faults import FrozenTimestamps
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SceneSettings, SyntheticScene
from gateway.simulator.take_scene import TakeScene
from gateway.takes.files.event_log import EventLogReader
from gateway.takes.files.reader import TakeReader
from tests.integration.raw_client import RawClient, connected
from tests.support.commands import run_in_process
from tests.support.configurations import make_settings
from tests.support.gateways import run_gateway, running_gateway
from tests.support.takes import START_UTIME, Message, description, frame, markers, parameters, write_take
from tests.support.waiting import wait_until_async
from tests.unit.session.server.wire import XML, WireComponent, command

SECOND_US = 1_000_000
LABELS = encode_parameters(
    Parameters(
        General("the lab's server", address="192.0.2.20"),
        Parameters3D(100.0, markers=(Marker("1", "head"), Marker("2", "foot"))),
        analog=ParametersAnalog((AnalogChannel("1", "force", frequency_hz=1000.0),)),
    )
)


async def record(scene: Scene, path: Path) -> dict[str, list[bytes]]:
    """Serve a scene once; record what a gateway receives of it as LCM does, and return the contents."""
    async with Simulator(scene, once=True) as simulator:
        settings = make_settings(
            sources=(SourceSettings(name="lab", host="127.0.0.1", port=simulator.port),),
            metrics=MetricsSettings(enabled=False),
            lcm=LcmSettings(url=f"file://{path}?mode=w", queries=False),
        )

        def has_ended() -> bool:
            is_over = simulator.frames_sent > 0 and simulator.elapsed_us() is None
            return is_over and {each.state for each in source.statuses} == {StreamState.NO_MEASUREMENT}

        async with running_gateway(Gateway(settings, [LcmOutput(settings.lcm)])) as gateway:
            [source] = gateway.sources
            await wait_until_async(has_ended, 60)
    return contents(path)


def contents(path: Path) -> dict[str, list[bytes]]:
    """Return frame number, time stamp, count and items of each message, by component."""
    found: dict[str, list[bytes]] = {}
    for message in TakeReader(path).messages():
        if message.key in COMPONENTS_BY_KEY:
            found.setdefault(message.key, []).append(message.message[CONTENT_OFFSET:])
    return found


def assert_equal(found: dict[str, list[bytes]], expected: dict[str, list[bytes]]) -> None:
    """The numbers of messages come first: they are shorter to read than the messages."""
    assert {key: len(each) for key, each in found.items()} == {k: len(each) for k, each in expected.items()}
    assert found == expected


@pytest.mark.parametrize("name", [pytest.param("qualisys", marks=pytest.mark.takes), "synthetic"])
async def test_a_recorded_take_is_recorded_again_with_the_same_bytes(name: str, tmp_path: Path) -> None:
    if name == "qualisys":
        scene: ComputedScene = C3dScene(Path(os.environ["RTC3D_TAKES"]) / "qualisys.c3d")
    else:
        scene = SyntheticScene(markers=30, tools=5, analog=16, plates=2, rate_hz=100, analog_rate_hz=1000)
        scene.num_frames = 250
    original = await record(scene, tmp_path / "first.lcmlog")
    assert scene.length_us is not None
    for component, rate_hz in scene.rates_hz.items():
        assert len(original[component.key]) == round(scene.length_us * rate_hz / 1e6)
    assert "event" in original
    assert_equal(await record(TakeScene(tmp_path / "first.lcmlog"), tmp_path / "again.lcmlog"), original)


@pytest.fixture
def take(tmp_path: Path) -> Path:
    """A take of two markers at 100 Hz, a channel at 1000 Hz and an event; time stamps begin at 7 s."""
    messages = []
    for number in range(500):
        options: dict[str, Any] = {
            "timestamp_us": 7 * SECOND_US + 1000 * number,
            "utime": START_UTIME + 1000 * number,
        }
        if number % 10 == 0:
            messages.append(markers(2, number // 10, **options))
        messages.append(frame(ComponentType.ANALOG, [number / 7], number, **options))
        if number == 200:
            event = (77, options["timestamp_us"], 1, 2, 3)
            messages.append(frame(ComponentType.EVENT, [event], **options))
    return write_take(tmp_path / "lab.lcmlog", [description(), parameters(LABELS), *messages])


async def test_a_gateway_follows_parameters_that_change(tmp_path: Path) -> None:
    before = [markers(2, number, version=1) for number in range(100)]
    after = [markers(3, number, version=2) for number in range(100, 300)]
    renamed = parameters(LABELS.replace(b"head", b"hand"), 2)
    messages = [description(), parameters(LABELS), *before, renamed, *after]
    path = write_take(tmp_path / "lab.lcmlog", messages)
    async with (
        Simulator(TakeScene(path), once=True) as simulator,
        run_gateway(simulator.port) as lab,
    ):
        found = await lab.wait_for("3d", 300)
        [source] = lab.gateway.sources
        await wait_until_async(lambda: b"hand" in source.known_parameters.xml)
    assert [message.num_markers for message in found] == [2] * 100 + [3] * 200
    assert [message.frame_number for message in found] == list(range(300))
    assert {message.parameters_version for message in found[:100]} == {1}


# Unusual takes ------------------------------------------------------------------------------


def with_timestamps(change: Callable[[int], int]) -> Callable[[int, Message], Message]:
    def changed(_number: int, message: Message) -> Message:
        channel, data = message
        timestamp_us = change(int.from_bytes(data[44:52], "big", signed=True))
        return channel, data[:44] + timestamp_us.to_bytes(8, "big", signed=True) + data[52:]

    return changed


def with_gaps(number: int, message: Message) -> Message | None:
    return message if random.Random(number).random() > 0.2 else None


def analog_ends_early(number: int, message: Message) -> Message | None:
    return message if number < 250 or "ANALOG" not in message[0] else None


def damaged(number: int, message: Message) -> Message:
    return (message[0], message[1][:-1]) if number % 50 == 25 else message


@pytest.mark.parametrize(
    ("change", "has_parameters"),
    [
        pytest.param(with_gaps, True, id="gaps"),
        pytest.param(with_timestamps(lambda _: -1), True, id="frozen time stamps"),
        pytest.param(with_timestamps(lambda us: us - 7_250_000 * (us > 7_250_000)), True, id="a restart"),
        pytest.param(lambda _, message: message, False, id="no parameters"),
        pytest.param(analog_ends_early, True, id="analog ends early"),
        pytest.param(damaged, True, id="damaged messages"),
    ],
)
async def test_everything_that_is_in_an_unusual_take_is_recorded_again(
    take: Path, change: Callable[[int, Message], Message | None], has_parameters: bool, tmp_path: Path
) -> None:
    head, *messages = ((event.channel, event.message) for event in EventLogReader(take).events())
    unusual = [changed for number, each in enumerate(messages[1:]) if (changed := change(number, each))]
    path = write_take(
        tmp_path / "unusual.lcmlog", [head, messages[0], *unusual] if has_parameters else unusual
    )
    expected = {
        key: [content for content in each if len(content) % 4 == 0] for key, each in contents(path).items()
    }
    assert_equal(await record(TakeScene(path), tmp_path / "again.lcmlog"), expected)


# Faults -------------------------------------------------------------------------------------


async def test_faults_act_on_takes(take: Path) -> None:
    async with Simulator(TakeScene(take)) as simulator, connected(simulator) as client:
        await client.ask("StreamFrames 3D")
        rename = simulator.faults.begin(Rename(prefix="Old "))
        [_, xml] = await ask_xml(client)
        described = parse_parameters(xml).parameters
        assert described.markers is not None
        assert [marker.label for marker in described.markers.markers] == ["Old head", "Old foot"]
        assert described.general is not None
        assert described.general.name == "the lab's server"
        simulator.faults.end(rename)
        assert await ask_xml(client) == (XML, LABELS)

        frozen = simulator.faults.begin(FrozenTimestamps())
        times_us: list[int] = []

        def is_frozen(components: list[WireComponent]) -> bool:
            times_us.append(components[0].timestamp_us)
            return times_us[-1] in times_us[:-1]

        await until(client, is_frozen)
        assert (await client.frames(1))[0][0].timestamp_us == times_us[-1] >= 7 * SECOND_US
        simulator.faults.end(frozen)

        changed = simulator.faults.begin(ChangeScene(scene=SceneSettings(markers=5)))
        await until(client, lambda components: len(components[0].items) == 5)
        simulator.faults.end(changed)
        await until(client, lambda components: len(components[0].items) == 2)


async def ask_xml(client: RawClient) -> tuple[int, bytes]:
    client.send(command("SendParameters All"))
    return await client.reply()


async def until(client: RawClient, condition: Callable[[list[WireComponent]], bool]) -> None:
    while not condition((await client.frames(1))[0]):
        pass


# The command --------------------------------------------------------------------------------


def test_the_command_plays_the_folder_of_a_saved_take(take: Path) -> None:
    (folder := take.parent / "saved").mkdir()
    for number in (1, 2):
        (folder / f"saved-00{number}.lcmlog").write_bytes(take.read_bytes())
    options = ("--source", "lab", "--from", "0.1", "--to", "0.4", "--once", "--seconds", "0.1")
    command = [sys.executable, "-m", "gateway", "simulate", "--port", "0", "--take", str(folder), *options]
    assert "127.0.0.1:" in subprocess.check_output(command, text=True, timeout=30)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ("--take TAKE --c3d x.c3d", "--c3d or --take"),
        ("--source lab", "need --take"),
        ("--take TAKE --from 2 --to 1", "--from 2"),
        ("--once", "--c3d or --take"),
        ("--take TAKE --source gym", "'gym'"),
    ],
)
def test_the_command_says_why_a_take_cannot_be_played(take: Path, options: str, problem: str) -> None:
    arguments = [str(take) if each == "TAKE" else each for each in options.split()]
    ended = run_in_process("simulate", "--port", "0", *arguments)
    assert ended.returncode != 0
    assert problem in " ".join(ended.stderr.replace("│", " ").split())
