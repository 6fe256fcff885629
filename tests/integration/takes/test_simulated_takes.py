"""A take as an RT server: simulate --take, from the file to another gateway and to other clients."""

import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gateway.messages.encode import CONTENT_OFFSET
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
from gateway.simulator.faults.frame_faults import FrozenTimestamps
from gateway.simulator.faults.server_faults import ChangeScene, Rename, Restart
from gateway.simulator.recorded.take_scene import TakeScene
from gateway.simulator.scene_settings import SceneSettings
from gateway.simulator.simulator import Simulator
from gateway.takes.event_log import EventLogReader
from gateway.takes.reader import TakeReader
from tests.command_in_process import run_in_process
from tests.integration.raw_client import RawClient, connected, consecutive, numbers, until
from tests.memory_gateway import run_gateway
from tests.recorded_servers import SCENES, has_ended, record
from tests.takes import START_UTIME, Message, description, frame, markers, parameters, write_take
from tests.unit.rtc3d_server.wire import (
    ANALOG,
    COMMAND,
    MARKERS,
    NO_DATA,
    XML,
    ByteOrder,
    WireComponent,
    command,
    packets_in,
)


def contents(path: Path) -> dict[str, list[bytes]]:
    """Return frame number, time stamp, count and items of each message, by component."""
    found: dict[str, list[bytes]] = {}
    for message in TakeReader(path).messages():
        if message.key in COMPONENTS_BY_KEY:
            found.setdefault(message.key, []).append(message.message[CONTENT_OFFSET:])
    return found


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("optotrak", marks=pytest.mark.takes),
        pytest.param("qualisys", marks=pytest.mark.takes),
        "synthetic",
    ],
)
async def test_a_recorded_take_is_recorded_again_with_the_same_bytes(name: str, tmp_path: Path) -> None:
    scene = SCENES[name]()
    original = contents(await record(scene, tmp_path / "first.lcmlog", has_ended))
    assert scene.length_us is not None
    for component, rate_hz in scene.rates_hz.items():
        assert len(original[component.key]) == round(scene.length_us * rate_hz / 1e6)
    assert ("event" in original) == (name == "synthetic")

    again = contents(await record(TakeScene(tmp_path / "first.lcmlog"), tmp_path / "again.lcmlog", has_ended))

    assert {key: len(each) for key, each in again.items()} == {
        key: len(each) for key, each in original.items()
    }
    assert again == original


# Other clients ------------------------------------------------------------------------------

SECOND_US = 1_000_000
LABELS = encode_parameters(
    Parameters(
        General("the lab's server", address="192.0.2.20"),
        Parameters3D(100.0, markers=(Marker("1", "head"), Marker("2", "foot"))),
        analog=ParametersAnalog((AnalogChannel("1", "force", frequency_hz=1000.0),)),
    )
)


def float32(value: float) -> float:
    return float(np.float32(value))


def small_take(path: Path, num_frames: int = 50, *, xml: bytes = LABELS) -> Path:
    """Write a take of two markers at 100 Hz, a channel at 1000 Hz and an event; time stamps begin at 7 s."""
    messages = [description(), parameters(xml)]
    for number in range(10 * num_frames):
        timestamp_us, utime = 7 * SECOND_US + 1000 * number, START_UTIME + 1000 * number
        if number % 10 == 0:
            messages.append(markers(2, number // 10, timestamp_us=timestamp_us, utime=utime))
        messages.append(
            frame(ComponentType.ANALOG, [number / 7], number, timestamp_us=timestamp_us, utime=utime)
        )
    event_us = 200_000
    messages.append(
        frame(
            ComponentType.EVENT,
            [(77, 7 * SECOND_US + event_us, 1, 2, 3)],
            timestamp_us=7 * SECOND_US + event_us,
            utime=START_UTIME + event_us,
        )
    )
    messages[2:] = sorted(messages[2:], key=lambda message: message[1][8:16])
    return write_take(path, messages)


@pytest.fixture
def take(tmp_path: Path) -> Path:
    return small_take(tmp_path / "lab.lcmlog")


@pytest.mark.parametrize("byte_order", ["big", "little"])
async def test_a_client_follows_the_order_of_the_specification(take: Path, byte_order: ByteOrder) -> None:
    async with Simulator(TakeScene(take), once=True) as simulator, connected(simulator) as client:
        assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")
        await client.ask(f"SetByteOrder {byte_order}Endian")
        assert await client.ask("SendParameters All") == (XML, LABELS)
        packet_type, xml = await client.ask("SendParameters 3D")
        assert packet_type == XML
        assert parse_parameters(xml).parameters == Parameters(
            markers=parse_parameters(LABELS).parameters.markers
        )
        await client.ask("StreamFrames All")
        frames = await client.frames(50, byte_order)
        for number, components in enumerate(frames):
            timestamp_us = 7 * SECOND_US + 10_000 * number
            y = float(number)
            assert components[0] == WireComponent(
                MARKERS, number, timestamp_us, [(0, y, 0.5, float32(0.1)), (1, y, 0.5, float32(0.1))]
            )
            assert components[1] == WireComponent(
                ANALOG, 10 * number, timestamp_us, [(float32(10 * number / 7),)]
            )
        assert frames[20][2].items == [(77, 7_200_000, 1, 2, 3)]
        assert await client.read() == (NO_DATA, b"")
        assert await client.ask("SendCurrentFrame") == (COMMAND, b"OK-SendCurrentFrame")
        assert await client.read() == (NO_DATA, b"")
        client.send(command("Bye"))
        assert packets_in(await client.rest()) == [(COMMAND, b"bye")]


async def test_clients_on_several_connections_get_every_frame(take: Path) -> None:
    async with (
        Simulator(TakeScene(take), once=True) as simulator,
        connected(simulator) as first,
        connected(simulator) as second,
    ):
        await first.ask("StreamFrames 3D Events")
        await second.ask("StreamFrames Analog")
        assert numbers(await first.frames(50)) == list(range(50))
        assert numbers(await second.frames(500)) == list(range(500))


async def test_a_take_that_loops_jumps_back_as_it_was(take: Path) -> None:
    async with Simulator(TakeScene(take)) as simulator, connected(simulator) as client:
        await client.ask("StreamFrames 3D")
        first = (await client.frames(1))[0][0].frame_number
        seen = numbers(await client.frames(120))
        assert seen == [(first + 1 + k) % 50 for k in range(120)]


async def test_clients_may_join_at_any_time(tmp_path: Path) -> None:
    take = small_take(tmp_path / "lab.lcmlog", num_frames=3000)  # it does not end during the test
    async with Simulator(TakeScene(take), once=True) as simulator, connected(simulator) as client:
        await client.ask("StreamFrames Analog")
        await client.frames(300)
        async with connected(simulator) as late:
            await late.ask("SendCurrentFrame 3D")
            [current] = await late.frames(1)
            assert 29 <= current[0].frame_number < 2990
            await late.ask("StreamFrames 3D")
            assert consecutive(await late.frames(3))


async def test_a_gateway_follows_parameters_that_change(tmp_path: Path) -> None:
    before = [markers(2, number, version=1) for number in range(100)]
    after = [markers(3, number, version=2) for number in range(100, 300)]
    renamed = LABELS.replace(b"head", b"hand")
    path = write_take(
        tmp_path / "lab.lcmlog", [description(), parameters(LABELS), *before, parameters(renamed, 2), *after]
    )
    async with (
        Simulator(TakeScene(path), once=True) as simulator,
        run_gateway(simulator.port, stall_timeout_s=3.0) as lab,
    ):
        messages = await lab.wait_for("3d", 300)
        assert [message.num_markers for message in messages] == [2] * 100 + [3] * 200
        assert [message.frame_number for message in messages] == list(range(300))
        assert {message.parameters_version for message in messages[:100]} == {1}
        assert messages[-1].parameters_version == 2


# Unusual takes ------------------------------------------------------------------------------


def is_component(message: Message) -> bool:
    return not message[0].endswith(("_TAKE", "_PARAMETERS"))


def with_timestamp(message: Message, change: Callable[[int], int]) -> Message:
    channel, data = message
    timestamp_us = int.from_bytes(data[44:52], "big", signed=True)
    return channel, data[:44] + change(timestamp_us).to_bytes(8, "big", signed=True) + data[52:]


def with_gaps(messages: list[Message]) -> list[Message]:
    rng = random.Random(1)
    return [message for message in messages if not is_component(message) or rng.random() > 0.2]


def frozen(messages: list[Message]) -> list[Message]:
    return [
        with_timestamp(message, lambda _: -1) if is_component(message) else message for message in messages
    ]


def restarted(messages: list[Message]) -> list[Message]:
    return [
        with_timestamp(message, lambda us: us - 7_250_000 if us > 7_250_000 else us)
        if is_component(message)
        else message
        for message in messages
    ]


def without_parameters(messages: list[Message]) -> list[Message]:
    return list(filter(is_component, messages))


def analog_ends_early(messages: list[Message]) -> list[Message]:
    middle = len(messages) // 2
    return [message for k, message in enumerate(messages) if k < middle or "ANALOG" not in message[0]]


def damaged(messages: list[Message]) -> list[Message]:
    return [
        (channel, data[:-1]) if k % 50 == 25 else (channel, data)
        for k, (channel, data) in enumerate(messages)
    ]


@pytest.mark.parametrize(
    "change", [with_gaps, frozen, restarted, without_parameters, analog_ends_early, damaged]
)
async def test_everything_that_is_in_an_unusual_take_is_recorded_again(
    take: Path, change: Callable[[list[Message]], list[Message]], tmp_path: Path
) -> None:
    events = [(event.channel, event.message) for event in EventLogReader(take).events()]
    path = write_take(tmp_path / "unusual.lcmlog", change(events))
    expected = {
        key: [content for content in each if len(content) % 4 == 0] for key, each in contents(path).items()
    }

    again = contents(await record(TakeScene(path), tmp_path / "again.lcmlog", has_ended))

    assert {key: len(each) for key, each in again.items()} == {
        key: len(each) for key, each in expected.items()
    }
    assert again == expected


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

        frames = await frames_after(client, is_frozen, 3)
        assert len({components[0].timestamp_us for components in frames}) == 1
        assert frames[0][0].timestamp_us >= 7 * SECOND_US
        simulator.faults.end(frozen)

        changed = simulator.faults.begin(ChangeScene(scene=SceneSettings(markers=5)))
        await frames_after(client, lambda components: len(components[0].items) == 5, 3)
        simulator.faults.end(changed)
        await frames_after(client, lambda components: len(components[0].items) == 2, 3)


async def ask_xml(client: RawClient) -> tuple[int, bytes]:
    client.send(command("SendParameters All"))
    return await client.reply()


async def frames_after(
    client: RawClient, condition: Callable[[list[WireComponent]], bool], count: int
) -> list[list[WireComponent]]:
    """Return the next frames from the first one on that meets a condition."""
    while not condition((first := await client.frames(1))[0]):
        pass
    return first + await client.frames(count - 1)


async def test_a_server_that_restarts_plays_its_take_again(take: Path) -> None:
    async with Simulator(TakeScene(take), once=True) as simulator:
        for _ in range(2):
            async with connected(simulator) as client:
                await client.ask("StreamFrames 3D")
                assert numbers(await client.frames(50)) == list(range(50))
                assert await client.read() == (NO_DATA, b"")
            simulator.faults.begin(Restart(away_s=0))
            await until(lambda: simulator.is_listening)


# The command --------------------------------------------------------------------------------


def simulate(*options: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the command; it must end by itself."""
    return subprocess.run(
        [sys.executable, "-m", "gateway", "simulate", "--port", "0", *map(str, options)],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )


def test_the_command_plays_the_folder_of_a_saved_take(tmp_path: Path) -> None:
    folder = tmp_path / "saved"
    folder.mkdir()
    small_take(folder / "saved-001.lcmlog")
    small_take(folder / "saved-002.lcmlog")
    ended = simulate(
        "--take", folder, "--source", "lab", "--from", "0.1", "--to", "0.4", "--once", "--seconds", "0.1"
    )
    assert ended.returncode == 0, ended.stderr
    assert "RTC3D server on 127.0.0.1:" in ended.stdout


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--take", "TAKE", "--c3d", "x.c3d"], "either --c3d or --take"),
        (["--source", "lab"], "need --take"),
        (["--take", "TAKE", "--from", "2", "--to", "1"], "--to 1 is not after --from 2"),
        (["--once"], "--once needs --c3d or --take"),
        (["--take", "TAKE", "--from", "60"], "has no frames of lab from 60 s to its end"),
        (["--take", "TAKE", "--source", "gym"], "has no source 'gym'; its sources are: lab"),
        (["--take", "/no/such/take"], "/no/such/take cannot be read: No such file"),
        (["--take", "FOLDER"], "has no recordings (.lcmlog)"),
    ],
)
def test_the_command_says_why_a_take_cannot_be_played(take: Path, options: list[str], problem: str) -> None:
    (take.parent / "empty").mkdir()
    paths = {"TAKE": str(take), "FOLDER": str(take.parent / "empty")}
    ended = run_in_process("simulate", "--port", "0", *(paths.get(option, option) for option in options))
    assert ended.returncode != 0
    assert problem in " ".join(ended.stderr.replace("│", " ").split())
